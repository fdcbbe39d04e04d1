"""Training: one step with forward and inverse losses (Eq. 11). No loop lives here.

`make_train_step(config, tx)` returns train_step(state, batch) -> (state, metrics), pure and
jit-able. Randomness comes from the state's key and step (`step_key`), so a resumed run repeats the
uninterrupted one bit by bit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax

from evflow.network import architecture, encoder, flow, pooling
from evflow.network.coordinates import squash, squash_summary, unsquash, unsquash_summary
from evflow.network.pooling import Stats
from evflow.process.devices import by_shard
from evflow.scenes import TextureBank
from evflow.training import losses
from evflow.training.batch import Batch, sample_batch
from evflow.training.config import LossConfig, TrainConfig

Array = jax.Array
Metrics = dict[str, Array]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """step (int32), params and their exponential moving average, optimiser state, typed key."""

    step: Array
    params: dict[str, Any]
    average: dict[str, Any]
    opt_state: Any
    key: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Block:
    """The pixels that the flow sees: one block (B, h, w) of one window of each sequence.
    changes (B, h, w, m); context (B, h, w, 3); y: true parameters (B, h, w, 4)."""

    voxels: Array
    dlogI: Array
    changes: Array
    context: Array
    y: Array


def optimiser(config: TrainConfig) -> optax.GradientTransformation:
    """Adam with warm-up and cosine decay, gradients clipped part by part: the flow's likelihood
    has gradients 50 times those of the summary, which a common clip would silence."""

    def part(rate: float) -> optax.GradientTransformation:
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, rate, config.warmup, max(config.steps, config.warmup + 1))
        return optax.chain(optax.clip_by_global_norm(config.clip), optax.adam(schedule))

    rates = {"summary": config.summary_rate, "encoder": config.learning_rate,
             "spread": config.learning_rate, "flow": config.flow_rate}

    def labels(params: dict[str, Any]) -> dict[str, Any]:
        return {name: {k: jax.tree.map(lambda _, k=k: k, v) for k, v in net.items()}
                for name, net in params.items()}

    return optax.partition({k: part(rate) if k in config.parts else optax.set_to_zero()
                            for k, rate in rates.items()}, labels)


def init_state(
    config: TrainConfig, tx: optax.GradientTransformation, bank: TextureBank, name: str
) -> TrainState:
    """Fresh state; the flow's actnorms are initialised from one batch of data.

    name: the architecture's key in params, "default" or "paper".
    """
    key = jax.random.key(config.seed)
    k_params, k_data, k_run, k_block = jax.random.split(key, 4)
    params = jax.jit(architecture.init, static_argnums=(1, 2))(k_params, config.model, name)
    batch = jax.jit(sample_batch, static_argnames="config")(k_data, bank, config)
    block = cut_block(k_block, batch, config)
    y = _over(unsquash_summary(batch.nominal), block.y)
    net = params[name]
    changes = encoder.split_sign(block.changes)
    if config.model.code == "feature":
        changes, _ = architecture.encode_changes(config.model, net, block.voxels, block.dlogI,
                                          block.context, y)
    u = architecture.condition(config.model, changes, block.context, y)
    net["flow"] = flow.data_init(net["flow"], block.voxels, u, config.model.flow)
    # A copy: the train step donates its state, and a buffer can be donated only once. One program
    # each, not one a shape of the leaves.
    average = jax.jit(lambda tree: jax.tree.map(jnp.copy, tree))(params)
    return TrainState(jnp.zeros((), jnp.int32), params, average, jax.jit(tx.init)(params), k_run)


def cut_block(key: Array, batch: Batch, config: TrainConfig) -> Block:
    """A random block of pixels from a random window of each sequence."""
    h, w = config.block
    context = pooling.window_features(
        batch.window_s[:, None, None, None], batch.intensity, batch.dlogI.shape)
    y = jnp.broadcast_to(unsquash(batch.camera, config.model.output)[:, None],
                         (*batch.dlogI.shape, 4))

    def cut(key: Array, *arrays: Array) -> list[Array]:
        k_window, k_row, k_column = jax.random.split(key, 3)
        windows, rows, columns = arrays[0].shape[:3]
        start = (jax.random.randint(k_window, (), 0, windows),
                 jax.random.randint(k_row, (), 0, rows - h + 1),
                 jax.random.randint(k_column, (), 0, columns - w + 1))
        return [jax.lax.dynamic_slice(
            a, (*start, *(0,) * (a.ndim - 3)), (1, h, w, *a.shape[3:]))[0] for a in arrays]

    keys = jax.random.split(key, batch.dlogI.shape[0])
    return Block(*jax.vmap(cut)(keys, batch.voxels, batch.dlogI, batch.changes, context, y))


def _over(y: Array, like: Array) -> Array:
    """(B, C) -> (B, h, w, C)."""
    return jnp.broadcast_to(y[:, None, None], (*like.shape[:-1], y.shape[-1]))


def summary_losses(
    net: dict[str, Any], batch: Batch, key: Array, config: TrainConfig
) -> tuple[Array, Array, Metrics]:
    """Estimate each camera from the first 1..W windows (drawn per sequence, so that `finish`
    meets little and much data). Returns the loss, y (B, 6) and metrics."""
    count, windows = batch.dlogI.shape[:2]
    k_windows, k_intensity = jax.random.split(key)
    known = jax.random.bernoulli(k_intensity, 0.5, (count, 1, 1, 1))
    intensity = jnp.where(known, batch.intensity, jnp.nan)  # half the users have none to give
    stats = _pool_windows(net["summary"], batch, intensity, config)
    used = jax.random.randint(k_windows, (count, 1), 1, windows + 1)
    keep = (jnp.arange(windows)[None] < used).astype(jnp.float32)

    def add(leaf: Array) -> Array:
        return jnp.einsum("bw,bw...->b...", keep, leaf, precision="highest")

    total: Stats = jax.tree.map(add, stats)
    y, y_std = pooling.finish(config.model, net["summary"], total)
    target = unsquash_summary(batch.nominal)
    loss = losses.summary_loss(y, y_std, target).mean()
    seen = squash_summary(y)
    names = ("theta_on", "theta_off", "eta_on", "eta_off")
    metrics = {f"summary/{n}": jnp.abs(getattr(seen, n) - getattr(batch.nominal, n)).mean()
               for n in names}
    return loss, y, metrics


def _pool_windows(
    net: dict[str, Any], batch: Batch, intensity: Array, config: TrainConfig
) -> Stats:
    """Stats (B, W), window by window and recomputed in the backward pass: activations of one
    window stay in cache (gradient of 48 windows of 64x64: .23 s against .82 s at once)."""
    window_s = jnp.broadcast_to(batch.window_s[:, None], batch.dlogI.shape[:2])

    def pool(net: dict[str, Any], arrays: tuple[Array, ...]) -> Stats:
        lead = arrays[0].shape[:2]
        flat = tuple(a.reshape(-1, *a.shape[2:]) for a in arrays)
        one = jax.checkpoint(lambda window: pooling.pool(config.model, net, *window))
        return jax.tree.map(lambda a: a.reshape(*lead, *a.shape[1:]), jax.lax.map(one, flat))

    return by_shard(pool)(net, (batch.voxels, batch.dlogI, window_s, intensity))


def pixel_losses(
    net: dict[str, Any], block: Block, known: Array, seen: Array, key: Array, config: TrainConfig
) -> tuple[Metrics, Metrics]:
    """Losses of encoder, flow in both directions and spread.

    known, seen: the true and the estimated summary y (B, 6). Even scenes run on the true
    code and summary, odd ones on the predicted: otherwise the flow fitted to predicted codes
    and its inverse at true codes would be two different maps. Events are made of true codes only.
    """
    c = config.model
    even = (jnp.arange(known.shape[0]) // config.cameras % 2 == 0)[:, None]
    y6 = _over(jnp.where(even, known, seen), block.y)
    predicted, logits = architecture.encode_changes(
        c, net, block.voxels, block.dlogI, block.context, y6)
    parts = {"condition": losses.condition_loss(
        logits, encoder.targets(c, block.changes)).mean()}
    changes = predicted
    if c.code == "changes":
        parts["change_l1"] = _change_loss(predicted, block.changes)
        # The encoder answers to the true changes alone: what would serve the flow better is no
        # change of intensity any more, and a video could not supply it.
        changes = jnp.where(even[:, None, None], encoder.split_sign(block.changes),
                            jax.lax.stop_gradient(predicted))
    if config.parts == ("encoder",) and c.code == "changes":
        return parts, {}
    flow_parts, metrics = _flow_losses(net, block, changes, y6, even, key, config)
    return parts | flow_parts, metrics


def _change_loss(predicted: Array, changes: Array) -> Array:
    """Charbonnier of rises and falls in each part of the window, and of what they add up to."""
    up, down = jnp.split(predicted, 2, -1)
    off = jnp.cumsum(up - down - changes, -1)
    return (losses.charbonnier(predicted - encoder.split_sign(changes)).mean()
            + losses.charbonnier(off).mean())


def _flow_losses(
    net: dict[str, Any], block: Block, changes: Array, y6: Array, even: Array, key: Array,
    config: TrainConfig,
) -> tuple[Metrics, Metrics]:
    """Losses of the flow at the given changes, forward and inverse, and of the spread."""
    c, flow_config = config.model, config.model.flow
    k_dequantise, k_latent = jax.random.split(key)
    u = architecture.condition(c, changes, block.context, y6)
    centre = architecture.centre(c, y6)
    # The small noise that keeps L_F finite on zero-inflated counts serves L_P as well: a second
    # pass on clean voxels would cost another third of the step.
    noise = config.loss.dequantise * jax.random.normal(k_dequantise, block.voxels.shape)
    y, z, log_det = flow.forward(net["flow"], block.voxels + noise, u, flow_config)
    y = y + centre
    latent = jax.random.normal(k_latent, z.shape)
    plain = dataclasses.replace(flow_config, asinh=False)  # stops before sinh, which can overflow
    generated, inverse_det = flow.inverse(net["flow"], block.y - centre, latent, u, plain)
    if not flow_config.asinh:
        generated = jnp.arcsinh(generated)
    # Events are made from a video's own changes. In the encoder's, a pixel's excess of events is
    # part of the code already, so that its thresholds would come to matter less.
    share = jnp.where(even[:, 0], 2.0, 0.0) if c.code == "changes" else jnp.ones(())
    parts = {
        "parameter": _parameter_loss(y, block, config),
        "flow": losses.flow_loss(
            architecture.log_normal(y, y6[..., :4], architecture.base_std(y6)).sum(-1) if c.pool
            else jnp.zeros(log_det.shape),
            architecture.log_normal(z, 0.0, jnp.ones(())).sum(-1), log_det).mean(),
        "event": (share * _event_loss(generated, block, config.loss)).mean(),
        "inverse_flow": losses.inverse_flow_loss(inverse_det).mean(),
    }
    if c.code == "changes":
        spread = architecture.spread(net, block.voxels, block.dlogI, block.context, u)
        nll = losses.gaussian_nll(jax.lax.stop_gradient(y) - block.y, spread).mean((1, 2, 3))
        parts["spread"] = jnp.where(even[:, 0], 0.0, 2.0 * nll).mean()
    return parts, {"pixel/y": jnp.abs(y - block.y).mean(), "max_z": jnp.abs(z).max()}


def _event_loss(generated: Array, block: Block, config: LossConfig) -> Array:
    """L_E of each block, (B,)."""
    if config.events == "rate":
        return losses.rate_loss(generated, block.voxels, _expected(block), config.patches)
    return losses.event_loss(generated, block.voxels, block.changes.sum(-1), config.patches,
                             config.edge)


def _expected(block: Block) -> Array:
    """Events that each bin holds on average, (B, h, w, 2m): a pixel's changes in units of its
    thresholds, and its noise."""
    camera = squash(block.y)
    up, down = jnp.split(encoder.split_sign(block.changes), 2, -1)
    bins = block.changes.shape[-1]
    bin_s = pooling.WINDOW_S * jnp.exp(block.context[..., 0]) / bins
    on = up / camera.theta_on[..., None] + (camera.eta_on * bin_s)[..., None]
    off = down / camera.theta_off[..., None] + (camera.eta_off * bin_s)[..., None]
    return jnp.concatenate([on, off], -1)


def _parameter_loss(y: Array, block: Block, config: TrainConfig) -> Array:
    confidence: Array | float = 1.0
    if config.loss.confidence:
        confidence = losses.confidence_weight(block.voxels)[:, None, None]
    if config.model.output == "tanh":
        return losses.parameter_loss(jnp.tanh(y), jnp.tanh(block.y), confidence).mean()
    return losses.parameter_loss(y, block.y, confidence).mean()


def total_loss(parts: Metrics, weights: LossConfig) -> Array:
    """L_forward + L_inverse (Eq. 11). L_I enters both directions in the paper; once here, with
    its weight. Adaptive scaling keeps each part within 0..10."""
    total = jnp.zeros(())
    for name, part in parts.items():
        scale = losses.adaptive_weight(part) if weights.adaptive else 1.0
        total += getattr(weights, name) * scale * part
    return total


def loss_fn(
    params: dict[str, Any], batch: Batch, key: Array, config: TrainConfig
) -> tuple[Array, Metrics]:
    """The whole objective on one batch, and its parts."""
    net = next(iter(params.values()))
    k_block, k_summary, k_pixels = jax.random.split(key, 3)
    known = unsquash_summary(batch.nominal)
    parts: Metrics = {}
    metrics: Metrics = {}
    if "summary" in config.parts:
        parts["summary"], y, metrics = summary_losses(net, batch, k_summary, config)
        seen = jax.lax.stop_gradient(y)
    else:
        seen = known + config.summary_noise * jax.random.normal(k_summary, known.shape)
    if set(config.parts) - {"summary"}:
        block = cut_block(k_block, batch, config)
        pixel_parts, pixel_metrics = pixel_losses(net, block, known, seen, k_pixels, config)
        parts |= pixel_parts
        metrics |= pixel_metrics
    total = total_loss(parts, config.loss)
    return total, {"loss": total, **{f"loss/{k}": v for k, v in parts.items()}, **metrics}


def step_key(state: TrainState, use: Literal["losses", "data"]) -> Array:
    """The key of a step's random numbers, by what they are for."""
    kind = jax.random.fold_in(state.key, ("losses", "data").index(use))
    return jax.random.fold_in(kind, state.step)


def make_train_step(
    config: TrainConfig, tx: optax.GradientTransformation
) -> Callable[[TrainState, Batch], tuple[TrainState, Metrics]]:
    """train_step(state, batch) -> (state, metrics), to be jitted by the caller."""

    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        key = step_key(state, "losses")
        grad = jax.value_and_grad(loss_fn, has_aux=True)
        (_, metrics), grads = grad(state.params, batch, key, config)
        updates, opt_state = tx.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        decay = jnp.minimum(config.ema, (1.0 + state.step) / (10.0 + state.step))
        average = jax.tree.map(lambda a, p: decay * a + (1.0 - decay) * p, state.average, params)
        metrics["grad_norm"] = optax.tree.norm(grads)
        return TrainState(state.step + 1, params, average, opt_state, state.key), metrics

    return train_step


def make_run_step(
    config: TrainConfig, tx: optax.GradientTransformation
) -> Callable[[TrainState, TextureBank], tuple[TrainState, Metrics]]:
    """Data and step in one program: run_step(state, bank), batch drawn from (key, step)."""
    train_step = make_train_step(config, tx)

    def run_step(state: TrainState, bank: TextureBank) -> tuple[TrainState, Metrics]:
        return train_step(state, sample_batch(step_key(state, "data"), bank, config))

    return run_step

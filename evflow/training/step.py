"""Training: one step on the objective (objective.py). No loop lives here.

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

from evflow.network import architecture, encoder, flow
from evflow.network.coordinates import unsquash_summary
from evflow.scenes import TextureBank
from evflow.training.batch import Batch, sample_batch
from evflow.training.config import TrainConfig
from evflow.training.objective import Metrics, cut_block, loss_fn, over

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """step (int32), params and their exponential moving average, optimiser state, typed key."""

    step: Array
    params: dict[str, Any]
    average: dict[str, Any]
    opt_state: Any
    key: Array


def optimiser(config: TrainConfig) -> optax.GradientTransformation:
    """Adam with warm-up and cosine decay, gradients clipped per part: those of the flow's
    likelihood are 50 times the summary's, which a common clip would suppress."""

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
    y = over(unsquash_summary(batch.nominal), block.y)
    net = params[name]
    changes = encoder.split_sign(block.changes)
    if config.model.code == "feature":
        changes, _ = architecture.encode_changes(config.model, net, block.voxels, block.dlogI,
                                          block.context, y)
    u = architecture.condition(config.model, changes, block.context, y)
    net["flow"] = flow.data_init(net["flow"], block.voxels, u, config.model.flow)
    # Copied, as the train step donates its state, and a buffer can be donated only once. One
    # program for the tree, not one per shape of the leaves.
    average = jax.jit(lambda tree: jax.tree.map(jnp.copy, tree))(params)
    return TrainState(jnp.zeros((), jnp.int32), params, average, jax.jit(tx.init)(params), k_run)


def step_key(state: TrainState, use: Literal["losses", "data"]) -> Array:
    """The key of a step's random numbers, for losses or data."""
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

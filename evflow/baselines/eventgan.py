"""EventGAN: event volumes from two frames, by a network trained against a critic.

Zhu, Wang, Khant, Daniilidis, "EventGAN: Leveraging Large Scale Image Datasets for Event Cameras"
(ICCP 2021). A U-Net turns two frames into a volume of counts; a patch critic (hinge loss) sees
volume and frames. For the cycle losses, two networks trained on true events predict the motion
(optical flow, photometric) and the second frame (reconstruction) from the volume. There is no
camera as an input: the events are typical of the cameras it was trained on.

Voxels are (..., H, W, 2 * bins), raw counts in [ON..., OFF...], as everywhere here; published are 9
bins and volumes scaled one by one, which loses the count. Published cycle networks are trained
before and frozen; here they are trained at the same time, on true volumes only, and their losses
are used from `cycle_from` on. Left out: spectral norm of residual blocks and decoders, leaky ReLUs.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from evflow.baselines.eventgan_losses import Pair, critic_loss, flow_loss, reconstruction_loss
from evflow.baselines.unet import KERNEL, UNet, fresh
from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.checks import require_seed
from evflow.errors import EvflowDataError
from evflow.light.log_maps import lin_log_inverse
from evflow.scenes import TextureBank
from evflow.training.batch import Batch, sample_batch
from evflow.training.config import NuisanceConfig, TrainConfig

Array = jax.Array
Params = dict[str, Any]
Metrics = dict[str, Array]

STRIDED = 3  # layers of the critic that halve (published: 4, of crops of 256 x 320 px)


DATA = TrainConfig(
    prior=CameraPrior(), nuisances=NuisanceConfig.none(), sensors=(SensorModel(),), scenes=8,
    cameras=1, windows=1, window_s=(0.02, 0.06))


@dataclasses.dataclass(frozen=True)
class GanConfig:
    """One training run; the content of step i depends on (config, i) alone.

    data: the simulated windows (`evflow.training.batch`); bins follow its model. base, encoders:
    of the generator; critic: features of the critic's first layer; scales: predictions of the cycle
    networks. paired: weight of the L1 distance to the simulated volume of the same frames; 0 as
    published, more for the strongest fair reading, as a simulator gives pairs.
    Raises EV020 for a seed of more than 32 bits.
    """

    data: TrainConfig = DATA
    base: int = 32
    encoders: int = 4
    critic: int = 64
    scales: int = 4
    adversarial: float = 1.0
    flow: float = 1.0
    reconstruction: float = 1.0
    paired: float = 0.0
    cycle_from: int = 1000
    generator_rate: float = 2e-4
    critic_rate: float = 5e-5
    cycle_rate: float = 2e-4
    steps: int = 50_000
    seed: int = 0

    def __post_init__(self) -> None:
        require_seed(self)

    @property
    def bins(self) -> int:
        return self.data.model.bins


_SMALL = dataclasses.replace(DATA, crop=48, scenes=6, textures=96)
SMALL = GanConfig(data=_SMALL, base=12, encoders=3, critic=16, scales=2, cycle_from=200,
                  generator_rate=1e-3, critic_rate=2.5e-4, cycle_rate=1e-3, steps=2000)
GANS = {  # "small": for two cores
    "published": GanConfig(),
    "small": SMALL,
    "small paired": dataclasses.replace(SMALL, paired=10.0),
    "debug": GanConfig(
        data=dataclasses.replace(_SMALL, crop=16, scenes=4, textures=8), base=4, encoders=1,
        critic=4, scales=1, cycle_from=0, generator_rate=3e-3, cycle_rate=3e-3, steps=4),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GanState:
    """step (int32); params and opt_state of "generator", "critic", "flow", "reconstruction";
    typed key."""

    step: Array
    params: dict[str, Params]
    opt_state: dict[str, Any]
    key: Array


class PatchCritic(nn.Module):
    """Logits (..., h, w) of volumes with their frames (..., H, W, C)."""

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for i in range(STRIDED + 1):
            stride = 2 if i < STRIDED else 1
            x = nn.Conv(self.features << i, (4, 4), (stride, stride), kernel_init=KERNEL,
                        name=f"critic_{i}")(x)
            x = nn.leaky_relu(x, 0.2)
        return nn.Conv(1, (4, 4), kernel_init=KERNEL, name="critic_logits")(x)[..., 0]


def networks(config: GanConfig) -> dict[str, nn.Module]:
    """By the names of `GanState.params`."""
    def unet(outputs: int, scales: int) -> UNet:
        return UNet(outputs, config.base, config.encoders, scales)

    return {"generator": unet(2 * config.bins, 1), "critic": PatchCritic(config.critic),
            "flow": unet(2, config.scales), "reconstruction": unet(1, config.scales)}


def generate(params: Params, frame0: Array, frame1: Array) -> Array:
    """Voxels (..., H, W, 2*bins), >= 0, between two frames (..., H, W) in DN 0..255 of any size.
    params: of the generator, whose structure follows from their shapes. Raises EV002."""
    if frame0.shape != frame1.shape or frame0.ndim < 2:
        raise EvflowDataError("EV002", f"the frames are {frame0.shape} and {frame1.shape}.",
                              "Expected two of one shape (..., H, W).")
    encoders = sum(name.startswith("encoder_") for name in params)
    network = UNet(params["prediction_0"]["kernel"].shape[-1],
                   params["head"]["kernel"].shape[-1], encoders)
    frames = jnp.stack([jnp.asarray(f, jnp.float32) for f in (frame0, frame1)], -1)
    return _volume(network, params, scaled(frames))


def scaled(dn: Array) -> Array:
    """DN 0..255 -> -1..1."""
    return dn / 127.5 - 1.0


def _volume(network: nn.Module, params: Params, frames: Array) -> Array:
    return nn.relu(predictions(network, params, frames)[-1])


def predictions(network: nn.Module, params: Params, x: Array) -> list[Array]:
    found: Any = network.apply({"params": params}, x)
    return found


def make_pairs(batch: Batch) -> Pair:
    """All windows of a batch separately, with the frames of its dlogI."""
    half = 0.5 * batch.dlogI
    frames = jnp.stack([batch.intensity - half, batch.intensity + half], -1)
    frames, voxels = (a.reshape(-1, *a.shape[2:]) for a in (frames, batch.voxels))
    return Pair(scaled(lin_log_inverse(frames)), voxels)


def optimisers(config: GanConfig) -> dict[str, optax.GradientTransformation]:
    """RAdam without momentum for the two adversaries, as published."""
    cycle = optax.radam(config.cycle_rate)
    return {"generator": optax.radam(config.generator_rate, b1=0.0),
            "critic": optax.radam(config.critic_rate, b1=0.0),
            "flow": cycle, "reconstruction": cycle}


@partial(jax.jit, static_argnames="config")
def init_state(config: GanConfig) -> GanState:
    """Fresh state."""
    side, volume = config.data.crop, 2 * config.bins
    channels = {"generator": 2, "critic": volume + 2, "flow": volume, "reconstruction": 2}
    *keys, k_run = jax.random.split(jax.random.key(config.seed), 5)
    params = {
        name: fresh(key, network, jnp.zeros((1, side, side, channels[name])))
        for key, (name, network) in zip(keys, networks(config).items(), strict=True)}
    opt_state = {name: tx.init(params[name]) for name, tx in optimisers(config).items()}
    return GanState(jnp.zeros((), jnp.int32), params, opt_state, k_run)


def cycle_losses(
    config: GanConfig, params: dict[str, Params], pair: Pair, volume: Array
) -> Metrics:
    """Losses of the motion and the second frame that the cycle networks predict from a volume."""
    nets = networks(config)
    summed = jnp.stack([volume.sum(-1), pair.frames[..., 0]], -1)
    return {"flow": flow_loss(predictions(nets["flow"], params["flow"], volume), pair),
            "reconstruction": reconstruction_loss(
                predictions(nets["reconstruction"], params["reconstruction"], summed), pair)}


@partial(jax.jit, static_argnames="config")
def train_step(state: GanState, pair: Pair, config: GanConfig) -> tuple[GanState, Metrics]:
    """One step on one batch: the critic twice, on generated and true volumes of different halves;
    the generator once; the cycle networks once, on true volumes."""
    nets, txs, keys = networks(config), optimisers(config), jax.random.split(
        jax.random.fold_in(jax.random.fold_in(state.key, 0), state.step), 2)
    params, opts, metrics = dict(state.params), dict(state.opt_state), {}

    def update(name: str, slope: Params) -> None:
        change, opts[name] = txs[name].update(slope, opts[name], params[name])
        params[name] = optax.apply_updates(params[name], change)

    def made(generator: Params) -> Array:
        return _volume(nets["generator"], generator, pair.frames)

    beside = jnp.concatenate([made(params["generator"]), pair.frames], -1)
    true = jnp.concatenate([pair.voxels, pair.frames], -1)
    half = len(true) // 2
    for key, (first, second) in zip(keys, ((slice(half), slice(half, 2 * half)),
                                           (slice(half, 2 * half), slice(half))), strict=True):
        metrics["critic"], slope = jax.value_and_grad(critic_loss)(
            params["critic"], nets["critic"], key, beside[first], true[second])
        update("critic", slope)

    started = (state.step >= config.cycle_from).astype(jnp.float32)

    def generator_loss(generator: Params) -> tuple[Array, Metrics]:
        volume = made(generator)
        fooled: Any = nets["critic"].apply(
            {"params": params["critic"]}, jnp.concatenate([volume, pair.frames], -1))
        parts = cycle_losses(config, params, pair, volume) | {
            "adversarial": -fooled.mean(), "paired": jnp.abs(volume - pair.voxels).mean()}
        total = config.adversarial * parts["adversarial"] + config.paired * parts["paired"]
        total += started * (config.flow * parts["flow"]
                            + config.reconstruction * parts["reconstruction"])
        counts = volume.sum() / jnp.maximum(pair.voxels.sum(), 1.0)
        return total, parts | {"generator": total, "count_ratio": counts}

    slope, more = jax.grad(generator_loss, has_aux=True)(params["generator"])
    metrics |= more

    def cycle_loss(cycle: dict[str, Params]) -> tuple[Array, Metrics]:
        parts = cycle_losses(config, cycle, pair, pair.voxels)
        return parts["flow"] + parts["reconstruction"], {f"true_{k}": v for k, v in parts.items()}

    cycle = {name: params[name] for name in ("flow", "reconstruction")}
    cycle_slope, more = jax.grad(cycle_loss, has_aux=True)(cycle)
    update("generator", slope)
    for name, value in cycle_slope.items():
        update(name, value)
    return GanState(state.step + 1, params, opts, state.key), metrics | more


def run_step(state: GanState, bank: TextureBank, config: GanConfig) -> tuple[GanState, Metrics]:
    """`train_step` on the windows of this step."""
    key = jax.random.fold_in(jax.random.fold_in(state.key, 1), state.step)
    return train_step(state, pairs_of(key, bank, config), config)


@partial(jax.jit, static_argnames="config")
def pairs_of(key: Array, bank: TextureBank, config: GanConfig) -> Pair:
    """Fresh windows of fresh scenes and cameras."""
    return make_pairs(sample_batch(key, bank, config.data))

"""One training step of the event networks, including simulation.

    step = jax.jit(make_step(network, config, tx))
    state, metrics = step(state, bank)

A step draws its sequences from fold_in(state.key, state.step), so that a resumed run repeats the
uninterrupted one. Nothing touches the disk.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from evflow.camera import Camera
from evflow.checks import require, require_seed
from evflow.downstream import losses
from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.network import Network, Params, run
from evflow.downstream.simulated import SequenceConfig, Sequences, has_events, sample_sequences
from evflow.errors import EvflowDataError
from evflow.scenes import TextureBank

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class LearningConfig:
    """data: the sequences. steps, warmup, rate, clip: Adam whose rate rises for `warmup` steps
    and falls as a cosine, gradients clipped to a norm. temporal: weight of temporal consistency,
    after the first `skip` images. elsewhere: weight, in the L1 of flow, of pixels with at most one
    net event (`has_events`). normalised: event tensors of std 1, which hides the scale of the
    camera's thresholds. seed: of params and data."""

    data: SequenceConfig = dataclasses.field(default_factory=SequenceConfig)
    steps: int = 300
    warmup: int = 10
    rate: float = 3e-3
    clip: float = 1.0
    temporal: float = 0.2
    skip: int = 2
    elsewhere: float = 1.0
    normalised: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"steps": 1, "warmup": 0, "rate": 0.0, "clip": 0.0, "temporal": 0.0, "skip": 0,
                 "elsewhere": 0.0}
        for name, bound in least.items():
            fit = bound <= getattr(self, name) < math.inf  # NaN is below nothing
            require(self, name, fit, f">= {bound}, and finite")
        require_seed(self)
        if self.skip + 2 > self.data.windows:
            raise EvflowDataError("EV020", f"skip={self.skip} of {self.data.windows} windows.",
                                  "Temporal consistency needs two images after those skipped.")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LearningState:
    """step (int32), params, optimiser state, typed key."""

    step: Array
    params: Params
    opt_state: Any
    key: Array


def optimiser(config: LearningConfig) -> optax.GradientTransformation:
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.rate, config.warmup, max(config.steps, config.warmup + 1))
    return optax.chain(optax.clip_by_global_norm(config.clip), optax.adam(schedule))


def init_state(
    network: Network, config: LearningConfig, tx: optax.GradientTransformation,
    params: Params | None = None,
) -> LearningState:
    """The state before the first step; params: to start from, or None for fresh ones."""
    k_params, k_run = jax.random.split(jax.random.key(config.seed))
    if params is None:
        params = network.init(k_params, (config.data.crop, config.data.crop))
    return LearningState(jnp.zeros((), jnp.int32), params, tx.init(params), k_run)


def make_step(
    network: Network, config: LearningConfig, tx: optax.GradientTransformation,
    sample: Callable[..., Sequences] = sample_sequences,
) -> Callable[..., tuple[LearningState, dict[str, Array]]]:
    """step(state, bank, camera=None, lpips_params=None) -> (state, metrics), pure; jit it.

    camera: maps of the camera or cameras to train for, None for cameras of the prior;
    lpips_params: of `load_lpips`, None for L1 + SSIM; sample(key, bank, config.data, camera): a
    batch. metrics: "loss" and its parts.
    Raises EV020 where network and data differ in their bins.
    """
    if network.bins != config.data.bins:
        raise EvflowDataError("EV020", f"the network has {network.bins} bins, the data "
                              f"{config.data.bins}.", "Give both the same.")
    if config.data.crop % network.stride and isinstance(network, EVFlowNet) and network.scales > 1:
        raise EvflowDataError("EV020", f"crop={config.data.crop} with four scales of flow.",
                              f"Choose a multiple of {network.stride}.")

    def step(
        state: LearningState, bank: TextureBank, camera: Camera | None = None,
        lpips_params: Params | None = None,
    ) -> tuple[LearningState, dict[str, Array]]:
        key = jax.random.fold_in(state.key, state.step)
        sequences = sample(key, bank, config.data, camera)

        def loss(params: Params) -> tuple[Array, dict[str, Array]]:
            return sequence_loss(network, params, sequences, config, lpips_params)

        grads, metrics = jax.grad(loss, has_aux=True)(state.params)
        updates, opt_state = tx.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics["gradient"] = optax.tree.norm(grads)
        return LearningState(state.step + 1, params, opt_state, state.key), metrics

    return step


def sequence_loss(
    network: Network, params: Params, sequences: Sequences, config: LearningConfig,
    lpips_params: Params | None = None,
) -> tuple[Array, dict[str, Array]]:
    """The loss of a network on sequences, and its parts: L1 of the flow for EV-FlowNet, the
    photometric loss if it has four scales; else reconstruction and temporal consistency."""
    tensors = sequences.given(config.normalised)
    if isinstance(network, EVFlowNet):
        loss = _flow_loss(network, params, tensors, sequences, config.elsewhere)
        return loss, {"loss": loss}
    images, _ = run(network, params, tensors, train=True)
    seen = losses.reconstruction(images, sequences.frames, lpips_params)
    steady = losses.temporal(
        images, sequences.frames, sequences.back, sequences.visible, config.skip)
    total = seen + config.temporal * steady
    return total, {"loss": total, "reconstruction": seen, "temporal": steady}


def _flow_loss(
    network: EVFlowNet, params: Params, tensors: Array, sequences: Sequences, elsewhere: float
) -> Array:
    """All windows as one batch, as the network has no memory."""
    if network.scales == 1:
        flow, _ = network.apply(params, tensors)
        weight = jnp.where(has_events(sequences.tensors), 1.0, elsewhere)
        return losses.flow_l1(flow, sequences.flow, weight)
    return losses.photometric(
        network.pyramid(params, tensors), sequences.before, sequences.frames)

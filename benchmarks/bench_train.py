"""One training step of the `default` preset, the share of making its data, and the flow's gradient.

The peer of the gradient is the same likelihood in eager PyTorch with autograd (peer_torch.py), at
the number of pixels that one step gives the flow. GFLOP counts backward as twice forward.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.bench_estimate import dense_flop, fresh
from benchmarks.harness import Case, Setting, Workload
from evflow.network import flow
from evflow.network.architecture import log_normal
from evflow.scenes import make_bank
from evflow.training.batch import sample_batch
from evflow.training.config import PRESETS, TrainConfig
from evflow.training.step import init_state, make_run_step, make_train_step, optimiser

TEXTURES = 8  # procedural ones in the bank; their number does not change what a step does


def _config(setting: Setting) -> TrainConfig:
    return PRESETS["debug" if setting.quick else "default"]


def _bank(setting: Setting) -> Any:
    return make_bank(jax.random.key(1), TEXTURES, photos=False, size=64 if setting.quick else 256)


def run_step(setting: Setting) -> Workload:
    """A step as the training loop runs it: data and update in one program, state donated."""
    config, bank = _config(setting), _bank(setting)
    tx = optimiser(config)
    step = jax.jit(make_run_step(config, tx), donate_argnums=0)
    return _chain(config, init_state(config, tx, bank, "default"), lambda state: step(state, bank))


def train_step(setting: Setting) -> Workload:
    """The update alone, on one batch again and again."""
    config, bank = _config(setting), _bank(setting)
    tx = optimiser(config)
    batch = jax.jit(sample_batch, static_argnames="config")(jax.random.key(2), bank, config)
    step = jax.jit(make_train_step(config, tx), donate_argnums=0)
    return _chain(config, init_state(config, tx, bank, "default"), lambda state: step(state, batch))


def _chain(config: TrainConfig, state: Any, step: Any) -> Workload:
    """Calls of step, each on the state that the one before returned."""
    held = [state]

    def call() -> Any:
        held[0], metrics = step(held[0])
        return held[0].step, metrics

    return Workload(call, lambda _: _step_work(config))


def data(setting: Setting) -> Workload:
    config, bank = _config(setting), _bank(setting)
    make = jax.jit(sample_batch, static_argnames="config")
    return Workload(lambda: make(jax.random.key(2), bank, config), lambda _: _step_work(config))


def _step_work(config: TrainConfig) -> dict[str, float]:
    sequences = config.scenes * config.cameras
    return {"steps": 1, "scenes": config.scenes, "windows": sequences * config.windows}


def _pixels(config: TrainConfig) -> int:
    return config.scenes * config.cameras * config.block[0] * config.block[1]


def _flow_inputs(config: TrainConfig) -> tuple[Any, jax.Array, jax.Array]:
    n, model = _pixels(config), config.model
    k_voxels, k_u = jax.random.split(jax.random.key(3))
    x = jax.random.poisson(k_voxels, 0.1, (n, 2 * model.bins)).astype(jnp.float32)
    u = jax.random.normal(k_u, (n, model.flow.condition))
    return fresh(jax.random.key(0), model), x, u


def _gradient_work(config: TrainConfig, params: Any) -> Any:
    pixels = _pixels(config)
    return lambda _: {"pixels": pixels, "GFLOP": 3e-9 * pixels * dense_flop(params, "flow")}


def gradient_evflow(setting: Setting) -> Workload:
    config = _config(setting)
    params, x, u = _flow_inputs(config)

    def nll(net: Any, x: jax.Array, u: jax.Array) -> jax.Array:
        y, z, log_det = flow.forward(net, x, u, config.model.flow)
        prior = log_normal(jnp.concatenate([y, z], -1), 0.0, jnp.ones(())).sum(-1)
        return -jnp.mean(prior + log_det)

    gradient = jax.jit(jax.value_and_grad(nll))
    net = next(iter(params.values()))["flow"]
    return Workload(lambda: gradient(net, x, u), _gradient_work(config, params))


def gradient_torch(setting: Setting) -> Workload:
    import torch

    from benchmarks import peer_torch

    config = _config(setting)
    params, *arrays = _flow_inputs(config)
    x, u = (torch.tensor(np.asarray(a)) for a in arrays)
    net = peer_torch.weights(next(iter(params.values()))["flow"])
    leaves = [leaf.requires_grad_() for leaf in jax.tree.leaves(net)]

    def call() -> Any:
        loss = peer_torch.nll(net, x, u, config.model.flow)
        return loss.detach(), torch.autograd.grad(loss, leaves)

    return Workload(call, _gradient_work(config, params))


CASES = (
    Case("train", "step", "evflow, data and update", run_step),
    Case("train", "step", "evflow, update alone", train_step),
    Case("train", "step", "evflow, data alone", data),
    Case("train", "flow, forward and backward", "evflow", gradient_evflow),
    Case("train", "flow, forward and backward", "torch, eager", gradient_torch, needs="torch"),
)

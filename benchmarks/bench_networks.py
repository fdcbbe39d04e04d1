"""One training step of FireNet, as published (base 16), and of the small E2VID: T windows unrolled,
L1, backward, Adam; from the same weights, on the same random windows.

The peer is the same step in PyTorch on all cores (peer_torch_networks.py): eager with channels
last and first, and compiled. "pixels" counts one pixel of one window of one sequence.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from benchmarks.harness import Case, Setting, Workload
from evflow.downstream import FireNet, Network, run
from evflow.downstream.e2vid import E2VID_SMALL

Shape = tuple[int, int, int]

RATE = 1e-4
# Windows, sequences, side. LARGE has the crop and the batch of the preset `published`, whose 40
# windows would take 4 GB; SMALL is that of `small`, by which FireNet trains on two cores.
LARGE, SMALL, TINY = (10, 4, 128), (14, 4, 48), (3, 2, 16)


def data(shape: Shape) -> tuple[jax.Array, jax.Array]:
    """Voxels (T, B, H, W, 5), two thirds of them 0, and images (T, B, H, W) on [0, 1]."""
    windows, sequences, side = shape
    k_voxels, k_images = jax.random.split(jax.random.key(0))
    size = (windows, sequences, side, side)
    voxels = jax.random.normal(k_voxels, (*size, 5))
    return voxels * (jnp.abs(voxels) > 1), jax.random.uniform(k_images, size)


def loss(network: Network, params: Any, voxels: jax.Array, images: jax.Array) -> jax.Array:
    return jnp.mean(jnp.abs(run(network, params, voxels, train=True)[0] - images))


def start(network: Network) -> Any:
    return network.init(jax.random.key(1), (16, 16))


def _work(shape: Shape) -> dict[str, float]:
    windows, sequences, side = shape
    return {"steps": 1, "pixels": windows * sequences * side**2}


def step_evflow(setting: Setting, network: Network, shape: Shape) -> Workload:
    shape = TINY if setting.quick else shape
    voxels, images = data(shape)
    tx = optax.adam(RATE)

    @partial(jax.jit, donate_argnums=(0, 1))
    def step(params: Any, state: Any) -> tuple[Any, Any, jax.Array]:
        value, gradient = jax.value_and_grad(partial(loss, network))(params, voxels, images)
        updates, state = tx.update(gradient, state)
        return optax.apply_updates(params, updates), state, value

    params = start(network)
    held = [(params, tx.init(params))]

    def call() -> jax.Array:
        *state, value = step(*held[0])
        held[0] = state
        return value

    return Workload(call, lambda _: _work(shape))


def step_torch(setting: Setting, network: Network, shape: Shape, last: bool = True,
               compiled: bool = False) -> Workload:
    """last: channels last; compiled: by torch.compile (eager with --quick: it takes minutes)."""
    import torch

    from benchmarks.peer_torch_networks import Trainer

    shape = TINY if setting.quick else shape
    layout = torch.channels_last if last else torch.contiguous_format
    trainer = Trainer(network, start(network), *data(shape), rate=RATE, layout=layout,
                      compiled=compiled and not setting.quick)
    return Workload(trainer.step, lambda _: _work(shape), f"{torch.get_num_threads()} threads")


def _cases(name: str, network: Network, shape: Shape) -> tuple[Case, ...]:
    task = f"{name}, {shape[0]} windows of {shape[1]}x{shape[2]}x{shape[2]}"
    given: dict[str, Any] = {"network": network, "shape": shape}
    return (
        Case("networks", task, "evflow", partial(step_evflow, **given)),
        Case("networks", task, "torch, eager, channels last", partial(step_torch, **given),
             needs="torch"),
        Case("networks", task, "torch, eager, channels first",
             partial(step_torch, **given, last=False), needs="torch"),
        Case("networks", task, "torch.compile, channels last",
             partial(step_torch, **given, compiled=True), needs="torch"),
    )


CASES = (*_cases("FireNet", FireNet(), LARGE), *_cases("FireNet", FireNet(), SMALL),
         *_cases("small E2VID", E2VID_SMALL, SMALL))

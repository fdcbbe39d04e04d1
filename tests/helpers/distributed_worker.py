"""One process of a small run, for test_distributed: what it saw and what it learned, as .npz.

    python distributed_worker.py OUT STEPS [HOST:PORT PROCESSES PROCESS_ID]

OUT.ID.npz holds this process' shards of a batch, the gradients of the first step and the parameters
after STEPS, under "batch.LEAF/FIRST_ROW" and so on; OUT.ID.txt the program that each device runs.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from helpers.networks import small_config

from evflow.camera.sensors import SensorModel
from evflow.process import devices
from evflow.scenes import make_bank
from evflow.training.batch import sample_batch
from evflow.training.step import init_state, make_run_step, optimiser

CONFIG = dataclasses.replace(
    small_config(steps=40, warmup=2), scenes=4,
    sensors=(SensorModel(eta_intensity=True), SensorModel(noise_resets_memory=True)))


def keep_gradients() -> optax.GradientTransformation:
    """Keeps the last gradients in the optimiser's state."""
    return optax.GradientTransformation(lambda p: jax.tree.map(jnp.zeros_like, p),
                                        lambda grads, _, params=None: (grads, grads))


def named(prefix: str, tree: Any) -> dict[str, np.ndarray]:
    return {f"{prefix}{jax.tree_util.keystr(path)}/0": np.atleast_1d(leaf)
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def main(out: str, steps: int, coordinator: str | None = None, *which: str) -> None:
    devices.initialise(coordinator, *map(int, which))
    mesh = devices.make_mesh()
    tx = optax.chain(keep_gradients(), optimiser(CONFIG))
    bank = make_bank(jax.random.key(0), 4, photos=False, size=64, cutout_size=32)
    state = init_state(CONFIG, tx, bank, "default")
    state, bank = devices.replicate((state, bank), mesh)
    with jax.set_mesh(mesh):
        batch = jax.jit(sample_batch, static_argnums=2)(jax.random.key(1), bank, CONFIG)
    results = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(batch):
        for shard in leaf.addressable_shards:
            row = shard.index[0].start or 0
            results[f"batch{jax.tree_util.keystr(path)}/{row}"] = np.asarray(shard.data)
    step = devices.parallel(make_run_step(CONFIG, tx), mesh)
    for i in range(steps):
        state, _ = step(state, bank)
        if i == 0:
            results |= named("gradients", state.opt_state[0])
    results |= named("params", state.params)
    program = step.lower(state, bank).compile().as_text()  # compiled above
    np.savez(f"{out}.{jax.process_index()}.npz", **results)
    with open(f"{out}.{jax.process_index()}.txt", "w") as file:
        file.write(program)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])

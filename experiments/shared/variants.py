"""Trainings that differ in one thing, and their scores: what `experiments.ablate` compares.

A variant sees one pixel's window and nothing else of its camera (or, of our network, what its own
summary makes of the window). One compiled step serves all seeds and learning rates.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from evflow.network import architecture, flow
from evflow.network.coordinates import squash
from evflow.network.weights import save_weights
from evflow.process.provenance import provenance
from evflow.scenes import TextureBank
from evflow.training.batch import Batch, sample_batch
from evflow.training.config import TrainConfig, as_dict
from evflow.training.objective import Block, cut_block, summary_losses
from evflow.training.step import init_state, make_run_step, optimiser

Array = jax.Array
Row = dict[str, Any]
RATES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # times the preset's, 1e-3 (flow 5e-4)
NAMES = ("theta_on", "theta_off", "eta_on", "eta_off")


class Trainer:
    """Trainings of one configuration, of any seed and learning rate."""

    def __init__(self, config: TrainConfig, bank: TextureBank) -> None:
        self.config, self.bank = config, bank
        self.name = "default" if config.model.pool else "paper"
        # Adam's step is proportional to its rate: the factor is a number of the state, so that
        # another rate is no other program.
        factor = optax.inject_hyperparams(optax.scale)(step_size=1.0)
        self._tx = optax.chain(optimiser(config), factor)
        self._step = jax.jit(make_run_step(config, self._tx), donate_argnums=0)

    def trained(self, seed: int, rate: float) -> tuple[dict[str, Any], float]:
        """Averaged parameters after config.steps at `rate` times the configuration's rates, and the
        seconds that took, compilation aside."""
        config = dataclasses.replace(self.config, seed=seed)
        state = init_state(config, self._tx, self.bank, self.name)
        state.opt_state[1].hyperparams["step_size"] = jnp.asarray(rate)
        started = time.monotonic()
        for i in range(config.steps):
            state, metrics = self._step(state, self.bank)
            if i % 20 == 0:
                jax.block_until_ready(metrics)
            if i == 0:
                started = time.monotonic()
        jax.block_until_ready(state.step)
        return state.average, time.monotonic() - started


def make_errors(config: TrainConfig, bank: TextureBank) -> Callable[..., dict[str, Array]]:
    """errors(key, net): figures of a held-out batch, to be averaged over batches."""

    @jax.jit
    def errors(key: Array, net: dict[str, Any]) -> dict[str, Array]:
        k_batch, k_block, k_summary, k_z = jax.random.split(key, 4)
        batch = sample_batch(k_batch, bank, config)
        block = cut_block(k_block, batch, config)
        y6 = jnp.zeros((*block.dlogI.shape, 6))
        if config.model.pool:
            y6 = architecture.over_pixels(
                summary_losses(net, batch, k_summary, config)[1], block.dlogI.shape)
        model = config.model
        changes, _ = architecture.encode_changes(
            model, net, block.voxels, block.dlogI, block.context, y6)
        u = architecture.condition(model, changes, block.context, y6)
        centre = architecture.centre(model, y6)
        y, z, log_det = flow.forward(net["flow"], block.voxels, u, model.flow)
        made, _ = flow.inverse(
            net["flow"], block.y - centre, jax.random.normal(k_z, z.shape), u, model.flow)
        density = architecture.log_normal(z, 0.0, jnp.ones(())).sum(-1) + log_det
        camera = squash(y + centre, model.output)
        seen = {name: getattr(camera, name) for name in NAMES}
        return away(seen, batch, block, config) | {
            "events": made.sum() / block.voxels.sum(), "log p(z)": density.mean()}

    return errors


def away(
    seen: dict[str, Array], batch: Batch, block: Block, config: TrainConfig
) -> dict[str, Array]:
    """Mean absolute errors of parameters by NAMES against the pixels' own and the sequence's."""
    true = squash(block.y, config.model.output)
    found: dict[str, Array] = {}
    for name in NAMES:
        nominal = getattr(batch.nominal, name)[:, None, None]
        found |= {f"pixel/{name}": jnp.abs(seen[name] - getattr(true, name)).mean(),
                  f"sequence/{name}": jnp.abs(seen[name] - nominal).mean()}
    return found


def score(errors: Callable[..., dict[str, Array]], net: Any, seed: int, batches: int) -> Row:
    """Means over held-out batches, the median of what may overflow."""
    keys = jax.random.split(jax.random.key(seed), batches)
    rows = [jax.device_get(errors(key, net)) for key in keys]
    return {k: float((np.median if k == "events" else np.mean)([r[k] for r in rows]))
            for k in rows[0]}


def error_of(row: Row) -> float:
    """What a rate is chosen by, the errors of the sequence; one that diverged is never chosen."""
    return float(sum(np.nan_to_num(row[f"sequence/{name}"], nan=np.inf) for name in NAMES))


def best_rate(error: Callable[[float], float]) -> float:
    """The rate of the least error, of RATES; from the middle outwards, until none beyond the best
    is left to try."""
    tried = {i: error(RATES[i]) for i in range(len(RATES) // 2 - 1, len(RATES) // 2 + 2)}
    while True:
        best = min(tried, key=lambda i: tried[i])
        beyond = {best - 1, best + 1} & set(range(len(RATES))) - set(tried)
        if not beyond:
            return RATES[best]
        tried |= {i: error(RATES[i]) for i in beyond}


def constant_row(config: TrainConfig, bank: TextureBank, held: TextureBank, seeds: tuple[int, int],
                 batches: int) -> Row:
    """Errors of the best constant: the medians over the batches of seeds[0] of `bank`, scored as
    the variants are, on those of seeds[1] of `held`."""

    @jax.jit
    def drawn(key: Array, bank: TextureBank) -> tuple[Batch, Block]:
        k_batch, k_block, _, _ = jax.random.split(key, 4)
        batch = sample_batch(k_batch, bank, config)
        block = cut_block(k_block, batch, config)
        return dataclasses.replace(batch, voxels=jnp.zeros(()), changes=jnp.zeros(())), block

    def keys(seed: int) -> Array:
        return jax.random.split(jax.random.key(seed), batches)

    nominals = [drawn(key, bank)[0].nominal for key in keys(seeds[0])]
    constant = {name: jnp.median(jnp.concatenate([getattr(n, name) for n in nominals]))
                for name in NAMES}
    held_out = (drawn(key, held) for key in keys(seeds[1]))
    rows = [away(constant, batch, block, config) for batch, block in held_out]
    return {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}


def save_estimator(path: Path, params: dict[str, Any], config: TrainConfig) -> None:
    """Keep a variant as weights that estimate."""
    save_weights(path, params, {"config": as_dict(config), **provenance()}, overwrite=True)

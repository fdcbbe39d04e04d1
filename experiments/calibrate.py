"""Fit the per-pixel std to held-out cameras, everything else frozen.

    python -m experiments.calibrate runs/default/weights.safetensors --out final.safetensors

A std learned while the estimate still improves is that of an older, worse estimate. Here the
estimate is final: the spread network is trained (Gaussian likelihood) on fresh simulated cameras
against the errors that remain when the camera's summary is known, as in `estimate_camera`.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import optax
import tyro

from evflow.network import architecture, flow
from evflow.network.api import config_of
from evflow.network.coordinates import unsquash_summary
from evflow.process.terminal import bar
from evflow.scenes import make_bank
from evflow.training import losses
from evflow.training.batch import Batch, sample_batch
from evflow.training.config import TrainConfig, preset
from evflow.training.objective import cut_block
from experiments.shared.common import at_least, run_script
from experiments.shared.weight_parts import begin_fit, save_part

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class Options:
    """Calibrate the per-pixel std of trained weights."""

    weights: tyro.conf.Positional[Path]
    out: Path
    steps: int = 300
    learning_rate: float = 1e-3
    seed: int = 2_000_003
    """Apart from training's, so that the cameras are held out."""
    overwrite: bool = False


def spread_loss(spread: Any, net: Any, batch: Batch, key: Array, config: TrainConfig) -> Array:
    """Gaussian likelihood of the pixel errors at the true summary."""
    net = {**net, "spread": spread}
    block = cut_block(key, batch, config)
    y6 = architecture.over_pixels(unsquash_summary(batch.nominal), block.y.shape[:-1])
    changes, _ = architecture.encode_changes(
        config.model, net, block.voxels, block.dlogI, block.context, y6)
    u = architecture.condition(config.model, changes, block.context, y6)
    y, _, _ = flow.forward(net["flow"], block.voxels, u, config.model.flow)
    error = jax.lax.stop_gradient(y + architecture.centre(config.model, y6)) - block.y
    std = architecture.spread(net, block.voxels, block.dlogI, block.context, u)
    return losses.gaussian_nll(error, std).mean()


def main(options: Options) -> float:
    at_least(1, steps=options.steps)
    name, net = begin_fit(options, "spread")
    config = dataclasses.replace(
        preset("default"), model=config_of({name: net}), block=(16, 16), windows=1)
    k_bank, k_data = jax.random.split(jax.random.key(options.seed))
    bank = make_bank(k_bank, config.textures)
    tx = optax.adam(optax.cosine_decay_schedule(options.learning_rate, options.steps))
    grad = jax.value_and_grad(partial(spread_loss, config=config))

    @jax.jit
    def step(spread: Any, opt_state: Any, key: Array) -> tuple[Any, Any, Array]:
        k_batch, k_block = jax.random.split(key)
        loss, grads = grad(spread, net, sample_batch(k_batch, bank, config), k_block)
        updates, opt_state = tx.update(grads, opt_state)
        return optax.apply_updates(spread, updates), opt_state, loss

    spread, losses_seen = net["spread"], []
    opt_state = tx.init(spread)
    with bar("calibrating") as progress:
        for i in range(options.steps):
            spread, opt_state, loss = step(spread, opt_state, jax.random.fold_in(k_data, i))
            losses_seen.append(float(loss))
            progress(i + 1, options.steps)
    tail = losses_seen[-options.steps // 10:]
    figures = {"first": losses_seen[0], "last_tenth": sum(tail) / len(tail)}
    print(f"negative log-likelihood: {figures['first']:.3f} -> {figures['last_tenth']:.3f}")
    save_part(options, name, net, {"spread": spread}, {"calibration": {
        "steps": options.steps, "seed": options.seed, "negative_log_likelihood": figures}})
    return figures["last_tenth"]


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""Errors of intensity changes within windows of simulated scenes, as the encoder is trained."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from evflow import encode
from evflow.process.terminal import bar
from evflow.scenes import make_bank
from evflow.training.batch import Batch, sample_batch
from evflow.training.config import preset
from experiments.shared.change_systems import LOG_255

Array = jax.Array
ACTIVE = 0.02  # log units: least mean absolute change of a window that counts


def errors(params: Any, batch: Batch) -> dict[str, Array]:
    """Sums of absolute errors of the change up to each part, over pixels of active windows."""
    window = {"window_s": batch.window_s, "intensity": batch.intensity[:, 0]}
    voxels, dlogI, changes = batch.voxels[:, 0], batch.dlogI[:, 0], batch.changes[:, 0]
    code = encode(params, voxels, dlogI, summary=batch.nominal, **window)
    up, down = jnp.split(code.changes, 2, -1)
    true = jnp.cumsum(changes, -1)
    on, off = jnp.split(voxels, 2, -1)
    theta_on, theta_off = (t[:, None, None, None]
                           for t in (batch.nominal.theta_on, batch.nominal.theta_off))
    parts = changes.shape[-1]
    found = {
        "encoder": jnp.cumsum(up - down, -1),
        "frames alone": jnp.stack([dlogI * (i + 1) / parts for i in range(parts)], -1),
        "events alone": jnp.cumsum(on * theta_on - off * theta_off, -1),
        "no change": jnp.zeros_like(true)}
    active = (jnp.abs(changes).sum(-1).mean((1, 2)) > ACTIVE).astype(true.dtype)
    return {"windows": active.sum(), **{
        k: (jnp.abs(v - true).mean((1, 2, 3)) * active).sum() for k, v in found.items()}}


def window_errors(params: Any, seed: int, count: int) -> dict[str, Any]:
    """Mean errors over the windows of so many batches of simulated scenes."""
    config = dataclasses.replace(preset("default"), windows=1)
    k_bank, k_data = jax.random.split(jax.random.key(seed))
    bank = make_bank(k_bank, 96, photos=False)
    step = jax.jit(lambda key: errors(params, sample_batch(key, bank, config)))
    total: dict[str, float] = {}
    with bar("batches") as progress:
        for i in range(count):
            made = jax.device_get(step(jax.random.fold_in(k_data, i)))
            total = {k: total.get(k, 0.0) + float(v) for k, v in made.items()}
            progress(i + 1, count)
    found = total.pop("windows")
    return {**{k: {"log": v / found, "log_255": v / found / LOG_255} for k, v in total.items()},
            "windows": found}

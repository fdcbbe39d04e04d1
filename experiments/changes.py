"""The conditional intensity-change encoder on simulated scenes (paper, Table XI).

    python -m experiments.changes --preset full

Frames give the change of a whole window; the encoder says how it came about. Scored is the mean
absolute error of the change up to each of the window's 16 parts, in log units and in the paper's
log_255 (1 = the whole range of 8 bits), for windows in which something happens; beside it what
the frames alone say (a straight line between them) and the events alone at the camera's
thresholds. The paper's .10 (AKF) and .06 (its encoder) are of real recordings, between adjacent
frames, in units that it does not state.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from evflow import encode, load_weights
from evflow.batch import Batch, sample_batch
from evflow.config import preset
from evflow.progress import bar
from evflow.scenes import make_bank
from experiments.common import write_result

Array = jax.Array
LOG_255 = float(np.log(255.0))
ACTIVE = 0.02  # log units: least mean absolute change of a window that counts


@dataclasses.dataclass(frozen=True)
class Options:
    """Score the intensity changes that the encoder predicts."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/changes")
    seed: int = 7_000_003
    batches: int | None = None
    """Batches of 16 sequences (default: the preset's)."""


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


def main(options: Options) -> dict[str, Any]:
    params = load_weights(options.weights)
    config = dataclasses.replace(preset("default"), windows=1)
    count = options.batches or {"debug": 2, "full": 40}[options.preset]
    k_bank, k_data = jax.random.split(jax.random.key(options.seed))
    bank = make_bank(k_bank, 96, photos=False)
    step = jax.jit(lambda key: errors(params, sample_batch(key, bank, config)))
    total: dict[str, float] = {}
    with bar("batches") as progress:
        for i in range(count):
            made = jax.device_get(step(jax.random.fold_in(k_data, i)))
            total = {k: total.get(k, 0.0) + float(v) for k, v in made.items()}
            progress(i + 1, count)
    windows = total.pop("windows")
    result = {k: {"log": v / windows, "log_255": v / windows / LOG_255} for k, v in total.items()}
    lines = ["| change from | MAE, log units | MAE, log_255 |", "|---|---|---|"]
    lines += [f"| {k} | {v['log']:.4f} | {v['log_255']:.4f} |" for k, v in result.items()]
    text = "\n".join(lines) + f"\n\n{windows:.0f} windows. Paper: AKF .10, its encoder .06 (IJRR)."
    print(text)
    write_result(options.out / "changes.json", {**result, "windows": windows},
                 dataclasses.asdict(options))
    (options.out / "changes.md").write_text(text + "\n")
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

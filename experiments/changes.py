"""Intensity change: our encoder beside the filters (paper, Table XI and Fig. 15).

    python -m experiments.changes --preset full
    python -m experiments.changes --recording ijrr/boxes_6dof --span-s 5 20   # IJRR, whole

First, on windows of simulated scenes as in training, the mean absolute error of the change up to
each of a window's 16 parts, by the encoder, by what the frames alone say (a straight line) and by
the events alone at the camera's thresholds. Then whole recordings, real and simulated, where the
asynchronous Kalman filter, the complementary filter and plain integration join in; what each
protocol gives away is in change_systems.py. Errors are in natural-log units and in the paper's
log_255 (1 = the whole range of 8 bits), signed and of the magnitude. The paper's .10 (AKF) and
.06 (its encoder) are between adjacent frames of IJRR, in units that it does not state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Recording, encode, load_weights, read_recording
from evflow.camera import CameraPrior
from evflow.light.log_maps import lin_log
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes import SceneConfig, make_bank
from evflow.training.batch import Batch, sample_batch
from evflow.training.config import preset
from experiments.shared import change_systems as systems
from experiments.shared.cameras import Protocol, hidden_recording
from experiments.shared.changes_pages import MEASURES, picture, table
from experiments.shared.common import begin, conclude, run_script
from experiments.shared.images import mean_ci
from experiments.shared.recordings import held_recordings

Array = jax.Array
LOG_255 = float(np.log(255.0))
ACTIVE = 0.02  # log units: least mean absolute change of a window that counts
FRAME_MS = 32  # of simulated recordings: 16 parts of 2 frames of the 1 kHz video


@dataclasses.dataclass(frozen=True)
class Options:
    """Score intensity changes."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/changes")
    seed: int = 7_000_079
    batches: int | None = None
    """Batches of 16 sequences (default: the preset's)."""
    recording: tuple[Path, ...] = ()
    """Recordings with frames (default: those under $EVFLOW_DATA)."""
    span_s: tuple[float, float] | None = None
    """Seconds of the recordings to use, from their first frame."""
    seeds: int | None = None
    """Simulated recordings (default: the preset's)."""


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


def windows(options: Options, params: Any) -> dict[str, Any]:
    """Errors over the windows of simulated scenes."""
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
    found = total.pop("windows")
    return {**{k: {"log": v / found, "log_255": v / found / LOG_255} for k, v in total.items()},
            "windows": found}


def recordings(options: Options) -> Iterator[tuple[str, Recording, np.ndarray | None]]:
    """(name, recording, true log video between its frames): the real ones, then simulated ones of
    as many cameras. debug: the first real one."""
    full = options.preset == "full"
    for path in options.recording or held_recordings()[:None if full else 1]:
        yield path.stem, systems.cut(read_recording(path), options.span_s), None
    if options.recording:
        return
    k_bank, k_data = jax.random.split(jax.random.key(options.seed + 1))
    bank = make_bank(k_bank, 96, photos=False)
    protocol = Protocol(
        prior=CameraPrior(theta=(0.1, 0.4), mismatch=(0.03, 0.03)), frame_ms=FRAME_MS,
        scene=SceneConfig(speed_px_s=(40.0, 300.0), static_fraction=0.0, contrast=(0.5, 1.0)),
        shape=(96, 128) if full else (48, 64))
    for seed in range(options.seeds or (20 if full else 3)):
        hidden = hidden_recording(jax.random.fold_in(k_data, seed), bank, protocol)
        fine = hidden.kept[:-1, None] + np.arange(systems.PARTS + 1) * FRAME_MS // systems.PARTS
        video = np.asarray(lin_log(hidden.video[fine.ravel()]))
        yield "simulated", hidden.recording, video.reshape(*fine.shape, *video.shape[1:])


def scored(
    scene: systems.Scene, params: Any
) -> tuple[dict[str, dict[str, np.ndarray]], systems.Told | None]:
    """Mean MEASURES (4,) of each protocol and system over a recording's intervals; and what was
    told of the held-out frame that changed most, None where there is no such frame."""
    rows: dict[str, dict[str, list[list[float]]]] = {}
    most, largest = None, -1.0
    for name, task in (("next", systems.next_frame), ("middle", systems.middle_frame)):
        for told in task(scene, params):
            fired = told.made["integration"][-1] != 0
            for system, change in told.made.items():
                row = rows.setdefault(name, {}).setdefault(system, [])
                row.append(systems.errors(told.true[-1:], change[-1:], fired))
                if len(told.true) > 1:
                    rows.setdefault("path", {}).setdefault(system, []).append(
                        systems.errors(told.true, change, fired))
            size = float(np.abs(told.true).mean())
            if name == "middle" and size > largest:
                most, largest = told, size
    return {task: {s: np.nanmean(found, 0) for s, found in row.items()}
            for task, row in rows.items()}, most


def main(options: Options) -> dict[str, Any]:
    begin(options, "changes")
    plots.require()
    params = load_weights(options.weights)
    result = windows(options, params)
    found: dict[str, list[dict[str, dict[str, np.ndarray]]]] = {}
    shown: dict[str, systems.Told] = {}
    with bar("recordings") as progress:
        for number, (name, recording, video) in enumerate(recordings(options), 1):
            scores, told = scored(systems.make_scene(params, recording, video), params)
            found.setdefault(name, []).append(scores)
            if told is not None:
                shown.setdefault(name, told)
            progress(number, number)
    result["recordings"] = {name: {task: {system: {
        m: mean_ci(np.array([s[task][system][i] for s in every]))
        for i, m in enumerate(MEASURES)} for system in every[0][task]} for task in every[0]}
        for name, every in found.items()}
    conclude(options, "changes", result, table(result))
    if shown:
        picture(options.out / "changes.png", list(shown.items()))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

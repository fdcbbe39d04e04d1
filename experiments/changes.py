"""Intensity change: our encoder beside the filters (paper, Table XI and Fig. 15).

    python -m experiments.changes --preset full
    python -m experiments.changes --recording ijrr/boxes_6dof --span-s 5 20   # IJRR, whole

First, on windows of simulated scenes as in training, the mean absolute error of the change up to
each of a window's 16 parts, by the encoder, by the frames alone (a straight line) and by
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
import numpy as np

from evflow import Recording, load_weights
from evflow.camera import CameraPrior
from evflow.light.log_maps import lin_log
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes import SceneConfig, make_bank
from experiments.shared import change_systems as systems
from experiments.shared.cameras import Protocol, hidden_recording
from experiments.shared.change_windows import window_errors
from experiments.shared.changes_pages import MEASURES, picture, table
from experiments.shared.common import begin, conclude, run_script
from experiments.shared.images import mean_ci
from experiments.shared.recordings import distinct, real_recordings

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


def recordings(options: Options) -> Iterator[tuple[str, Recording, np.ndarray | None]]:
    """(name, recording, true log video between its frames): the real ones, then simulated ones of
    as many cameras. debug: the first real one."""
    full = options.preset == "full"
    for name, recording in real_recordings(options.recording, options.span_s, None if full else 1):
        yield name, recording, None
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


def main(options: Options) -> dict[str, Any]:
    begin(options, "changes")
    plots.require()
    distinct(options.recording)
    params = load_weights(options.weights)
    batches = options.batches or {"debug": 2, "full": 40}[options.preset]
    result = window_errors(params, options.seed, batches)
    found: dict[str, list[dict[str, dict[str, np.ndarray]]]] = {}
    shown: dict[str, systems.Predicted] = {}
    with bar("recordings") as progress:
        for number, (name, recording, video) in enumerate(recordings(options), 1):
            scores, predicted = systems.scored(systems.make_scene(params, recording, video), params)
            found.setdefault(name, []).append(scores)
            if predicted is not None:
                shown.setdefault(name, predicted)
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

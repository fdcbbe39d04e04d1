"""Every compared system, and ours, on one recording of a known camera, with their errors."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow import Recording, estimate_camera
from evflow.baselines import Fitted, Match, System
from evflow.camera import Camera
from evflow.network.weights import weights_hash
from experiments.shared import alone
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.compared import CONSTANT, KNOWN, OURS, POLARITIES
from experiments.shared.kept import Row, resumed
from experiments.shared.many import Setup, enough, made
from experiments.shared.protocols import ENOUGH


def all_fits(params: Any, recording: Recording, systems: dict[str, System]) -> dict[str, Fitted]:
    """Every system and ours on one recording."""
    return {name: s.fit(recording) for name, s in systems.items()} | ours(params, recording)


def ours(params: Any, recording: Recording) -> dict[str, Fitted]:
    """`estimate_camera` as one of the systems, with the thresholds of its summary, after the
    estimators that it contains."""
    start = time.perf_counter()
    span = min(40_000, int(recording.frame_times[-1] - recording.frame_times[0]))
    found = estimate_camera(recording, params, min_window_us=span)
    seconds = time.perf_counter() - start
    theta = np.array([float(found.summary.theta_on), float(found.summary.theta_off)])
    return alone.fitted(params, recording, found, seconds, span) | {
        OURS: Fitted(found.camera, np.stack([found.valid] * 2), theta, seconds,
                     logarithm=alone.logarithm_of(found))}


def flat(recording: Recording, theta: float) -> Fitted:
    """A constant, as one of the systems."""
    width, height = recording.events.size
    return Fitted(Camera.constant((height, width), theta, theta),
                  np.zeros((2, height, width), bool), np.full(2, theta), 0.0)


def score(params: Any, hidden: Hidden, systems: dict[str, System]) -> dict[str, Any]:
    """Errors of every system on one recording."""
    recording = hidden.recording
    fits = all_fits(params, recording, systems)
    fits[CONSTANT] = flat(recording, 0.3)
    dense = Recording(recording.events, hidden.video.astype(np.float32),
                      1000 * np.arange(len(hidden.video)))
    fits[KNOWN] = Match("given", start="fresh").fit(dense)
    result: dict[str, Any] = {"signal": hidden.signal_events().tolist()}
    for name, fit in fits.items():
        row: dict[str, Any] = {"seconds": fit.seconds, "determined": bool(fit.found.all())}
        for i, polarity in enumerate(POLARITIES):
            seen = np.asarray(getattr(fit.camera, f"theta_{polarity}"))
            pixels = np.asarray(getattr(hidden.camera, f"theta_{polarity}"))
            true = float(getattr(hidden.nominal, f"theta_{polarity}"))
            row |= {f"mae_sequence/{polarity}": float(np.abs(seen - true).mean()),
                    f"mae_pixel/{polarity}": float(np.abs(seen - pixels).mean()),
                    f"median/{polarity}": float(abs(fit.theta[i] - true)),
                    f"signed/{polarity}": float(fit.theta[i] - true)}
        result[name] = row
    return result


def all_scores(setup: Setup, systems: dict[str, System], protocol: tuple[str, Protocol],
               count: int, path: Path | None) -> list[Row]:
    """Scores of every system on the first `count` recordings of a protocol (with its name) that
    have enough events. path: where they are kept, to go on from when interrupted."""
    name, drawn = protocol

    def scored(left: list[int]) -> Iterator[Row]:
        found = made(lively, setup, [(i, drawn) for i in range(4 * count)], 1)
        fit = itertools.islice((f for f in found if f is not None), count)
        seen = 0
        for seen, one in enumerate(fit, 1):
            if (i := seen - 1) in left:
                yield score(*one, {n: s for n, s in systems.items() if i < s.most_recordings})
        enough([None] * seen, count)

    of = [weights_hash(setup.weights), weights_hash("paper"), setup.seed,
          *map(repr, systems.values())]
    return resumed(path, of, [f"{name}, {i}" for i in range(count)], scored, f"mismatch {name}")


def lively(params: Any, hidden: Hidden, _protocol: Protocol) -> tuple[Any, Hidden] | None:
    """The weights and the recording, if it has enough events of both polarities."""
    return (params, hidden) if (hidden.signal_events() >= ENOUGH).all() else None

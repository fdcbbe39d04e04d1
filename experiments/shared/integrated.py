"""Direct integration of a recording's events from frame to frame, and its scores."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from evflow import Recording, estimate_camera
from evflow.baselines import SYSTEMS
from evflow.baselines.base import usable
from evflow.baselines.integration import Integration
from evflow.camera import Camera, Summary
from evflow.light.logarithm import LIN_LOG, Logarithm
from experiments.shared import alone
from experiments.shared.images import SCORES, mean_ci, score

HORIZONS = {"1 frame": 1, "5 frames": 5, "10 frames": 10, "1e5 events": 100_000,
            "5e5 events": 500_000}  # frames, or events from 1000 on
LEAST = 4  # usable intervals of a half: fewer do not determine the thresholds
Example = tuple[str, np.ndarray, dict[str, np.ndarray]]  # name, frame, images by system
Found = dict[str, dict[str, dict[str, list[Any]]]]  # group, horizon, system: scores of a recording


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A recording and, where it was simulated, its true camera. camera: its row of Table X."""

    name: str
    camera: str
    recording: Recording
    truth: Camera | None = None
    nominal: Summary | None = None


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """The recording up to the middle of its usable frames, and from it on."""
    times, events, good = recording.frame_times, recording.events, usable(recording)
    middle = good[len(good) // 2]
    cuts = (min(times[0], events.t[0]), times[middle], max(times[-1], events.t[-1]))
    first, second = (events.slice(int(a) + late, int(b) + 1)
                     for a, b, late in ((cuts[0], cuts[1], 0), (cuts[1], cuts[2], 1)))
    return (dataclasses.replace(recording, events=first, frames=recording.frames[:middle + 1],
                                frame_times=times[:middle + 1]),
            dataclasses.replace(recording, events=second, frames=recording.frames[middle:],
                                frame_times=times[middle:]))


def calibrated_and_scored(case: Case, held_out: bool) -> tuple[Recording, Case, str]:
    """The recording to calibrate on, what is scored, and a title. held_out: the two halves of the
    recording, where each has enough usable intervals; else both are all of it ("in sample")."""
    if held_out and len(usable(case.recording)) >= 2 * LEAST:
        first, second = halves(case.recording)
        return first, dataclasses.replace(case, recording=second), case.name
    return case.recording, case, f"{case.name} (in sample)"


@dataclasses.dataclass(frozen=True, eq=False)
class Thresholds:
    """A camera to integrate with (None: no events at all), the logarithm of its thresholds, and for
    how many seconds it was sought (None: it was not)."""

    camera: Camera | None
    logarithm: Logarithm = LIN_LOG
    seconds: float | None = None


def thresholds(
    case: Case, part: Recording, params: Any, systems: tuple[str, ...]
) -> dict[str, Thresholds]:
    """By name; measured on a part of the recording, or all of it."""
    shape = part.frames.shape[1:]
    found = {"no events": Thresholds(None), "default .2": Thresholds(Camera.constant(shape))}
    for name in systems:
        fitted = SYSTEMS[name].fit(part)
        found[name] = Thresholds(fitted.camera, fitted.logarithm, fitted.seconds)
    start = time.perf_counter()
    ours = estimate_camera(part, params)
    seconds = time.perf_counter() - start
    found |= {name: Thresholds(fitted.camera, seconds=fitted.seconds)
              for name, fitted in alone.fitted(params, part, ours, seconds).items()
              if name != alone.SUMMARY}
    for name, camera in (("summary", constant(shape, ours.summary)), ("maps", ours.camera)):
        found[f"ours, {name}"] = Thresholds(camera, alone.logarithm_of(ours), seconds)
    if case.truth is not None and case.nominal is not None:
        found["true, nominal"] = Thresholds(constant(shape, case.nominal))
        found["true, maps"] = Thresholds(case.truth)
    return found


def constant(shape: tuple[int, ...], summary: Summary) -> Camera:
    return Camera.constant(shape, float(summary.theta_on), float(summary.theta_off))


def spans(recording: Recording, horizon: int, most: int) -> list[tuple[int, int]]:
    """(first, last) frames of the images of a horizon: through usable intervals only."""
    good = set(usable(recording))
    at = np.searchsorted(recording.events.t, recording.frame_times, side="right")
    found = []
    for first in sorted(good):
        last = (first + horizon if horizon < 1000
                else int(np.searchsorted(at, at[first] + horizon)))
        if last < len(at) and all(i in good for i in range(first, last)):
            found.append((first, last))
    step = np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(int)
    return [found[i] for i in step]


def image(recording: Recording, span: tuple[int, int], by: Thresholds) -> np.ndarray:
    """The frame at the end of a span (H, W) as predicted from the one at its begin."""
    frame = recording.frame_dn(span[0])
    if by.camera is None:
        return frame
    t0, t1 = (int(recording.frame_times[i]) for i in span)
    events = recording.events.slice(t0 + 1, t1 + 1)
    return Integration(by.logarithm).reconstruct(
        events, frame[None], np.array([t0]), by.camera, np.array([t1]))[0]


def scored(case: Case, by: dict[str, Thresholds], most: int) -> dict[str, dict[str, list[float]]]:
    """Mean scores of each system at each horizon that the recording is long enough for."""
    rows: dict[str, dict[str, list[float]]] = {}
    for horizon, amount in HORIZONS.items():
        chosen = spans(case.recording, amount, most)
        for name, one in by.items() if chosen else ():
            images = np.stack([image(case.recording, span, one) for span in chosen])
            frames = np.stack([case.recording.frame_dn(span[1]) for span in chosen])
            means = score(images, frames).mean(0).tolist()
            rows.setdefault(horizon, {})[name] = [*means, len(chosen)]
    return rows


def example(case: Case, by: dict[str, Thresholds], names: Sequence[str]) -> Example | None:
    """A row of the picture, by those of these names; None where no interval is usable."""
    chosen = spans(case.recording, 5, 1) or spans(case.recording, 1, 1)
    if not chosen:
        return None
    return case.name, case.recording.frame_dn(chosen[0][1]), {
        name: image(case.recording, chosen[0], one) for name, one in by.items() if name in names}


def averages(collected: Found) -> dict[str, dict[str, dict[str, Any]]]:
    """Means over the recordings of a group: scores with their intervals, images, seconds (None
    where nothing was sought)."""
    return {group: {horizon: {name: {
        **{s: mean_ci(np.array(found)[:, i]) for i, s in enumerate(SCORES)},
        "images": sum(r[-2] for r in found),
        "seconds": None if found[0][-1] is None else float(np.mean([r[-1] for r in found]))}
        for name, found in row.items()} for horizon, row in horizons.items()}
        for group, horizons in collected.items()}

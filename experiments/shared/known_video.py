"""The refinement where the video between the frames is known: what remains is the counts' noise."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
from collections.abc import Iterable
from typing import Any

import numpy as np

from evflow.camera import Summary
from evflow.estimation.refine import Chunk, pixel_posterior, refine_summary
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.pixels import evidence_of
from evflow.estimation.refine.sightings import sight
from evflow.estimation.refine.signal import separated_noise_rates
from evflow.light.log_maps import lin_log
from evflow.simulator.between import intervals
from experiments.shared.cameras import Hidden


def paths_between(
    hidden: Hidden, chunks: list[Chunk], starts: Iterable[int]
) -> dict[str, list[Chunk]]:
    """The chunks, whose first frames are `starts`, with each kind of path between their frames."""
    others = {"known": known_path, "straight": straight_path, "blended": blended_path}
    firsts = list(starts)
    return {"path": chunks} | {
        kind: [path(hidden, c, i) for c, i in zip(chunks, firsts, strict=False)]
        for kind, path in others.items()}


def refined(chunks: list[Chunk], start: Summary, unsure: Summary) -> tuple[Summary, np.ndarray]:
    """The camera, and its thresholds by pixel (2, H, W), as these paths have it."""
    best = refine_summary(chunks, start, unsure).summary
    return best, pixel_posterior(
        functools.reduce(operator.add, (c.evidence for c in chunks)), best)[0]


def known_path(hidden: Hidden, chunk: Chunk, first: int) -> Chunk:
    """The chunk whose first frame is frame `first` of the recording, with the true video between
    its frames (linear between its milliseconds)."""
    low, part = _fine(hidden, chunk, first)
    log_video = np.asarray(lin_log(hidden.video[low[0]:low[-1] + 2]))
    step = low - low[0]
    return _along(hidden, chunk, first, log_video[step] * (1 - part) + log_video[step + 1] * part)


def blended_path(hidden: Hidden, chunk: Chunk, first: int) -> Chunk:
    """The same with a fade from each frame to the next, as without optical flow."""
    frames = hidden.recording.frames[first:first + len(chunk.dt_s) + 1].astype(np.float32)
    part = np.linspace(0, 1, STEPS, endpoint=False, dtype=np.float32)[:, None, None]
    faded = [a * (1 - part) + b * part for a, b in itertools.pairwise(frames)]
    return _along(hidden, chunk, first, np.asarray(lin_log(np.concatenate([*faded, frames[-1:]]))))


def straight_path(hidden: Hidden, chunk: Chunk, first: int) -> Chunk:
    """The same with optical flow along straight lines at constant speed between two frames."""
    kept = slice(first, first + len(chunk.dt_s) + 1)
    frames = hidden.recording.frames[kept].astype(np.float32)
    times = hidden.recording.frame_times[kept].tolist()
    pictures = []
    for interval in intervals(zip(frames, times, strict=True), jerk=False):
        straight = dataclasses.replace(interval, bends=None)
        pictures += [interval.a.dn, *straight.at(np.arange(1, STEPS) / STEPS, sharp=False)]
    return _along(hidden, chunk, first, np.asarray(lin_log(np.stack([*pictures, frames[-1]]))))


def _fine(hidden: Hidden, chunk: Chunk, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Of each fine frame: the true video's picture before it, and how far it is on to the next."""
    kept = hidden.kept[first:first + len(chunk.dt_s) + 1]
    at = np.concatenate([np.linspace(a, b, STEPS, endpoint=False)
                         for a, b in itertools.pairwise(kept)] + [kept[-1:]])
    low = np.minimum(at.astype(int), len(hidden.video) - 2)
    return low, (at - low)[:, None, None].astype(np.float32)


def _along(hidden: Hidden, chunk: Chunk, first: int, path: np.ndarray) -> Chunk:
    """The chunk with another path of log intensity between its frames."""
    times = hidden.recording.frame_times[first:first + len(chunk.dt_s) + 1]
    sightings = sight(hidden.recording.events, times, path, STEPS)
    return dataclasses.replace(chunk, path=path.astype(np.float32), sightings=sightings,
                               evidence=evidence_of(sightings, first=first == 0))


def noise_on_video(params: Any, known: list[Chunk], best: Summary, start: Summary) -> np.ndarray:
    """Noise rates (2,) in Hz on the true video, by the separation of noise with a wide prior."""
    theta = np.array([float(best.theta_on), float(best.theta_off)])
    before = np.log([float(start.eta_on), float(start.eta_off)])
    signal = next(iter(params.values()))["signal"]
    log_eta, _ = separated_noise_rates(known, theta, before, np.ones(2), signal)
    return np.exp(log_eta)

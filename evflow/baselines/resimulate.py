"""A recording's own scene, simulated with given thresholds, for MATCH and S2R.

The path between the frames is motion-compensated, or given where the frames are a fast video. A
camera is one row (theta_ON, theta_OFF, eta_ON, eta_OFF, sigma_ON, sigma_OFF); all rows share random
numbers, so that differences are due to the cameras.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import numpy as np

from evflow.baselines.base import usable
from evflow.errors import EvflowDataError
from evflow.estimation.refine import Chunk, make_chunk, refinement_chunks
from evflow.estimation.refine.noise import combined_rate, quiet_events
from evflow.estimation.refine.path import STEPS
from evflow.estimation.refine.pixels import pixel_evidence
from evflow.estimation.refine.trace import Trace, draw, trace_of_camera
from evflow.light.log_maps import lin_log
from evflow.types import Recording

Array = jax.Array

Path = Literal["flow", "given"]
BLOCK_US = 25_000  # of a given video, as a typical frame interval
TYPICAL_ETA, ETA_SPREAD = 0.1, 2.0  # prior, Hz and relative std: matters without pixels at rest


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Stretches of a recording. steps: fine steps per frame interval; seen: (4, 2) `statistics` of
    the recorded events; eta: (2,) noise rates in Hz of pixels at rest."""

    chunks: list[Chunk]
    steps: int
    seen: np.ndarray
    eta: np.ndarray

    def simulate(self, key: Array, rows: np.ndarray, fresh: float) -> np.ndarray:
        """Statistics (V, 4, 2) of the cameras rows (V, 6); fresh: 1 where the memory starts at
        the first frame's brightness, 0 where it may lie anywhere between the thresholds."""
        totals = np.zeros((len(rows), 4, 2))
        for i, c in enumerate(self.chunks):
            draws = draw(key, i, c.bright.shape, len(c.dt_s), self.steps)
            start = np.full(2, 0.0 if i else fresh, np.float32)
            for total, row in zip(totals, np.asarray(rows, np.float32), strict=True):
                made = trace_of_camera(draws, c.path, c.dt_s, draws.thresholds(row), row[2:4],
                                       1 - start, self.steps)
                total += statistics(made, c.bright)
        return totals


def scene_of(recording: Recording, path: Path, quiet: bool = True) -> Scene:
    """The scene of a recording. quiet: measure the noise of pixels at rest. Raises EV001, EV011,
    EV012, EV017 as `plan_windows`, and EV017 where the frames are too small for flow."""
    found = usable(recording)
    if path == "flow":
        steps, chunks = STEPS, refinement_chunks(recording, tuple((i, i + 1) for i in found))
    else:
        between = np.median(np.diff(recording.frame_times))
        steps = int(np.clip(round(BLOCK_US / between), 1, len(recording.frames) - 1))
        chunks = [_given(recording, run, steps) for run in _runs(found) if len(run) >= steps]
    if not chunks and path == "flow":
        raise EvflowDataError("EV017", "the frames are too small for optical flow.",
                              'Give the video between them: path="given".')
    if not chunks:
        raise EvflowDataError("EV017", f"no {steps} frame intervals in a row are usable.",
                              "Give a video without gaps and glitches, or a longer one.")
    seen = np.sum([statistics(c.recorded, c.bright) for c in chunks], 0, np.float64)
    eta = np.zeros(2)
    if quiet:
        events = np.sum([quiet_events(c, steps) for c in chunks], 0)
        eta = combined_rate(events, np.full(2, TYPICAL_ETA), np.full(2, ETA_SPREAD))
    return Scene(chunks, steps, np.asarray(seen), eta)


def _given(recording: Recording, run: list[int], steps: int) -> Chunk:
    """A run of intervals of a fast video as one chunk, whose frames are every `steps`-th one and
    whose path is the video."""
    index = np.arange(run[0], run[0] + len(run) // steps * steps + 1)
    events, times = recording.events, recording.frame_times[index[::steps]]
    coarse = Recording(events, recording.frames[index[::steps]], times,
                       full_scale=recording.full_scale)
    chunk = make_chunk(coarse, list(range(len(times) - 1)), steps)
    path = np.asarray(lin_log(np.stack([recording.frame_dn(int(i)) for i in index])))
    evidence = pixel_evidence(events, times, path, steps, first=run[0] == 0)
    return dataclasses.replace(chunk, path=path, evidence=evidence)


def _runs(found: list[int]) -> list[list[int]]:
    """Groups of consecutive intervals."""
    breaks = np.flatnonzero(np.diff(found) > 1) + 1
    return [part.tolist() for part in np.split(np.array(found), breaks)]


def statistics(trace: Trace, bright: np.ndarray) -> np.ndarray:
    """(4, 2), ON and OFF: sums over pixels of the counts and of their square roots, number of
    pixels with events, number of pixels."""
    counts = trace.counts.sum(0, dtype=np.float64) * bright
    pixels = np.full(2, float(bright.sum()))
    return np.stack([counts.sum((1, 2)), np.sqrt(counts).sum((1, 2)), (counts > 0).sum((1, 2)),
                     pixels])

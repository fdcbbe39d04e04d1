"""Stretches: a few consecutive frame intervals and the windows in them. An estimate reads a
recording one stretch at a time.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from evflow.recordings.windows import WindowPlan
from evflow.simulator.interpolate import MIN_SIDE
from evflow.types import Recording

INTERVALS, FEW_INTERVALS = 8, 4  # frame intervals per stretch: 200 ms at 40 Hz; large sensors
PART = (260, 346)  # rows and columns of a large sensor that are simulated
CHUNK_PIXELS = 8 * 346 * 260  # pixels of all simulated stretches of a long recording
LARGE = CHUNK_PIXELS // 2  # pixels of a sensor above which PART is simulated
BAND = PART[0] * PART[1]  # pixels of a large sensor processed at once


@dataclasses.dataclass(frozen=True, eq=False)
class Stretch:
    """One stretch of a recording.

    run: frame intervals i (frame i to i + 1), ascending; empty without a path between the frames;
    windows: (number, (first, last) frame) of those that begin in it; first: whether the camera's
    recording begins with it."""

    recording: Recording
    run: tuple[int, ...]
    windows: tuple[tuple[int, tuple[int, int]], ...]
    first: bool = False

    @property
    def span_us(self) -> tuple[int, int]:
        """First and last time."""
        frames = [i for _, pair in self.windows for i in pair]
        frames += [i + k for i in self.run for k in (0, 1)]
        times = self.recording.frame_times
        return int(times[min(frames)]), int(times[max(frames)])


def cut(
    recording: Recording, plan: WindowPlan, *, path: bool = True, first: bool = True
) -> tuple[Stretch, ...]:
    """Cut a recording into stretches, in time order.

    Args:
        recording: with frames.
        plan: its windows.
        path: whether stretches have frame intervals, for a path between the frames.
        first: False where the camera's recording began before this one.
    """
    runs = plan_runs(recording, plan.pairs) if path else []
    numbered = list(enumerate(plan.pairs))
    if not runs:
        return tuple(Stretch(recording, (), tuple(numbered[i:i + INTERVALS]))
                     for i in range(0, len(numbered), INTERVALS))
    place = {i: k for k, run in enumerate(runs) for i in run}
    windows: list[list[tuple[int, tuple[int, int]]]] = [[] for _ in runs]
    for number, pair in numbered:
        windows[place[pair[0]]].append((number, pair))
    return tuple(Stretch(recording, tuple(run), tuple(within), first and run[0] == 0)
                 for run, within in zip(runs, windows, strict=True))


def plan_runs(recording: Recording, pairs: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Runs of up to INTERVALS consecutive frame intervals i (frame i to i + 1), ascending.

    Args:
        recording: with frames.
        pairs: (first, last) frames of the windows to cover.

    Returns:
        The runs; empty where frames are too small for optical flow.
    """
    height, width = recording.frames.shape[1:]
    if max(height, width) < MIN_SIDE:
        return []
    most = INTERVALS if height * width <= LARGE else FEW_INTERVALS
    runs: list[list[int]] = []
    for i in itertools.chain.from_iterable(range(*pair) for pair in pairs):
        if runs and runs[-1][-1] == i - 1 and len(runs[-1]) < most:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs


def spread(lengths: Sequence[int], most: int) -> list[int]:
    """Indices of the largest of `lengths`, evenly thinned to `most`."""
    longest = [i for i, n in enumerate(lengths) if n == max(lengths)]
    if len(longest) > most:
        middles = (np.arange(most) + 0.5) * len(longest) / most
        longest = [longest[int(k)] for k in middles]
    return longest


def plan_chunks(recording: Recording, runs: list[list[int]]) -> list[list[int]]:
    """The runs to simulate: the longest, evenly thinned to the budget. The camera's parameters are
    the same everywhere, so a part of a long recording suffices."""
    most = most_simulated(recording.events.size)
    return [runs[i] for i in spread([len(run) for run in runs], most)]


def most_simulated(size: tuple[int, int]) -> int:
    """Number of stretches of a long recording that are simulated, for a sensor of this size."""
    pixels = size[0] * size[1]
    return max(1, CHUNK_PIXELS // (pixels if pixels <= LARGE else PART[0] * PART[1]))

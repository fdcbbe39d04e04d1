"""Stretches: some frame intervals in a row and the windows in them, which is what an estimate reads
of a recording at a time.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from evflow.recordings.windows import WindowPlan
from evflow.simulator.interpolate import MIN_SIDE
from evflow.types import Recording

INTERVALS, FEW_INTERVALS = 8, 4  # frame intervals per stretch: 200 ms at 40 Hz; of large sensors
PART = (260, 346)  # rows and columns that are simulated of a large sensor
CHUNK_PIXELS = 8 * 346 * 260  # pixels of all stretches simulated, of a long recording
LARGE = CHUNK_PIXELS // 2  # pixels of a sensor of which two stretches cannot be simulated whole
BAND = PART[0] * PART[1]  # pixels of it that are gone through at once


@dataclasses.dataclass(frozen=True, eq=False)
class Stretch:
    """run: frame intervals i (frame i to i + 1) of the recording, ascending, none where there is
    no path between its frames; windows: (number, (first, last) frame) of those that begin in it;
    first: whether the camera's recording begins with it."""

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
    """The stretches of a recording in time order. path: whether to look at what is between the
    frames; first: False for a later piece of what a camera records."""
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
    """Runs of up to INTERVALS consecutive frame intervals i (frame i to i + 1) in the windows
    between the pairs of frames (first, last), ascending; none where frames are too small for
    optical flow."""
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
    """Indices of the longest, evenly thinned to `most`."""
    longest = [i for i, n in enumerate(lengths) if n == max(lengths)]
    if len(longest) > most:
        middles = (np.arange(most) + 0.5) * len(longest) / most  # of as many equal parts
        longest = [longest[int(k)] for k in middles]
    return longest


def plan_chunks(recording: Recording, runs: list[list[int]]) -> list[list[int]]:
    """The runs that are simulated, again and again: the longest, evenly thinned to the budget.
    The camera's parameters are alike everywhere, so some of a long recording tell them."""
    most = most_simulated(recording.events.size)
    return [runs[i] for i in spread([len(run) for run in runs], most)]


def most_simulated(size: tuple[int, int]) -> int:
    """How many stretches of a long recording are simulated, of large sensors a part of each."""
    pixels = size[0] * size[1]
    return max(1, CHUNK_PIXELS // (pixels if pixels <= LARGE else PART[0] * PART[1]))

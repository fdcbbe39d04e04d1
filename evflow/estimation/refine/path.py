"""The brightness path between frames: chunks of frames -> fine log frames, on the host.

The frames of a recording are 10-50 ms apart; motion-compensated frames (OpenCV DIS flow) fill
the gaps, so that what moves between them crosses the pixels in between. A chunk is the unit of
the refinement: its pixels start anew, so chunks are independent and memory stays bounded.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable

import numpy as np

from evflow.estimation.refine.pixels import PixelEvidence, evidence_of
from evflow.estimation.refine.sightings import Sightings, sight
from evflow.estimation.refine.trace import Trace, trace_of_events
from evflow.light.log_maps import lin_log
from evflow.recordings.glitches import SATURATED_DN, exposed
from evflow.simulator.interpolate import MIN_SIDE, Interpolator
from evflow.types import Recording

INTERVALS = 8  # frame intervals per chunk: 200 ms at 40 Hz
STEPS = 16  # fine frames per interval: motion of 16 px per frame still moves 1 px a step
CHUNK_PIXELS = 8 * 346 * 260  # pixels of all chunks simulated, of a long recording


@dataclasses.dataclass(frozen=True, eq=False)
class Chunk:
    """One stretch of a recording, K frame intervals.

    path: (K * steps + 1, H, W) float32 log intensity, the frames at every `steps`-th;
    bright: (H, W) bool, pixels whose frames are neither near black nor saturated; dt_s: (K,)
    interval lengths; motion_px: (K,) fast motion per interval; recorded: the events' Trace;
    evidence: about each pixel's thresholds; quiet: (4, H, W) events in intervals in which the
    pixel's path stays within QUIET, the seconds and number of these, and how many had events.
    Intervals with a saturated or black frame are in none. sightings: the events beside the path.
    """

    path: np.ndarray
    bright: np.ndarray
    dt_s: np.ndarray
    motion_px: np.ndarray
    recorded: Trace
    evidence: PixelEvidence
    quiet: np.ndarray
    sightings: Sightings


QUIET = 0.05  # log units: less than the smallest threshold of any use
DARK_DN = 15.0  # below, half a DN of noise is .03 in log


@dataclasses.dataclass(frozen=True, eq=False)
class Survey:
    """What the refinement reads of a recording. chunks: the stretches that it simulates, whole;
    evidence and quiet, as in Chunk: sums over all stretches, those included."""

    chunks: list[Chunk]
    evidence: PixelEvidence
    quiet: np.ndarray


def survey(
    recording: Recording, runs: list[list[int]], advance: Callable[[], None] = lambda: None
) -> Survey:
    """A recording's stretches, one after the other in the memory of one and of those kept.
    runs: of `plan_runs`; advance() is called after each."""
    width, height = recording.events.size
    simulated = plan_chunks(recording, runs)
    chunks, evidence = [], PixelEvidence.nothing((height, width))
    quiet = np.zeros((4, height, width))
    for run in runs:
        chunk = make_chunk(recording, run)
        evidence, quiet = evidence + chunk.evidence, quiet + chunk.quiet
        if run in simulated:
            chunks.append(chunk)
        advance()
    return Survey(chunks, evidence, quiet)


def refinement_chunks(
    recording: Recording, pairs: Iterable[tuple[int, int]]
) -> list[Chunk]:
    """The stretches of a recording that the refinement simulates, of the windows between the
    pairs of frames (first, last)."""
    runs = plan_runs(recording, pairs)
    return [make_chunk(recording, run) for run in plan_chunks(recording, runs)]


def plan_runs(recording: Recording, pairs: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Runs of up to INTERVALS consecutive frame intervals i (frame i to i + 1) in the windows
    between the pairs of frames (first, last), ascending; none where frames are too small for
    optical flow."""
    if max(recording.frames.shape[1:]) < MIN_SIDE:
        return []
    runs: list[list[int]] = []
    for i in itertools.chain.from_iterable(range(*pair) for pair in pairs):
        if runs and runs[-1][-1] == i - 1 and len(runs[-1]) < INTERVALS:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs


def plan_chunks(recording: Recording, runs: list[list[int]]) -> list[list[int]]:
    """The runs that are simulated, again and again: the longest, evenly thinned to the budget.
    The camera's parameters are alike everywhere, so some of a long recording tell them."""
    longest = max((len(run) for run in runs), default=0)
    runs = [run for run in runs if len(run) == longest]
    width, height = recording.events.size
    most = max(1, CHUNK_PIXELS // (width * height))
    if len(runs) > most:
        middles = (np.arange(most) + 0.5) * len(runs) / most  # of as many equal parts
        runs = [runs[int(k)] for k in middles]
    return runs


def make_chunk(recording: Recording, run: list[int], steps: int = STEPS) -> Chunk:
    """Interpolate the frames of a run of intervals and count its events."""
    frames = [recording.frame_dn(i) for i in [*run, run[-1] + 1]]
    times = recording.frame_times[run[0]:run[-1] + 2]
    interpolator = Interpolator()
    path, motion = [frames[0]], []
    for a, b in itertools.pairwise(frames):
        between, moved = interpolator.between(a, b, steps)
        path += [*between, b]
        motion.append(moved)
    stack, fine = np.stack(frames), np.asarray(lin_log(np.stack(path)))
    bright = (stack.min(0) >= DARK_DN) & (stack.max(0) <= SATURATED_DN)
    seen = np.stack([exposed(frame) for frame in frames])
    dt_s = np.diff(times).astype(np.float32) * 1e-6
    trace = trace_of_events(recording.events, times, steps)
    sightings = sight(recording.events, times, fine, steps, seen)
    return Chunk(
        fine, bright, dt_s, np.array(motion, np.float32), trace,
        evidence_of(sightings, first=run[0] == 0),
        _quiet(fine, trace, dt_s, seen[1:] & seen[:-1]), sightings)


def _quiet(path: np.ndarray, trace: Trace, dt_s: np.ndarray, shown: np.ndarray) -> np.ndarray:
    steps = (len(path) - 1) // len(dt_s)
    inner = path[1:].reshape(len(dt_s), steps, *path.shape[1:])
    still = (inner.max(1) - inner.min(1) < QUIET) & shown
    events = np.asarray(trace.counts).sum(1) * still
    return np.stack([events.sum(0), (dt_s[:, None, None] * still).sum(0), still.sum(0),
                     (events > 0).sum(0)])

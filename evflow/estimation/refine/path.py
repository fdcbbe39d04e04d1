"""The brightness path between frames: chunks of frames -> fine log frames, on the host.

The frames of a recording are 10-50 ms apart; motion-compensated frames (OpenCV DIS flow) fill
the gaps, so that what moves between them crosses the pixels in between. A chunk is the unit of
the refinement: its pixels start anew, so chunks are independent and memory stays bounded.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable

import jax
import numpy as np

from evflow.estimation.refine.denoise import denoised
from evflow.estimation.refine.pixels import PixelEvidence, evidence_of
from evflow.estimation.refine.receptor_data import Sample, sample
from evflow.estimation.refine.receptor_search import Found, find
from evflow.estimation.refine.sightings import Sightings, sight
from evflow.estimation.refine.trace import Trace, trace_of_events
from evflow.light.log_maps import lin_log
from evflow.recordings.glitches import SATURATED_DN, exposed
from evflow.simulator.interpolate import MIN_SIDE, Interpolator
from evflow.simulator.photoreceptor import FAST, IDEAL, Photoreceptor, seen_path
from evflow.types import Recording

INTERVALS = 8  # frame intervals per chunk: 200 ms at 40 Hz
STEPS = 16  # fine frames per interval: motion of 16 px per frame still moves 1 px a step
CHUNK_PIXELS = 8 * 346 * 260  # pixels of all chunks simulated, of a long recording
STRETCHES = 3  # that tell the photoreceptor


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
    recording: Recording, runs: list[list[int]], advance: Callable[[], None] = lambda: None,
    seen_by: Photoreceptor = IDEAL, noise_dn: float = 0.0,
) -> Survey:
    """A recording's stretches, one after the other in the memory of one and of those kept.
    runs: of `plan_runs`; advance() is called after each."""
    width, height = recording.events.size
    simulated = plan_chunks(recording, runs)
    chunks, evidence = [], PixelEvidence.nothing((height, width))
    quiet = np.zeros((4, height, width))
    for run in runs:
        chunk = make_chunk(recording, run, STEPS, seen_by, noise_dn)
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


def make_chunk(
    recording: Recording, run: list[int], steps: int = STEPS, seen_by: Photoreceptor = IDEAL,
    noise_dn: float = 0.0,
) -> Chunk:
    """Interpolate the frames of a run of intervals, put them through what its pixels see them by,
    and count its events."""
    film = interpolated(recording, run, steps, noise_dn)
    times = film.times_us + round(seen_by.delay_s * 1e6)
    fine = as_seen(film, seen_by)
    dark, light = film.frames.min(0) + seen_by.offset_dn, film.frames.max(0)
    bright = (dark >= DARK_DN) & (light <= SATURATED_DN)
    trace = trace_of_events(recording.events, times, steps)
    sightings = sight(recording.events, times, fine, steps, film.shown)
    return Chunk(
        fine, bright, film.dt_s, film.motion_px, trace,
        evidence_of(sightings, first=run[0] == 0),
        _quiet(fine, trace, film.dt_s, film.shown[1:] & film.shown[:-1]), sightings)


@dataclasses.dataclass(frozen=True, eq=False)
class Film:
    """The frames of a run and what lies between them. frames: (K + 1, H, W) DN; dn: (K * steps +
    1, H, W) DN; times_us: (K + 1,); dt_s: (K,) interval lengths; motion_px: (K,) fast motion;
    shown: (K + 1, H, W) bool, frames that are neither saturated nor black."""

    frames: np.ndarray
    dn: np.ndarray
    times_us: np.ndarray
    dt_s: np.ndarray
    motion_px: np.ndarray
    shown: np.ndarray


def interpolated(
    recording: Recording, run: list[int], steps: int = STEPS, noise_dn: float = 0.0
) -> Film:
    """The frames of a run of intervals, less their noise, filled up by optical flow."""
    frames = [recording.frame_dn(i) for i in [*run, run[-1] + 1]]
    times = recording.frame_times[run[0]:run[-1] + 2]
    interpolator, clean = Interpolator(), [denoised(frame, noise_dn) for frame in frames]
    dn, motion = [clean[0]], []
    for a, b in itertools.pairwise(clean):
        between, moved = interpolator.between(a, b, steps)
        dn += [*between, b]
        motion.append(moved)
    return Film(
        np.stack(frames), np.stack(dn), times, np.diff(times).astype(np.float32) * 1e-6,
        np.array(motion, np.float32), np.stack([exposed(frame) for frame in frames]))


def as_seen(film: Film, seen_by: Photoreceptor) -> np.ndarray:
    """The path (K * steps + 1, H, W) in log units that a photoreceptor makes of a film."""
    if not seen_by.offset_dn and not seen_by.tau_s:
        return np.asarray(lin_log(film.dn))
    steps = (len(film.dn) - 1) // len(film.dt_s)
    dt_s = np.repeat(film.dt_s / steps, steps).astype(np.float32)
    values = (np.float32(v) for v in (seen_by.offset_dn, max(seen_by.tau_s, FAST)))
    return np.asarray(_seen(film.dn, dt_s, *values))


_seen = jax.jit(seen_path)


def receptor_sample(
    recording: Recording, runs: list[list[int]], noise_dn: float = 0.0
) -> Sample | None:
    """What a few of a recording's runs of intervals say of the photoreceptor; None where too
    little happens."""
    runs = plan_chunks(recording, runs)
    chosen = np.unique(np.linspace(0, len(runs) - 1, min(STRETCHES, len(runs))).round())
    parts = []
    for k in chosen.astype(int):
        film = interpolated(recording, runs[k], STEPS, noise_dn)
        s = sight(recording.events, film.times_us, as_seen(film, IDEAL), STEPS, film.shown)
        parts.append((film.dn, np.repeat(film.dt_s / STEPS, STEPS), s))
    return sample(parts)


def find_photoreceptor(
    recording: Recording, runs: list[list[int]], noise_dn: float = 0.0
) -> Found | None:
    """What the pixels of a recording see its frames by; None where too little happens."""
    data = receptor_sample(recording, runs, noise_dn)
    return find(data) if data is not None else None


def _quiet(path: np.ndarray, trace: Trace, dt_s: np.ndarray, shown: np.ndarray) -> np.ndarray:
    steps = (len(path) - 1) // len(dt_s)
    inner = path[1:].reshape(len(dt_s), steps, *path.shape[1:])
    still = (inner.max(1) - inner.min(1) < QUIET) & shown
    events = np.asarray(trace.counts).sum(1) * still
    return np.stack([events.sum(0), (dt_s[:, None, None] * still).sum(0), still.sum(0),
                     (events > 0).sum(0)])

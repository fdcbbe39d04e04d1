"""Chunks: the unit of the refinement, a run of frame intervals with its path and its events.

The pixels of a chunk start anew, so chunks are independent and memory stays bounded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from evflow.estimation.refine.path import STEPS, Film, Place, as_seen, interpolated
from evflow.estimation.refine.pixels import PixelEvidence, evidence_of
from evflow.estimation.refine.sightings import Sightings, no_sightings, sight
from evflow.estimation.refine.still_noise import quiet_maps
from evflow.estimation.refine.stretches import BAND, LARGE, PART, plan_chunks, plan_runs
from evflow.estimation.refine.trace import Trace, trace_of_events
from evflow.files.spool import put_aside
from evflow.light.log_maps import LINLOG_KNEE
from evflow.process.memory import give_back
from evflow.recordings.glitches import SATURATED_DN
from evflow.recordings.region import bands, inside
from evflow.simulator.photoreceptor import IDEAL, Photoreceptor
from evflow.types import Events, Recording

Box = tuple[slice, slice]
WHOLE: Box = (slice(None), slice(None))
DARK_DN = LINLOG_KNEE  # below, where the map is linear, half a DN of noise is .075 log units


@dataclasses.dataclass(frozen=True, eq=False)
class Chunk:
    """One stretch of a recording, K frame intervals.

    path: (K * steps + 1, H, W) float32 log intensity, the frames at every `steps`-th;
    bright: (H, W) bool, pixels whose frames are neither near black nor saturated;
    dt_s: (K,) interval lengths; motion_px: (K,) fast motion per interval;
    recorded: the events' Trace; evidence: about each pixel's thresholds;
    quiet: (4, H, W), `quiet_maps` of its intervals;
    sightings: the events beside the path; empty for large sensors until `simulated_part`;
    box: rows and columns of the sensor.
    """

    path: np.ndarray
    bright: np.ndarray
    dt_s: np.ndarray
    motion_px: np.ndarray
    recorded: Trace
    evidence: PixelEvidence
    quiet: np.ndarray
    sightings: Sightings
    box: Box = WHOLE


def refinement_chunks(
    recording: Recording, pairs: Iterable[tuple[int, int]]
) -> list[Chunk]:
    """The chunks of a recording that the refinement simulates.

    Args:
        recording: with frames.
        pairs: (first, last) frames of the windows to use.
    """
    runs = plan_runs(recording, pairs)
    return [make_chunk(recording, run) for run in plan_chunks(recording, runs)]


def make_chunk(
    recording: Recording, run: Sequence[int], steps: int = STEPS, seen_by: Photoreceptor = IDEAL,
    noise_dn: float = 0.0, *, first: bool | None = None, film: Film | None = None,
) -> Chunk:
    """The chunk of a run of frame intervals: interpolated frames, seen by the pixels, and events.

    Args:
        recording: with frames.
        run: consecutive intervals i (frame i to i + 1).
        steps: fine frames per interval.
        seen_by: the pixels' photoreceptor and the frames' offset and delay.
        noise_dn: std of the frames' noise, for denoising.
        first: whether the camera's recording begins here; by default, whether run[0] is 0.
        film: the interpolated run, if available; its arrays are overwritten.
    """
    film = film or interpolated(recording, run, steps, noise_dn)
    give_back()
    times = film.times_us + round(seen_by.delay_s * 1e6)
    fine = as_seen(film, seen_by, out=film.dn)
    dark, light = film.frames.min(0) + seen_by.offset_dn, film.frames.max(0)
    bright = (dark >= DARK_DN) & (light <= SATURATED_DN)
    events = recording.events.slice(int(times[0]), int(times[-1]) + 1)
    trace = trace_of_events(events, times, steps)
    quiet = _quiet(fine, trace, film.dt_s, film.shown[1:] & film.shown[:-1])
    first = run[0] == 0 if first is None else first
    if bright.size <= LARGE:
        sightings = sight(recording.events, times, fine, steps, film.shown)
        evidence = evidence_of(sightings, first=first)
    else:
        give_back()
        sightings = no_sightings(film.shown)
        evidence = _evidence_by_bands(events, times, fine, film.shown, steps, first=first)
    return Chunk(fine, bright, film.dt_s, film.motion_px, trace, evidence, quiet, sightings)


def _evidence_by_bands(
    events: Events, times: np.ndarray, path: np.ndarray, shown: np.ndarray, steps: int, *,
    first: bool,
) -> PixelEvidence:
    """`evidence_of` all events, a few rows at a time to bound the memory of intermediates."""
    whole = PixelEvidence.nothing(path.shape[1:])
    if first:
        whole = dataclasses.replace(whole, start=whole.start.copy())
    for rows in bands(path.shape[1:], BAND):
        s = sight(inside(events, rows, slice(0, path.shape[2])), times, path[:, rows], steps,
                  shown[:, rows])
        part = evidence_of(s, first=first)
        whole.equations[:, rows], whole.bounds[:, rows] = part.equations, part.bounds
        if first:
            whole.start[:, rows] = part.start
    return whole


def simulated_part(chunk: Chunk, place: Place, seen_by: Photoreceptor = IDEAL) -> Chunk:
    """The part of a chunk to simulate: all of it; of a large sensor the box of a DAVIS346's size
    with the most events, as the camera's parameters are the same everywhere.

    Args:
        chunk: to cut.
        place: its recording and run.
        seen_by: as of `make_chunk`.
    """
    height, width = chunk.bright.shape
    if height * width <= LARGE:
        return chunk
    h, w = min(height, PART[0]), min(width, PART[1])
    busy = cv2.integral(np.asarray(chunk.recorded.counts).sum((0, 1)))
    sums = busy[h:, w:] - busy[:-h, w:] - busy[h:, :-w] + busy[:-h, :-w]
    y, x = np.unravel_index(int(np.argmax(sums)), sums.shape)
    box = slice(int(y), int(y) + h), slice(int(x), int(x) + w)
    (recording, run), steps = place, (len(chunk.path) - 1) // len(chunk.dt_s)
    times = recording.frame_times[run[0]:run[-1] + 2] + round(seen_by.delay_s * 1e6)
    events = recording.events.slice(int(times[0]), int(times[-1]) + 1)
    events = inside(events, *box)
    path = np.ascontiguousarray(chunk.path[:, *box])
    seen = chunk.sightings.seen.reshape(-1, height, width)[:, *box]
    whole = chunk.evidence
    evidence = PixelEvidence(*(a[:, *box] for a in (whole.equations, whole.bounds, whole.start)))
    # Copies, since a view of a part would keep the whole in memory.
    return Chunk(path, chunk.bright[box].copy(), chunk.dt_s, chunk.motion_px,
                 trace_of_events(events, times, steps), evidence, chunk.quiet[:, *box].copy(),
                 sight(events, times, path, steps, seen), box)


def without_evidence(chunk: Chunk) -> Chunk:
    """The chunk with empty per-pixel evidence, to keep for simulation once that is in the sums. The
    path of a large sensor, which takes most of the memory, is moved to a file."""
    large = chunk.box != WHOLE
    return dataclasses.replace(chunk, evidence=PixelEvidence.nothing((0, 0)),
                               path=put_aside(chunk.path) if large else chunk.path)


def _quiet(path: np.ndarray, trace: Trace, dt_s: np.ndarray, shown: np.ndarray) -> np.ndarray:
    steps = (len(path) - 1) // len(dt_s)
    inner = path[1:].reshape(len(dt_s), steps, *path.shape[1:])
    return quiet_maps(inner.max(1) - inner.min(1), np.asarray(trace.counts).sum(1), dt_s, shown)

"""The brightness path between frames: chunks of frames -> fine log frames, on the host.

The frames of a recording are 10-50 ms apart. Motion-compensated interpolation (OpenCV DIS flow)
fills the gaps, so that a moving edge crosses the pixels in between. A chunk is the unit of the
refinement: its pixels start anew, so chunks are independent and memory stays bounded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import cv2
import jax
import numpy as np

from evflow.estimation.refine.denoise import denoised
from evflow.estimation.refine.pixels import PixelEvidence, evidence_of
from evflow.estimation.refine.readouts import without_readouts
from evflow.estimation.refine.receptor_data import Sample, sample
from evflow.estimation.refine.receptor_search import Found, find
from evflow.estimation.refine.sightings import Sightings, no_sightings, sight
from evflow.estimation.refine.stretches import (
    BAND,
    LARGE,
    PART,
    most_simulated,
    plan_chunks,
    plan_runs,
    spread,
)
from evflow.estimation.refine.trace import Trace, trace_of_events
from evflow.files.spool import put_aside
from evflow.light.log_maps import lin_log
from evflow.process.memory import give_back
from evflow.recordings.bunches import bunch
from evflow.recordings.glitches import SATURATED_DN, exposed
from evflow.recordings.region import bands, inside
from evflow.simulator.between import intervals
from evflow.simulator.motion import speed
from evflow.simulator.photoreceptor import FAST, IDEAL, Photoreceptor, seen_path
from evflow.types import Events, Recording

STEPS = 16  # fine frames per interval: motion of 16 px per frame still moves 1 px a step
STRETCHES = 3  # used in the search for the photoreceptor

Box = tuple[slice, slice]
WHOLE: Box = (slice(None), slice(None))
Place = tuple[Recording, Sequence[int]]  # a recording and a run of its frame intervals


@dataclasses.dataclass(frozen=True, eq=False)
class Chunk:
    """One stretch of a recording, K frame intervals.

    path: (K * steps + 1, H, W) float32 log intensity, the frames at every `steps`-th;
    bright: (H, W) bool, pixels whose frames are neither near black nor saturated;
    dt_s: (K,) interval lengths; motion_px: (K,) fast motion per interval;
    recorded: the events' Trace; evidence: about each pixel's thresholds;
    quiet: (4, H, W) over intervals in which the pixel's path stays within QUIET and no frame is
    saturated or black: events, seconds, number of intervals, number of intervals with events;
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


QUIET = 0.05  # log units: below the thresholds of usable cameras
DARK_DN = 15.0  # below it, half a DN of noise is .03 log units


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
        sightings = sight(events, times, fine, steps, film.shown)
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


@dataclasses.dataclass(frozen=True, eq=False)
class Film:
    """Frames of a run and interpolated frames. frames: (K + 1, H, W) DN; dn: (K * steps + 1, H, W)
    DN; times_us: (K + 1,); dt_s: (K,) interval lengths; motion_px: (K,) fast motion; shown:
    (K + 1, H, W) bool, neither saturated nor black."""

    frames: np.ndarray
    dn: np.ndarray
    times_us: np.ndarray
    dt_s: np.ndarray
    motion_px: np.ndarray
    shown: np.ndarray


Films = dict[tuple[int, ...], Film]  # by `of_place`


def of_place(recording: Recording, run: Sequence[int]) -> tuple[int, ...]:
    """Key of the film of these intervals; valid while the recording object exists."""
    return id(recording), *run


def interpolated(
    recording: Recording, run: Sequence[int], steps: int = STEPS, noise_dn: float = 0.0
) -> Film:
    """The frames of a run of intervals, denoised (std noise_dn), with `steps` - 1 frames
    interpolated by optical flow in each interval."""
    frames = [recording.frame_dn(i) for i in [*run, run[-1] + 1]]
    times = recording.frame_times[run[0]:run[-1] + 2]
    clean = [denoised(frame, noise_dn) for frame in frames]
    dn, motion = np.empty((len(run) * steps + 1, *clean[0].shape), np.float32), []
    dn[::steps] = clean
    for k, interval in enumerate(intervals(zip(clean, times.tolist(), strict=True), jerk=False)):
        # not sharp: the fusion network was trained on this contrast; sharp frames bias thresholds
        between = interval.at(np.arange(1, steps) / steps, sharp=False)
        for row, picture in zip(dn[k * steps + 1:], between, strict=False):
            row[:] = picture
        motion.append(speed(interval.motion.there))
    return Film(
        np.stack(frames), dn, times, np.diff(times).astype(np.float32) * 1e-6,
        np.array(motion, np.float32), np.stack([exposed(frame) for frame in frames]))


def as_seen(film: Film, seen_by: Photoreceptor, out: np.ndarray | None = None) -> np.ndarray:
    """The path (K * steps + 1, H, W) in log units behind a photoreceptor. out: array for the result
    of large sensors, which are processed in bands; film.dn if that may be overwritten."""
    steps = (len(film.dn) - 1) // len(film.dt_s)
    dt_s = np.repeat(film.dt_s / steps, steps).astype(np.float32)
    values = [np.float32(v) for v in (seen_by.offset_dn, max(seen_by.tau_s, FAST))]

    def seen(dn: np.ndarray) -> jax.Array:
        if not seen_by.offset_dn and not seen_by.tau_s:
            return _log(dn)
        return _seen(dn, dt_s, *values, seen_by.by_light)

    if film.dn[0].size <= LARGE:
        return np.asarray(seen(film.dn))
    out = np.empty_like(film.dn) if out is None else out
    for rows in bands(film.dn.shape[1:], BAND):
        out[:, rows] = seen(np.ascontiguousarray(film.dn[:, rows]))
    return out


_seen, _log = jax.jit(seen_path), jax.jit(lin_log)


def receptor_places(places: Sequence[Place]) -> list[Place]:
    """At most STRETCHES of the places, evenly spread, for the search for the photoreceptor."""
    if not places:
        return []
    longest = spread([len(run) for _, run in places], most_simulated(places[0][0].events.size))
    chosen = np.unique(np.linspace(0, len(longest) - 1, min(STRETCHES, len(longest))).round())
    return [places[longest[k]] for k in chosen.astype(int)]


def receptor_sample(
    places: Sequence[Place], noise_dn: float = 0.0, films: Films | None = None
) -> Sample | None:
    """Pixels and events for the search for the photoreceptor.

    Args:
        places: runs of frame intervals, of which `receptor_places` are used.
        noise_dn: std of the frames' noise.
        films: cache that receives the interpolated runs, if these are few and small.

    Returns:
        The sample; None with too few events.
    """
    def parts() -> Iterator[tuple[np.ndarray, np.ndarray, Sightings, np.ndarray]]:
        for recording, run in receptor_places(places):
            film = interpolated(recording, run, STEPS, noise_dn)
            s = sight(recording.events, film.times_us, as_seen(film, IDEAL), STEPS, film.shown)
            s, disturbed = without_readouts(s, film.times_us, bunch(recording))
            if films is not None and len(places) <= STRETCHES and film.dn[0].size <= LARGE:
                films[of_place(recording, run)] = film
            yield film.dn, np.repeat(film.dt_s / STEPS, STEPS), s, disturbed
            del film, s, disturbed
            give_back()

    return sample(parts())


def find_photoreceptor(
    places: Sequence[Place], noise_dn: float = 0.0, films: Films | None = None
) -> Found | None:
    """The photoreceptor of a camera and the offset and delay of its frames; None with too few
    events. Arguments as of `receptor_sample`."""
    data = receptor_sample(places, noise_dn, films)
    return find(data) if data is not None else None


def _quiet(path: np.ndarray, trace: Trace, dt_s: np.ndarray, shown: np.ndarray) -> np.ndarray:
    steps = (len(path) - 1) // len(dt_s)
    inner = path[1:].reshape(len(dt_s), steps, *path.shape[1:])
    still = (inner.max(1) - inner.min(1) < QUIET) & shown
    events = np.asarray(trace.counts).sum(1) * still
    return np.stack([events.sum(0), (dt_s[:, None, None] * still).sum(0), still.sum(0),
                     (events > 0).sum(0)])

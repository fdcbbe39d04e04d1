"""Validation of an estimate: the recording's own frames, simulated with the estimated camera.

A stretch of the recording is simulated twice. One begins with pixels that remember the first frame,
the other, with another key, with pixels that remember anything, as those of the camera may: if the
estimate and the path were true, recording and simulation would agree as much as these two. Work is
bounded: the busiest seconds, and for the held-out half an estimate from the seconds before its
middle. Host side.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from evflow.errors import EvflowDataError
from evflow.estimation.halves import FirstPart
from evflow.estimation.pipeline import estimate_camera
from evflow.estimation.refine import frame_noise, receptor_sample
from evflow.estimation.refine.frame_exposure import TELLING, with_exposure
from evflow.estimation.refine.receptor_search import explained
from evflow.estimation.refine.stretches import INTERVALS
from evflow.estimation.refine.waiting import without_waiting
from evflow.estimation.result import CameraEstimate
from evflow.metrics.space_time import space_time_r
from evflow.metrics.streams import compare, correlations
from evflow.notes import Note
from evflow.process.memory import give_back
from evflow.recordings.bunches import beside, bunch
from evflow.recordings.region import outside
from evflow.recordings.windows import plan_windows
from evflow.report.running import Picture, running
from evflow.simulator import simulate_stream
from evflow.simulator.interpolate import MIN_SIDE, Seen, notes_on, unzip, upsample
from evflow.simulator.photoreceptor import as_measured, seen_frames
from evflow.types import Events, Recording, release

SECONDS = 3.0  # of recording, at most, that are simulated
PIXELS = 100 * 346 * 260  # of frames, at most: 100 frames of a DAVIS346
LEARNT_SECONDS = 5.0  # of the first half that are used for the held-out estimate
SETTLING = 3  # with at least this many intervals, the first is left out of the comparison
INSTANT_US = 30_000  # duration of an event image
USUAL = 25  # interpolated pictures per frame, where much moves
MOST_KEPT = 160_000_000  # bytes of pictures: half a second of a DAVIS346

Run = tuple[int, int]  # first and last frame


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """A stretch of a recording beside its re-simulation.

    real, made: their events over span_us = (t0, t1), which begins one frame after the simulation if
    there is room; frames: (first, last) of those simulated; numbers: `compare(real, made)`;
    ceiling: the correlation of the counts of two re-simulations, per polarity, and their
    "space_time_r"; instant_us: start of the busiest 30 ms; notes: from the interpolation.
    """

    real: Events
    made: Events
    span_us: tuple[int, int]
    frames: Run
    numbers: dict[str, Any]
    ceiling: dict[str, float | None]
    instant_us: int
    notes: tuple[Note, ...]


def usable_runs(recording: Recording) -> list[Run]:
    """(first, last) frames of the runs without a gap or fault that the events cover.

    Raises EV011, EV012 if there are no frames or no overlap, EV017 if no two neighbours are usable.
    """
    runs: list[Run] = []
    for first, last in plan_windows(recording, 1).pairs:
        if runs and runs[-1][1] == first:
            runs[-1] = (runs[-1][0], last)
        else:
            runs.append((first, last))
    if not runs or max(recording.frames.shape[1:]) < MIN_SIDE:
        raise EvflowDataError("EV017", "no two successive frames that the events cover are usable.",
                              "Re-simulation needs a moving picture.")
    return runs


def busiest(recording: Recording, runs: list[Run], seconds: float = SECONDS) -> Run:
    """The part of a run, at most `seconds` and PIXELS long, with the most events."""
    times = recording.frame_times
    width, height = recording.events.size
    most = max(2, PIXELS // (width * height))
    before = np.searchsorted(recording.events.t, times)
    release(recording)
    best, found = -1, runs[0]
    for first, end in runs:
        for start in range(first, end):
            reach = int(np.searchsorted(times, times[start] + seconds * 1e6, side="right")) - 1
            stop = min(end, start + most, max(start + 1, reach))
            events = int(before[stop] - before[start])
            if events > best:
                best, found = events, (start, stop)
    return found


class Pictures:
    """A recording's frames and what `upsample` adds between them; those of the last run are kept if
    they are few, since parts of it may be needed again. seen: of that run's intervals."""

    def __init__(self, recording: Recording) -> None:
        self.recording, self.run = recording, (0, 0)
        self.kept: list[Picture] = []
        self.seen: list[Seen] = []

    def of(self, run: Run) -> Iterator[Picture]:
        """Those of the frames (first, last), in DN, and their times in us."""
        times = self.recording.frame_times
        if self.kept and self.run[0] <= run[0] < run[1] <= self.run[1]:
            return (p for p in self.kept if times[run[0]] <= p[1] <= times[run[1]])
        self.kept, self.seen, self.run = [], [], run
        frames = ((self.recording.frame_dn(i), int(times[i])) for i in range(run[0], run[1] + 1))
        made = upsample(frames, exposure_us=self.recording.exposure_us, tell=self.seen.append)
        width, height = self.recording.events.size
        many = (run[1] - run[0]) * USUAL * 4 * width * height > MOST_KEPT
        return made if many else self._kept(made)

    def notes(self, run: Run) -> tuple[Note, ...]:
        """Notes on difficulties in interpolating these frames, after they were requested."""
        begin, end = (int(self.recording.frame_times[i]) for i in run)
        return tuple(notes_on([s for s in self.seen if begin <= s.t0 and s.t1 <= end]))

    def _kept(self, made: Iterator[Picture]) -> Iterator[Picture]:
        kept: list[Picture] = []
        size = 0
        for picture in made:
            size += picture[0].nbytes
            kept.append(picture)
            if size > MOST_KEPT:
                kept.clear()
            yield picture
        self.kept = kept if size <= MOST_KEPT else []


def resimulate(
    recording: Recording, found: CameraEstimate, run: Run, seed: int,
    pictures: Pictures | None = None,
) -> Trial:
    """Simulate the frames of `run` twice, interpolated by `upsample` and seen by the measured
    camera, and compare, without hot pixels, whose rates alone would agree anywhere, and without the
    bunches of events at frames, which no simulation makes.
    pictures: of the recording, if another part of it is simulated as well."""
    pictures = pictures or Pictures(recording)
    seen_by, model = as_measured(found.sensor, found.optics)
    keys = jax.random.split(jax.random.key(seed))
    shown, again_shown = itertools.tee(seen_frames(pictures.of(run), seen_by))
    videos = shown, running(jax.random.fold_in(keys[1], 1), again_shown, found.camera)
    streams = [simulate_stream(key, *unzip(video), found.camera, model=model, full_scale=255)
               for key, video in zip(keys, videos, strict=True)]
    parts = list(zip(*streams, strict=True))  # in parallel, so that few frames are buffered
    begin = run[0] + 1 if run[1] - run[0] >= SETTLING else run[0]
    span = (int(recording.frame_times[begin]), int(recording.frame_times[run[1]]))
    made, again = (outside(Events.concatenate(p).slice(*span), found.hot)
                   for p in zip(*parts, strict=True))
    real = outside(recording.events.slice(*span), found.hot)
    disturbed = bunch(recording)
    if disturbed is not None:
        real, made, again = (beside(e, recording.frame_times, disturbed)
                             for e in (real, made, again))
    ceiling = {**correlations(*(e.count_map().astype(np.float64) for e in (made, again))),
               "space_time_r": space_time_r(made, again, *span)}
    del parts, again
    release(recording)
    give_back()
    return Trial(real, made, span, run, compare(real, made, span_us=span), ceiling,
                 busiest_instant(real, span), pictures.notes(run))


def busiest_instant(events: Events, span_us: tuple[int, int], length_us: int = INSTANT_US) -> int:
    """When the `length_us` with the most events begin, within the span (us)."""
    step = max(1, length_us // 3)
    count = max(0, span_us[1] - length_us - span_us[0]) // step + 1
    if count > len(events):  # mostly empty, as where a clock jumped
        near = np.unique((events.slice(*span_us).t - span_us[0]) // step)
        places = np.unique(np.clip(near[:, None] - np.arange(4), 0, count - 1))
    else:
        places = np.arange(count)
    starts = span_us[0] + step * (places if len(places) else np.zeros(1, np.int64))
    inside = np.searchsorted(events.t, starts + length_us) - np.searchsorted(events.t, starts)
    return int(starts[int(np.argmax(inside))])


def held_out(
    recording: Recording, params: Any, runs: list[Run], min_window_us: int, seed: int,
    first: FirstPart | None = None, pictures: Pictures | None = None,
) -> tuple[CameraEstimate, Trial, tuple[float, float] | None]:
    """An estimate from the first part of a recording, tested on the rest, and `held_out_shares`
    there. first: what an estimate computed; without it, the first part is the last LEARNT_SECONDS
    of the first half of the longest run. Raises EV017 if a half is too short to estimate from."""
    if first is not None:
        found, rest = first.estimate(), first.rest_of(recording)
    else:
        half, rest = _halved(recording, runs)
        found = estimate_camera(half, params, min_window_us=min_window_us)
        if found.optics.exposure_s:
            recording = with_exposure(recording, found.optics.exposure_s)
            pictures = None
    trial = resimulate(recording, found, busiest(recording, [rest]), seed, pictures)
    return found, trial, held_out_shares(recording, found, rest)


def _halved(recording: Recording, runs: list[Run]) -> tuple[Recording, Run]:
    """The first half of the longest run, or its end, and the frames of the second half."""
    first, last = max(runs, key=lambda r: r[1] - r[0])
    times = recording.frame_times
    middle = int(np.searchsorted(times, (int(times[first]) + int(times[last])) // 2))
    if not first < middle < last:
        raise EvflowDataError("EV017", f"the frames {first} to {last} cannot be halved.",
                              "Record longer.")
    begin = max(first, int(np.searchsorted(times, times[middle] - LEARNT_SECONDS * 1e6)))
    half = dataclasses.replace(
        recording, events=recording.events.slice(int(times[begin]), int(times[middle])),
        frames=recording.frames[begin:middle + 1], frame_times=times[begin:middle + 1],
        notes=tuple(note for note in recording.notes if note.code in TELLING))
    return half, (middle, last)


def held_out_shares(
    recording: Recording, found: CameraEstimate, run: Run
) -> tuple[float, float] | None:
    """Shares of the variance of brightness at the events of other frames (first, last) that an
    estimate's thresholds explain: with an ideal pixel, and with the measured photoreceptor. None if
    one of the two is undefined."""
    intervals = [(recording, i) for i in range(*run)]
    places = [(recording, tuple(i for _, i in intervals[k:k + INTERVALS]))
              for k in range(0, len(intervals), INTERVALS)]
    if found.receptor is None:
        return None
    data = receptor_sample(places, frame_noise(intervals))
    if data is None:
        return None
    if found.sensor.in_dead_time != "resets":
        data = without_waiting(data, found.sensor.refractory_s)
    receptor = found.receptor
    ideal = explained(data, receptor.ideal, receptor.ideal_theta)
    seen = explained(data, receptor.seen, receptor.theta) if receptor.needed else ideal
    return None if np.isnan(ideal + seen) else (ideal, seen)

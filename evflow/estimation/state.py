"""What has been read of a camera so far, as a value, and the two operations on it: `add` a stretch,
and `estimate` the camera.

A `State` consists of sums over what was read (maps of evidence) and the few stretches that are
simulated. Only its references to what was read grow; `thinned` bounds them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow.camera import Summary
from evflow.camera.sensors import SensorModel
from evflow.estimation import drift, maps
from evflow.estimation.dead_time import DeadTime, dead_time
from evflow.estimation.extent import EVERYTHING, Extent
from evflow.estimation.leak import Leak, measured_leak
from evflow.estimation.one_polarity import undetermined, without
from evflow.estimation.pooled import Quiet, need_shown, quiet_times, window_counts, window_stats
from evflow.estimation.refine import (
    Chunk,
    Found,
    PixelEvidence,
    Stretch,
    find_photoreceptor,
    frame_noise,
    make_chunk,
    simulated_part,
)
from evflow.estimation.refine.doubt import doubted, signs
from evflow.estimation.refine.path import STEPS, Films, of_place, without_evidence
from evflow.estimation.remarks import camera_notes, noise_notes, receptor_notes
from evflow.estimation.result import CameraEstimate
from evflow.estimation.shot import Shot, at_mean_light, measured_noise, measured_shot, scatter
from evflow.files.spool import forget
from evflow.network import api
from evflow.notes import Note
from evflow.process.memory import give_back
from evflow.recordings.check.contents import VALID_EVENTS
from evflow.recordings.faulty_pixels import dead_pixels, hot_pixels
from evflow.recordings.windows import window_at
from evflow.simulator.photoreceptor import IDEAL, Photoreceptor
from evflow.types import Events, Window, release

Array = np.ndarray
Advance = Callable[[], None]
Stage = Callable[[str], None]
MOST_EVENTS = 16_000_000  # used to look for the dead time, from the start
SIGNAL_ERROR = 0.1  # relative error of noise rates if something moves: residual signal


@dataclasses.dataclass(frozen=True, eq=False)
class Eyes:
    """How the pixels see what the frames show, the frames' noise in DN, and the dead time: measured
    before anything else is read, as all evidence depends on it. films: of stretches to be read."""

    seen_by: Photoreceptor = IDEAL
    noise_dn: float = 0.0
    found: Found | None = None
    dead: DeadTime = dataclasses.field(default_factory=DeadTime)
    films: Films = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """params: of the network. stats, n_events, n_shown (H, W), evidence, quiet (4, H, W): sums over
    all that was read; chunks: stretches to simulate; read: stretches whose quiet time is counted at
    the end; windows, seconds: amounts read; parts: of each stretch, what drift.py compares."""

    params: api.Params
    eyes: Eyes
    stats: api.Stats | None = None
    n_events: Array = dataclasses.field(default_factory=lambda: np.zeros(()))
    n_shown: Array = dataclasses.field(default_factory=lambda: np.zeros(()))
    evidence: PixelEvidence | None = None
    quiet: Array | None = None
    chunks: tuple[Chunk, ...] = ()
    read: tuple[Stretch, ...] = ()
    windows: int = 0
    seconds: float = 0.0
    parts: tuple[drift.Part, ...] = ()

    def __add__(self, more: State) -> State:
        """The sum of this and of what was read after it, with the same eyes."""
        def total(one: Any, other: Any) -> Any:
            return other if one is None else one if other is None else one + other

        return dataclasses.replace(self, **{
            field.name: total(getattr(self, field.name), getattr(more, field.name))
            for field in dataclasses.fields(self) if field.name not in ("params", "eyes")})


def looked_through(stretches: Sequence[Stretch], *, measured: bool) -> Eyes:
    """The eyes of a camera, from some of its stretches. measured: False assumes ideal pixels."""
    dead = dead_time(first_events(max((s.recording.events for s in stretches), key=len)))
    runs = [(s.recording, s.run) for s in stretches if s.run]
    if not runs:
        return Eyes(dead=dead)
    noise_dn = frame_noise([(recording, i) for recording, run in runs for i in run])
    films: Films = {}
    found = find_photoreceptor(runs, noise_dn, films) if measured else None
    return Eyes(found.seen if found is not None and found.needed else IDEAL, noise_dn, found,
                dead, films)


def first_events(events: Events) -> Events:
    """The first MOST_EVENTS events."""
    if len(events) <= MOST_EVENTS:
        return events
    return events.slice(int(events.t[0]), int(events.t[MOST_EVENTS]))


def add(
    state: State, stretch: Stretch, *, simulate: bool, every: int = 1,
    advance: Advance = lambda: None,
) -> State:
    """The state with one more stretch; arguments as for `look`."""
    return state + look(state, stretch, simulate=simulate, every=every, advance=advance)


def look(
    state: State, stretch: Stretch, *, simulate: bool, every: int = 1,
    advance: Advance = lambda: None,
) -> State:
    """The evidence of a single stretch, with a state's eyes. simulate: whether the refinement
    simulates it; every: which of its windows are pooled (each, or every second); advance() is
    called after every window, and after the stretch."""
    give_back()
    stats, n_events, n_shown = None, np.zeros(()), np.zeros(())
    for number, window in enumerate(_windows([stretch])):
        if number % every == 0:
            said = window_stats(state.params, window, state.eyes.seen_by)
            stats = said if stats is None else stats + said
        counts, shown = window_counts(window)
        n_events, n_shown = n_events + counts, n_shown + shown
        advance()
    seen = State(
        state.params, state.eyes, stats, n_events, n_shown, read=(stretch,),
        windows=len(stretch.windows), seconds=1e-6 * (stretch.span_us[1] - stretch.span_us[0]))
    if not stretch.run:
        return seen
    give_back()
    seen = add_path(seen, stretch, simulate=simulate)
    release(stretch.recording)
    give_back()
    advance()
    return seen


def add_path(state: State, stretch: Stretch, *, simulate: bool) -> State:
    """The state with the evidence from the path between a stretch's frames, without windows."""
    place, seen_by = (stretch.recording, stretch.run), state.eyes.seen_by
    chunk = make_chunk(*place, STEPS, seen_by, state.eyes.noise_dn, first=stretch.first,
                       film=state.eyes.films.pop(of_place(*place), None))
    kept = simulated_part(chunk, place, seen_by) if simulate else None
    added = State(state.params, state.eyes, evidence=chunk.evidence, quiet=chunk.quiet,
                  chunks=(without_evidence(kept),) if kept else (),
                  parts=(drift.part(stretch.span_us, chunk.evidence),))
    del chunk  # a film of the whole sensor
    return state + added


def glance(state: State) -> tuple[Summary, Summary]:
    """The camera's summary so far and its std, before any refinement; takes no time."""
    assert state.stats is not None
    summary, std = api.finish(state.params, state.stats)
    found = state.eyes.found
    if found is not None and not state.eyes.seen_by.ideal and state.evidence is not None:
        summary, std = maps.regressed(summary, std, found)
    return summary, std


@dataclasses.dataclass(frozen=True, eq=False)
class Refined:
    """hot: (H, W) bool; chunks: without these pixels; summary, std: of the camera, before
    refine/doubt.py; signs: the input of that, None if nothing was searched for on the path."""

    hot: Array
    chunks: tuple[Chunk, ...]
    summary: Summary
    std: Summary
    signs: Array | None = None


def refine(state: State) -> Refined:
    """The camera's summary by simulation and regression, if there is a path between frames."""
    summary, std = glance(state)
    hot = np.zeros(np.shape(state.n_events), bool)
    if state.evidence is None or state.quiet is None:
        return Refined(hot, state.chunks, summary, std)
    found = state.eyes.found
    hot = hot_pixels(
        state.quiet, float(np.float32(summary.eta_on) + np.float32(summary.eta_off)),
        state.n_events, state.seconds)
    chunks = tuple(_without_hot(c, hot) for c in state.chunks)
    summary, std = maps.refined(state.params, list(chunks), summary, std)
    forget(*(c.path for c in chunks))
    if found is None:
        return Refined(hot, chunks, summary, std)
    if not state.eyes.seen_by.ideal:
        std = maps.widened(summary, std, found)
    return Refined(hot, chunks, summary, std, signs(found, state.eyes.noise_dn, summary, std))


def estimate(
    state: State, *, extent: Extent | None = None, before: Sequence[Note] = (),
    after: Sequence[Note] = (), advance: Advance = lambda: None, stage: Stage = lambda _: None,
) -> CameraEstimate:
    """The camera, from all that was read. extent: how much was read; before, after: notes on
    reading, placed around its own; advance() is called after every window that is read again,
    stage() with the name of each stage."""
    assert state.stats is not None
    need_shown(state.n_events, state.n_shown)
    stage("refining")
    eyes, stats = state.eyes, state.stats
    n_events = state.n_events.astype(np.uint32)
    refined = refine(state)
    hot, summary, std = refined.hot, refined.summary, refined.std
    dead = dead_pixels(n_events)
    doubt = next(iter(state.params.values())).get("doubt")
    if lacking := undetermined(stats, summary):
        summary, std = without(lacking, list(refined.chunks), summary, std)
    elif doubt is not None and refined.signs is not None:
        std = doubted(doubt, refined.signs, summary, std)
    stage("noise rates and maps")
    quiet = quiet_times(_counted(_windows(state.read), advance), summary, hot, eyes.seen_by)
    std = maps.with_unquiet_error(summary, std, quiet.share, quiet.pixel_s)
    leak = measured_leak(quiet.waits)
    shot = measured_shot(quiet.light, leak.rate_hz, scatter(quiet.maps, hot), SIGNAL_ERROR)
    sent = quiet.maps
    if shot.falls:
        sent = quiet.at_mean_light()
        summary, std = _at_mean_light(summary, std, quiet, leak)
    if state.evidence is not None:
        camera, error = maps.by_regression(state.evidence, summary, std)
    else:
        again = _counted(_windows(state.read), advance)
        camera, error = maps.by_flow(state.params, again, summary, std)
    camera, error = maps.with_rates(camera, error, sent, hot, summary, std)
    extent, thirds = extent or EVERYTHING, drift.thirds(state.parts)
    return CameraEstimate(
        camera, error, summary, std, (state.n_shown >= VALID_EVENTS) & ~hot, n_events, hot, dead,
        state.windows,
        (*before, *camera_notes(stats, lacking, n_events, summary, hot, dead),
         *receptor_notes(eyes.found), *noise_notes(shot), *after, *extent.notes(),
         *drift.notes(thirds)),
        tuple(f"theta_{name}" for name in lacking), **_measured(eyes, leak, shot),
        extent=extent, thirds=thirds)


def _at_mean_light(
    summary: Summary, std: Summary, quiet: Quiet, leak: Leak
) -> tuple[Summary, Summary]:
    """The summary with noise rates at the recording's mean light."""
    eta, error = (np.array([float(s.eta_on), float(s.eta_off)]) for s in (summary, std))
    eta, error = at_mean_light(eta, error, quiet.light, leak.rate_hz, quiet.factor, SIGNAL_ERROR)
    names = ("eta_on", "eta_off")
    return (dataclasses.replace(summary, **dict(zip(names, map(jnp.float32, eta), strict=True))),
            dataclasses.replace(std, **dict(zip(names, map(jnp.float32, error), strict=True))))


def _measured(eyes: Eyes, leak: Leak, shot: Shot) -> dict[str, Any]:
    """The fields of a CameraEstimate that are not per pixel."""
    found, dead = eyes.found, eyes.dead
    sensor, std = found.sensor if found else (SensorModel(noise_resets_memory=True), {})
    sensor, std = measured_noise(sensor, std, leak, shot)
    fields = {"sensor": dataclasses.replace(sensor, refractory_s=dead.seconds),
              "sensor_std": {**std, "refractory_s": dead.std_s}}
    return {**fields, "optics": found.optics, "receptor": found} if found else fields


def _without_hot(chunk: Chunk, hot: Array) -> Chunk:
    return dataclasses.replace(chunk, bright=chunk.bright & ~hot[chunk.box])


def _windows(stretches: Sequence[Stretch]) -> Iterator[Window]:
    for stretch in stretches:
        for number, pair in stretch.windows:
            yield window_at(stretch.recording, pair, number)
        release(stretch.recording)


def _counted(windows: Iterator[Window], advance: Advance) -> Iterator[Window]:
    """The windows; advance() is called after each."""
    for window in windows:
        yield window
        advance()


def thinned(state: State, chunks: int, read: int) -> State:
    """The state with every second simulated stretch dropped if there are `chunks` of them, and
    likewise for the stretches whose quiet time is counted, `read`."""
    return dataclasses.replace(
        state, chunks=state.chunks[::2] if 1 < chunks <= len(state.chunks) else state.chunks,
        read=state.read[::2] if len(state.read) >= read else state.read)

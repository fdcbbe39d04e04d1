"""From everything that was read (`State`) to the camera: refinement, noise rates, maps, notes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow.camera import Summary
from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.estimation import drift, maps
from evflow.estimation.extent import EVERYTHING, Extent
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.leak import Leak, measured_leak
from evflow.estimation.one_polarity import (
    no_more_than_all,
    undetermined,
    with_prior,
    without_those,
)
from evflow.estimation.pooled import Quiet, need_shown, quiet_times
from evflow.estimation.refine import Chunk
from evflow.estimation.remarks import camera_notes, lost_notes, noise_notes, receptor_notes
from evflow.estimation.result import CameraEstimate
from evflow.estimation.shot import Shot, at_mean_light, measured_noise, measured_shot, scatter
from evflow.estimation.state import Advance, State, summary_so_far, windows_of
from evflow.files.spool import forget
from evflow.notes import Note
from evflow.recordings.check.contents import VALID_EVENTS
from evflow.recordings.faulty_pixels import dead_pixels, hot_pixels
from evflow.types import Window

Array = np.ndarray
Stage = Callable[[str], None]
SIGNAL_ERROR = 0.1  # relative error of noise rates if something moves: residual signal


@dataclasses.dataclass(frozen=True, eq=False)
class Known:
    """What is known of the camera, before or after its refinement.

    hot, dead: (H, W) bool; chunks: without these pixels; summary, std: of the camera; optics: of
    the frames, None if they were not measured."""

    hot: Array
    dead: Array
    chunks: tuple[Chunk, ...]
    summary: Summary
    std: Summary
    optics: Optics | None

    @property
    def faulty(self) -> Array:
        """(H, W) bool: pixels whose silence or noise is not the camera's."""
        return self.hot | self.dead


def starting(state: State) -> Known:
    """The camera's summary before it is refined, and the chunks of the path between frames, if
    there is one, on which it is."""
    summary, std = summary_so_far(state)
    found = state.front_end.found
    optics = found.optics if found else None
    dead = dead_pixels(np.asarray(state.n_events))
    if state.quiet is None:
        return Known(np.zeros(dead.shape, bool), dead, state.chunks, summary, std, optics)
    hot = hot_pixels(
        state.quiet, float(np.float32(summary.eta_on) + np.float32(summary.eta_off)),
        state.n_events, state.seconds)
    chunks = tuple(_without(c, hot | dead) for c in state.chunks)
    return Known(hot, dead, chunks, summary, std, optics)


def refine(state: State) -> Known:
    """The same with the summary refined by simulation, if there is a path between frames."""
    start = starting(state)
    if state.quiet is None:
        return start
    summary, std, optics = maps.refined(
        state.params, list(start.chunks), start.summary, start.std, state.front_end)
    forget(*(c.path for c in start.chunks))
    return dataclasses.replace(start, summary=summary, std=std, optics=optics)


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
    front_end, n_events = state.front_end, state.n_events.astype(np.uint32)
    refined = refine(state)
    hot, dead, summary, std = refined.hot, refined.dead, refined.summary, refined.std
    pooled_hot = hot if front_end.faulty is None else hot & ~front_end.faulty
    stats = without_those(state.stats, state.sent[:, pooled_hot].sum(1))
    alone: tuple[str, ...] = ()
    if lacking := undetermined(stats, summary):
        summary, std, alone = with_prior(lacking, list(refined.chunks), summary, std)
    summary, std = no_more_than_all(stats, summary, std)
    stage("noise rates and maps")
    quiet = quiet_times(
        _counted(windows_of(state.read), advance), summary, refined.faulty, front_end.seen_by)
    std = maps.with_unquiet_error(summary, std, quiet.share, quiet.pixel_s)
    leak = measured_leak(quiet.waits)
    shot = measured_shot(
        quiet.light, leak.rate_hz, scatter(quiet.maps, refined.faulty), SIGNAL_ERROR)
    sent = quiet.at_mean_light() if shot.falls else quiet.maps.copy()
    sent[:, 1, dead] = 0.0  # seconds in which noise could be seen
    if shot.falls:
        summary, std = _at_mean_light(summary, std, quiet, leak)
    if state.evidence is not None:
        camera, error = maps.by_regression(state.evidence.without(dead), summary, std)
    else:
        again = _counted(windows_of(state.read), advance)
        camera, error = maps.by_flow(state.params, again, summary, std)
    camera, error, summary, std = maps.with_rates(camera, error, sent, hot, summary, std)
    if lost := front_end.lost:
        camera, error, summary, std = maps.with_contrast_lost(camera, error, summary, std, lost)
    extent = extent or EVERYTHING
    thirds = drift.thirds(state.parts, lost.excess if lost else 1.0)
    return CameraEstimate(
        camera, error, summary, std, (state.n_shown >= VALID_EVENTS) & ~hot, n_events, hot, dead,
        state.windows,
        (*before, *camera_notes(stats, lacking, alone, n_events, summary, hot, dead),
         *receptor_notes(front_end.found, refined.optics, summary, std), *lost_notes(lost),
         *noise_notes(shot), *after,
         *extent.notes(), *drift.notes(thirds)),
        tuple(f"theta_{name}" for name in lacking),
        **_measured(front_end, refined.optics, leak, shot), extent=extent, thirds=thirds)


def _at_mean_light(
    summary: Summary, std: Summary, quiet: Quiet, leak: Leak
) -> tuple[Summary, Summary]:
    """The summary with noise rates at the recording's mean light."""
    eta, error = (np.array([float(s.eta_on), float(s.eta_off)]) for s in (summary, std))
    eta, error = at_mean_light(eta, error, quiet.light, leak.rate_hz, quiet.factor, SIGNAL_ERROR)
    names = ("eta_on", "eta_off")
    return (dataclasses.replace(summary, **dict(zip(names, map(jnp.float32, eta), strict=True))),
            dataclasses.replace(std, **dict(zip(names, map(jnp.float32, error), strict=True))))


def _measured(
    front_end: FrontEnd, optics: Optics | None, leak: Leak, shot: Shot
) -> dict[str, Any]:
    """The fields of a CameraEstimate that are not per pixel."""
    found, dead = front_end.found, front_end.dead
    sensor, std = found.sensor if found else (SensorModel(noise_resets_memory=True), {})
    sensor, std = measured_noise(sensor, std, leak, shot)
    fields = {"sensor": dataclasses.replace(sensor, refractory_s=dead.seconds),
              "sensor_std": {**std, "refractory_s": dead.std_s}}
    return {**fields, "optics": optics, "receptor": found} if found else fields


def _without(chunk: Chunk, faulty: Array) -> Chunk:
    return dataclasses.replace(chunk, bright=chunk.bright & ~faulty[chunk.box])


def _counted(windows: Iterator[Window], advance: Advance) -> Iterator[Window]:
    """The windows; advance() is called after each."""
    for window in windows:
        yield window
        advance()

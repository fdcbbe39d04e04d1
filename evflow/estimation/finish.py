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
from evflow.estimation import drift, maps, rested
from evflow.estimation.extent import EVERYTHING, Extent
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.leak import Leak, measured_leak
from evflow.estimation.one_polarity import (
    POLARITIES,
    no_more_than_all,
    undetermined,
    with_prior,
    without_those,
)
from evflow.estimation.pixel_noise import hot_rates
from evflow.estimation.pooled import Quiet, need_shown, quiet_times
from evflow.estimation.refine import Chunk
from evflow.estimation.remarks import (
    camera_notes,
    drift_notes,
    lost_notes,
    noise_notes,
    receptor_notes,
    timing_notes,
)
from evflow.estimation.result import CameraEstimate
from evflow.estimation.shot import Shot, at_mean_light, measured_noise, measured_shot, scatter
from evflow.estimation.state import Advance, State, summary_so_far, windows_of, with_a_chunk
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
    state = with_a_chunk(state)
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


def _mismatch(summary: Summary) -> np.ndarray:
    """(2,) ON and OFF, relative to the thresholds."""
    return np.array([summary.sigma_on / summary.theta_on, summary.sigma_off / summary.theta_off])


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
    stats = without_those(state.stats, state.pooled[:, hot].sum(1))
    alone: tuple[str, ...] = ()
    if lacking := undetermined(stats, summary):
        summary, std, alone = with_prior(lacking, list(refined.chunks), summary, std)
    summary, std = no_more_than_all(stats, summary, std)
    if rolling_s := front_end.timing.rolling.seconds:
        std = maps.with_rolling_error(summary, std, rolling_s)
    stage("noise rates and maps")
    quiet = quiet_times(
        _counted(windows_of(state.read), advance), summary, refined.faulty, front_end.seen_by)
    std = maps.with_unquiet_error(summary, std, quiet.share, quiet.pixel_s)
    summary, std, quiet, by_drift = without_drift(
        state, refined.faulty, lacking, summary, std, quiet)
    # A memory that leaks is like light that rises.
    leak = Leak() if by_drift[0] else measured_leak(quiet.waits)
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
    if hot.any():
        camera, error = maps.with_hot_rates(
            camera, error, hot, *hot_rates(
                sent, state.sent, state.seconds, hot, _mismatch(summary), alone=shot.falls))
    as_sent = summary
    if lost := front_end.lost:
        camera, error, summary, std = maps.with_contrast_lost(
            camera, error, summary, std, lost, lacking)
    extent = extent or EVERYTHING
    # Each third's thresholds are a regression's, which what is kept does not move.
    thirds = drift.thirds(
        state.parts, lost.excess if lost and lost.law != "keeps" else 1.0)
    return CameraEstimate(
        camera, error, summary, std, (state.n_shown >= VALID_EVENTS) & ~hot, n_events, hot, dead,
        state.windows,
        (*before, *camera_notes(stats, lacking, alone, n_events, summary, hot, dead, by_drift),
         *receptor_notes(
             front_end.found, refined.optics, summary, std, sought=front_end.sought),
         *timing_notes(front_end.timing, refined.optics), *lost_notes(lost, as_sent, summary),
         *noise_notes(shot),
         *drift_notes(quiet.drift, by_drift), *after, *extent.notes(), *drift.notes(thirds)),
        tuple(f"theta_{name}" for name in lacking),
        **_measured(front_end, refined.optics, leak, shot, summary), extent=extent, thirds=thirds)


def without_drift(
    state: State, faulty: Array, lacking: Sequence[str], summary: Summary, std: Summary,
    quiet: Quiet,
) -> tuple[Summary, Summary, Quiet, Array]:
    """Noise of rested pixels, where the light of the scene drifts and they show less of it; and
    (2,) Hz, how much less, 0 where nothing was changed. lacking: polarities without thresholds."""
    theta, eta, error = (np.array([float(getattr(s, f"{name}_{p}")) for p in POLARITIES])
                         for s, name in ((summary, "theta"), (summary, "eta"), (std, "eta")))
    theta[[p in lacking for p in POLARITIES]] = rested.LEAST_THETA
    due = quiet.drift / theta
    if not rested.worth_a_look(eta, due):
        return summary, std, quiet, np.zeros(2)
    at_rest = quiet_times(windows_of(state.read), summary, faulty, state.front_end.seen_by,
                          rested.Rested(faulty.shape, rested.REACH * theta))
    noise = rested.noise_at_rest(eta, due, *at_rest.maps[:, :, ~faulty].sum(2).T)
    if not noise.less.any():
        return summary, std, quiet, np.zeros(2)
    hz, error = np.where(noise.less, [noise.hz, noise.std_hz], [eta, error])
    return (_with_rates(summary, hz), _with_rates(std, error),
            quiet.replaced(at_rest, noise.less), eta - hz)


def _at_mean_light(
    summary: Summary, std: Summary, quiet: Quiet, leak: Leak
) -> tuple[Summary, Summary]:
    """The summary with noise rates at the recording's mean light."""
    eta, error = (np.array([float(s.eta_on), float(s.eta_off)]) for s in (summary, std))
    eta, error = at_mean_light(eta, error, quiet.light, leak.rate_hz, quiet.factor, SIGNAL_ERROR)
    return _with_rates(summary, eta), _with_rates(std, error)


def _with_rates(summary: Summary, eta: Array) -> Summary:
    """The summary, or its std, with these noise rates (2,)."""
    on, off = map(jnp.float32, eta)
    return dataclasses.replace(summary, eta_on=on, eta_off=off)


def _measured(
    front_end: FrontEnd, optics: Optics | None, leak: Leak, shot: Shot, summary: Summary
) -> dict[str, Any]:
    """The fields of a CameraEstimate that are not per pixel."""
    found, dead = front_end.found, front_end.dead
    sensor, std = found.sensor if found else (SensorModel(noise_resets_memory=True), {})
    sensor, std = measured_noise(sensor, std, leak, shot, summary)
    law = front_end.law
    fields = {"sensor": dataclasses.replace(
                  sensor, refractory_s=dead.seconds,
                  dead_contrast="auto" if law == "keeps" else law),
              "sensor_std": {**std, "refractory_s": dead.std_s}}
    exposure = front_end.timing.exposure
    fields["optics"] = dataclasses.replace(
        optics or Optics(), exposure_s=exposure.seconds, exposure_s_std=exposure.std_s)
    return {**fields, "receptor": found} if found else fields


def _without(chunk: Chunk, faulty: Array) -> Chunk:
    return dataclasses.replace(chunk, bright=chunk.bright & ~faulty[chunk.box])


def _counted(windows: Iterator[Window], advance: Advance) -> Iterator[Window]:
    """The windows; advance() is called after each."""
    for window in windows:
        yield window
        advance()

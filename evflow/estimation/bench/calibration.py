"""Calibration on a bench: thresholds from steps of light, noise from a scene at rest.

The paper's ground truth (Section III-B): a screen that fills the view brightens or darkens by a
known dlogI, and a pixel's threshold is dlogI divided by its events; events of a scene at rest are
noise. counting.py counts events per step and rest, steps.py computes thresholds from the counts,
and this module returns a `CameraEstimate`. Noise alone: evflow/estimation/static.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from evflow.camera import THETA_MIN, Camera, Summary
from evflow.camera.sensors import LogMap
from evflow.errors import EvflowDataError
from evflow.estimation.bench.added_light import AddedLight, with_added_light
from evflow.estimation.bench.counting import Span, Steps, counted_steps
from evflow.estimation.bench.coverage import lost_steps, skipped_notes
from evflow.estimation.bench.fast_edges import by_rested, with_fast_edges
from evflow.estimation.bench.latency import measured_latency
from evflow.estimation.bench.leaking import NO_LEAK, Leaking, measured_leaking
from evflow.estimation.bench.levels import few_sizes, measured_bench, size_error, small_steps
from evflow.estimation.bench.logarithm import chosen_map
from evflow.estimation.bench.rests import LEAST_STEP, rests_between
from evflow.estimation.bench.settling import slow
from evflow.estimation.bench.steps import (
    THETA_PRIOR,
    camera_rate,
    camera_wide,
    pixel_and_camera_rates,
    ratio,
    regression,
    return_error,
    unrecorded,
)
from evflow.estimation.remarks import LOGARITHMIC, dead_notes
from evflow.estimation.result import THRESHOLDS, CameraEstimate
from evflow.notes import Note
from evflow.recordings.faulty_pixels import dead_pixels
from evflow.types import Recording

SURE, SEEN = 5.0, 3.0  # standard deviations of noise: polarity is swapped, steps are seen
FEW_EVENTS = 2  # of a polarity, over all steps: the least for a measurement
MOST = 0.5  # share of pixels measured, below which a note is added


def calibrate_step(
    recording: Recording, *, rests_us: Sequence[Span] | None = None,
    light: Sequence[float] | None = None, lux: Sequence[float] | None = None,
    triggers_us: Sequence[int] | np.ndarray | None = None, fresh: bool = False,
    literal: bool = False,
) -> CameraEstimate:
    """Thresholds, and noise at rest, from a screen whose light steps between rests.

    A polarity's map is measured at pixels with at least 2 of its events; elsewhere it is the
    camera's median.

    Args:
        recording: of the screen.
        rests_us: (begin, end) of each rest in us; by default detected in the frames.
        light: of the screen at each rest, in any linear unit (lux, cd/m²); by default the mean of
            the frames.
        lux: instead of light, that of each distinct level, darkest first; of a recording without
            frames that of each rest between the triggers, in order of time.
        triggers_us: times of the light's edges, for the latency of the pixels.
        fresh: whether the memory is at the light of the first rest, as in a simulation; that of a
            running camera may be anywhere.
        literal: theta = dlogI / events, as the paper says; the std is then that of one event.

    Raises:
        EvflowDataError: EV001 (no events), EV011 (no frames and no light), EV012 (no trigger at a
            step), EV017 (fewer than two rests in the frames, no screen that steps, or steps too
            small), EV020, EV021 (polarities swapped).
    """
    metered, lux = False, () if lux is None else tuple(map(float, lux))
    if not len(recording.events):
        raise EvflowDataError("EV001", "the recording has no events.")
    if lux and triggers_us is not None and rests_us is None and not recording.has_frames:
        rests_us = rests_between(np.asarray(triggers_us), recording.events, len(lux))
        metered, light, lux = True, lux, ()
    steps = counted_steps(recording, rests_us, light, lux)
    if metered:
        steps = dataclasses.replace(steps, unit="lux")
    _check_polarity(steps, recording.has_frames)
    signal = _without_noise(recording, steps)
    steps, log_map = _with_right_map(steps, signal.mean)
    missed = lost_steps(steps.changes, signal.mean, steps.sized) & ~unrecorded(
        steps.changes > 0, steps.counts)
    known = steps.sized & ~missed
    sent = by_rested(signal.clean, steps.rests, signal.used)
    # All of the leak brings forward what these send.
    sent[:, 0] -= signal.leaking.hz * steps.rests_s[:-1]
    measured = _thresholds(steps, signal, missed, fresh=fresh, literal=literal)
    added = AddedLight()
    if not literal:
        steps, added, by_light = with_added_light(
            steps, log_map, *measured.camera_wide, sent, known)
        if added.amount:
            measured = _thresholds(steps, signal, missed, fresh=fresh)
        measured = measured.with_error(by_light)
    found = _estimate(steps, signal, measured, missed)
    if not literal:
        found = with_fast_edges(found, steps.changes, sent, known)
    logs = np.median(steps.levels, (1, 2))
    shown = measured_bench(
        steps.unit, recording.events, steps.spans, steps.settled, steps.quiet, steps.light, logs,
        steps.rests, signal.clean, signal.kept, np.where(measured.sound, measured.own, np.nan),
        known, not slow(steps.notes))
    if triggers_us is not None:
        shown = dataclasses.replace(shown, latency=measured_latency(
            recording.events, triggers_us, steps.spans, steps.settled, steps.light, logs,
            signal.kept))
    leaking = signal.leaking
    return dataclasses.replace(
        found, bench=shown, optics=added.optics(steps.unit),
        sensor_std={"refractory_s": shown.dead.std_s, "leak_hz": leaking.std_hz},
        sensor=dataclasses.replace(
            found.sensor, refractory_s=shown.dead.seconds, log_map=log_map, leak_hz=leaking.hz,
            eta_is_all=leaking.hz > 0))


@dataclasses.dataclass(frozen=True, eq=False)
class _Signal:
    """Events of K steps without the noise.

    clean: (K, 2, H, W); strays: (K, 2) noise events that were taken off; kept: (H, W) bool, pixels
    that are not hot; dead: (H, W) bool; watched_s: (2,) seconds at rest in which noise of either
    polarity comes at its mean rate."""

    clean: np.ndarray
    strays: np.ndarray
    kept: np.ndarray
    dead: np.ndarray
    leaking: Leaking
    watched_s: np.ndarray

    @property
    def used(self) -> np.ndarray:
        """(H, W) bool: neither hot nor dead."""
        return self.kept & ~self.dead

    @property
    def mean(self) -> np.ndarray:
        """(K, 2) events per pixel."""
        return np.asarray(self.clean[:, :, self.kept].mean(-1))


def _without_noise(recording: Recording, steps: Steps) -> _Signal:
    dead, up = dead_pixels(steps.n_events), steps.changes > 0
    kept = camera_rate(steps.rest, np.full(2, steps.rest_s), dead)[1]
    leaking = NO_LEAK if slow(steps.notes) else measured_leaking(
        recording.events, steps.quiet, up, kept & ~dead)
    watched_s = np.array([leaking.watched(steps.rests_s, up), steps.rest_s])
    strays = steps.seconds[:, None] * camera_rate(steps.rest, watched_s, dead)[0]
    clean = np.maximum(steps.counts - strays[..., None, None], 0.0)
    return _Signal(clean, strays, kept, dead, leaking, watched_s)


@dataclasses.dataclass(frozen=True, eq=False)
class _Thresholds:
    """own: (2, H, W) of each pixel, as measured; sound, enough: (2, H, W) bool, whether that is a
    threshold, and whether it sent enough events; maps, stds: (2, H, W), the camera's median where
    not; medians, spreads: of ON and OFF, with their std; undetermined: names; by_size: (2,)
    relative errors as steps are small."""

    own: np.ndarray
    sound: np.ndarray
    enough: np.ndarray
    maps: np.ndarray
    stds: np.ndarray
    medians: list[tuple[float, float]]
    spreads: list[tuple[float, float]]
    undetermined: tuple[str, ...]
    by_size: np.ndarray

    @property
    def camera_wide(self) -> tuple[np.ndarray, np.ndarray]:
        """(2,) medians and (2,) spreads."""
        return np.array(self.medians)[:, 0], np.array(self.spreads)[:, 0]

    def with_error(self, shared: np.ndarray) -> _Thresholds:
        """Wider by the relative errors (2,) of ON and OFF, which all pixels share."""
        return dataclasses.replace(
            self, stds=np.hypot(self.stds, shared[:, None, None] * self.maps),
            medians=[(value, float(np.hypot(std, error * value)))
                     for (value, std), error in zip(self.medians, shared, strict=True)])


def _thresholds(
    steps: Steps, signal: _Signal, missed: np.ndarray, *, fresh: bool, literal: bool = False
) -> _Thresholds:
    """missed: (K,) bool, steps whose events are lost; other arguments as of `calibrate_step`."""
    up, kept, leaking = steps.changes > 0, signal.kept, signal.leaking
    unknown = missed | unrecorded(up, steps.counts)
    lost = np.broadcast_to(unknown[:, None, None], (len(unknown), *kept.shape))
    rests = np.where(kept, steps.rests, 0)  # hot pixels tell nothing of what noise does
    given = steps.levels, signal.clean, signal.strays, fresh, rests, lost, steps.lit
    theta, error = ratio(*given) if literal else regression(
        *given, (leaking, steps.rests_s, steps.since) if leaking.hz else None)
    usual = np.array([np.median(t[known]) if (known := kept & np.isfinite(t)).any() else
                      THETA_PRIOR for t in theta])
    shared = np.hypot(leaking.theta_error(steps.since[:-1], signal.clean, usual),
                      return_error(up, signal.clean))
    by_size = size_error(steps.changes, usual, steps.sized & ~unknown)
    shared = np.hypot(shared, by_size)
    events = np.where(lost[:, None], 0.0, steps.counts).sum(0)
    enough = (events >= FEW_EVENTS) & (events > 2 * signal.strays.sum(0)[:, None, None])
    enough &= steps.reach > LEAST_STEP
    sound = enough & (theta >= THETA_MIN) & (error < theta)  # false where either is NaN
    maps, stds, medians, spreads, undetermined = [], [], [], [], list[str]()
    for i, name in enumerate(THRESHOLDS):
        good = sound[i] & kept
        if not good.any():
            undetermined.append(name)
        (median, own), (spread, spread_error) = camera_wide(theta[i][good], error[i][good])
        if good.any() and good.sum() < MOST * kept.sum():
            # Those with enough events are the ones that happen to send more.
            own = float(np.hypot(own, np.median(error[i][good])))
        medians.append((median, float(np.hypot(own, shared[i] * median))))
        spreads.append((spread, spread_error))
        maps.append(np.where(sound[i], theta[i], median))
        stds.append(np.hypot(np.where(sound[i], error[i], np.hypot(spread, own)),
                             shared[i] * maps[i]))
    return _Thresholds(theta, sound, enough, np.stack(maps), np.stack(stds), medians, spreads,
                       tuple(undetermined), by_size)


def _with_right_map(steps: Steps, sent: np.ndarray) -> tuple[Steps, LogMap]:
    """The steps with the levels of the map that their events (K, 2) fit, and its name."""
    if steps.other is None:
        return steps, "linlog"
    switch, notes = chosen_map(steps.levels, steps.other, sent, steps.sized)
    maps: tuple[LogMap, LogMap] = ("linlog", "log_eps")
    name = maps[(steps.other.log_map == "log_eps") == switch]
    if name == "log_eps" and not notes:
        notes = [LOGARITHMIC]
    return dataclasses.replace(
        steps, levels=steps.other.levels if switch else steps.levels,
        notes=(*steps.notes, *notes)), name


def _notes(
    steps: Steps, undetermined: Sequence[str], valid: np.ndarray, hot: np.ndarray,
    dead: np.ndarray, missed: np.ndarray,
) -> tuple[Note, ...]:
    notes = [*skipped_notes(steps.uncovered, steps.silent_s, missed), *steps.notes,
             *few_sizes(steps.changes)]
    notes += [Note(f"{name}.undetermined", f"no step sends {side} events: {name} is the prior's.")
              for name, side in zip(THRESHOLDS, ("ON", "OFF"), strict=True)
              if name in undetermined]
    if valid.mean() < MOST:
        notes.append(Note("pixels.unsure", f"{valid.mean():.0%} of the pixels sent enough events "
                          "to be measured: take more steps, or larger ones."))
    if hot.any():
        notes.append(Note("pixels.hot", f"hot pixels ({hot.sum()}): they fire while nothing "
                          "changes."))
    return (*notes, *dead_notes(dead))


def _check_polarity(steps: Steps, framed: bool) -> None:
    """EV021 where OFF events come with steps up, more than by chance; EV017 where neither do."""
    counts = steps.counts.sum((2, 3))
    net = float(steps.changes @ (counts[:, 0] - counts[:, 1]))
    chance = float(np.sqrt(steps.changes**2 @ counts.sum(1)))
    if net < -SURE * chance:
        raise EvflowDataError(
            "EV021", "ON events come where the light falls, OFF events where it rises.",
            "Pass --polarity invert (polarity='invert'), or are frames and events not aligned?"
            if framed else
            "Is the light of the rests, --lux, in order of time, and is there a trigger at each "
            "step? If so, pass --polarity invert (polarity='invert').")
    if net < SEEN * chance:
        raise EvflowDataError(
            "EV017", f"the events of {len(counts)} steps of light, of "
            f"{np.expm1(np.abs(steps.changes).max()):.0%} at most, are no more than noise.",
            "Take steps of several thresholds, for example twice as bright.")


def _estimate(
    steps: Steps, signal: _Signal, measured: _Thresholds, missed: np.ndarray
) -> CameraEstimate:
    leaking, enough, sound, kept = signal.leaking, measured.enough, measured.sound, signal.kept
    eta, (eta_std, rates) = pixel_and_camera_rates(
        steps.rest, signal.watched_s, signal.dead, leaking.std_hz if leaking.hz else 0.0)
    silent = np.array([not side.any() for side in enough])
    valid = (sound | silent[:, None, None]).all(0) & enough.any(0) & kept
    values, errors = zip(*measured.medians, *rates, *measured.spreads, strict=True)
    return CameraEstimate(
        Camera(*(jnp.asarray(m, jnp.float32) for m in (*measured.maps, *eta))).validate(),
        Camera(*(jnp.asarray(m, jnp.float32) for m in (*measured.stds, *eta_std))),
        Summary(*(jnp.float32(v) for v in values)), Summary(*(jnp.float32(e) for e in errors)),
        valid, steps.n_events, ~kept, signal.dead, int((~missed).sum()),
        (*_notes(steps, measured.undetermined, valid, ~kept, signal.dead, missed),
         *small_steps(measured.by_size)),
        measured.undetermined)

"""Calibration on a bench: thresholds from steps of light, noise from a scene at rest.

The paper's ground truth (Section III-B): a screen that fills the view brightens or darkens by a
known dlogI, and a pixel's threshold is dlogI divided by its events; events of a scene at rest are
noise. This module counts events per step and rest, and returns a `CameraEstimate`; steps.py
computes thresholds from counts. Noise alone: evflow/estimation/static.py.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from evflow.camera import THETA_MIN, Camera, Summary
from evflow.errors import EvflowDataError
from evflow.estimation.bench.latency import measured_latency
from evflow.estimation.bench.levels import (
    Unit,
    few_sizes,
    light_of_rests,
    lux_notes,
    measured_bench,
)
from evflow.estimation.bench.rests import check_steps, find_rests, rests_between
from evflow.estimation.bench.steps import (
    camera_rate,
    camera_wide,
    ratio,
    regression,
    shrunk_rates,
)
from evflow.estimation.result import THRESHOLDS, CameraEstimate
from evflow.light.log_maps import lin_log, lin_log_inverse
from evflow.notes import Note
from evflow.recordings.faulty_pixels import dead_pixels, hot_at_rest
from evflow.recordings.stillness import LEAST_EVENTS, MOVING, coincidence_excess
from evflow.types import Events, Recording

Span = tuple[int, int]

SETTLE_US = 20_000  # events of a step come until this long after the light rests again
FEW_EVENTS = 2  # of a polarity, over all steps: the least for a measurement
MOST = 0.5  # share of pixels measured, below which a note is added


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """K steps of light between K+1 rests.

    levels: (K+1, H, W) log intensity at each rest; counts: (K, 2, H, W) ON and OFF events of each
    step; seconds: (K,) counting time of each; rests: (K+1, 2, H, W) events at each rest; spans: the
    rests; quiet: the parts of them in which events were counted; light: (K+1,) in unit;
    notes: on the light."""

    levels: np.ndarray
    counts: np.ndarray
    seconds: np.ndarray
    rests: np.ndarray
    spans: list[Span]
    quiet: list[Span]
    light: np.ndarray
    unit: Unit
    notes: tuple[Note, ...]

    @property
    def rest(self) -> np.ndarray:
        """(2, H, W) events of all rests."""
        return self.rests.sum(0, dtype=np.float64)

    @property
    def rest_s(self) -> float:
        """Total seconds of counting at rest."""
        return sum(b - a for a, b in self.quiet) * 1e-6

    @property
    def changes(self) -> np.ndarray:
        """(K,) log units, of the median pixel."""
        return np.median(np.diff(self.levels, axis=0), (1, 2))


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
            step), EV017 (fewer than two rests in the frames, or no screen that steps), EV020, EV021
            (polarities swapped).
    """
    metered, lux = False, () if lux is None else tuple(map(float, lux))
    if not len(recording.events):
        raise EvflowDataError("EV001", "the recording has no events.")
    if lux and triggers_us is not None and rests_us is None and not recording.has_frames:
        rests_us = rests_between(np.asarray(triggers_us), recording.events, len(lux))
        metered, light, lux = True, lux, ()
    steps = _steps(recording, rests_us, light, lux)
    if metered:
        steps = dataclasses.replace(steps, unit="lux")
    _check_polarity(steps)
    rest = steps.rest
    hz, kept = camera_rate(rest, steps.rest_s)
    strays = steps.seconds[:, None] * hz
    clean = np.maximum(steps.counts - strays[..., None, None], 0.0)
    theta, error = (ratio if literal else regression)(
        steps.levels, clean, strays, fresh, steps.rests.max(1) > 0)
    events = steps.counts.sum(0)
    enough = (events >= FEW_EVENTS) & (events > 2 * strays.sum(0)[:, None, None])
    sound = enough & (theta >= THETA_MIN) & (error < theta)  # false where either is NaN
    maps, stds, medians, spreads, undetermined = [], [], [], [], list[str]()
    for i, name in enumerate(THRESHOLDS):
        good = sound[i] & kept
        if not good.any():
            undetermined.append(name)
        median, spread, own = camera_wide(theta[i][good], error[i][good])
        medians.append((median, own))
        spreads.append(spread)
        maps.append(np.where(sound[i], theta[i], median))
        stds.append(np.where(sound[i], error[i], np.hypot(spread, own)))
    eta, eta_std = shrunk_rates(rest, steps.rest_s)
    n_events = steps.counts.sum((0, 1)).astype(np.uint32)
    valid = (sound | ~enough.any((1, 2))[:, None, None]).all(0) & enough.any(0) & kept
    found = _estimate(np.stack(maps), np.stack(stds), medians, spreads, eta, eta_std, valid,
                      n_events, ~kept, len(steps.counts), _notes(steps, undetermined, valid, ~kept),
                      tuple(undetermined))
    shown = measured_bench(
        steps.unit, recording.events, steps.spans, steps.quiet, steps.light,
        np.median(steps.levels, (1, 2)), steps.rests, clean, kept, np.where(sound, theta, np.nan))
    if triggers_us is not None:
        shown = dataclasses.replace(shown, latency=measured_latency(
            recording.events, triggers_us, steps.spans, [begin for begin, _ in steps.quiet],
            steps.light, np.median(steps.levels, (1, 2)), kept))
    return dataclasses.replace(
        found, bench=shown, sensor_std={"refractory_s": shown.dead.std_s},
        sensor=dataclasses.replace(found.sensor, refractory_s=shown.dead.seconds))


def _notes(
    steps: Steps, undetermined: Sequence[str], valid: np.ndarray, hot: np.ndarray
) -> tuple[Note, ...]:
    notes = [*steps.notes, *few_sizes(steps.changes), *(Note(
        f"{name}.undetermined", f"no step sends {side} events: {name} is the prior's.")
        for name, side in zip(THRESHOLDS, ("ON", "OFF"), strict=True) if name in undetermined)]
    if valid.mean() < MOST:
        notes.append(Note("pixels.unsure", f"{valid.mean():.0%} of the pixels sent enough events "
                          "to be measured: take more steps, or larger ones."))
    if hot.any():
        notes.append(Note("pixels.hot", f"hot pixels ({hot.sum()}): they fire while nothing "
                          "changes."))
    return tuple(notes)


def _check_polarity(steps: Steps) -> None:
    """EV021 where OFF events come with steps up."""
    net = (steps.counts[:, 0] - steps.counts[:, 1]).sum((1, 2))
    if (steps.changes * net).sum() < 0:
        raise EvflowDataError(
            "EV021", "ON events come where the light falls, OFF events where it rises.",
            "Pass --polarity invert (polarity='invert'), or are frames and events not aligned?")


def _steps(
    recording: Recording, rests_us: Sequence[Span] | None, light: Sequence[float] | None,
    lux: tuple[float, ...],
) -> Steps:
    events, times = recording.events, recording.frame_times
    frames = None if rests_us is not None else find_rests(recording)
    spans = ([(int(times[a]), int(times[b])) for a, b in frames] if frames is not None
             else [(int(a), int(b)) for a, b in rests_us or ()])
    flat = [t for span in spans for t in span]
    if (len(spans) < 2 or any(b < a for a, b in itertools.pairwise(flat))
            or any(b == a for a, b in spans)):
        raise EvflowDataError("EV020", f"rests_us={spans}.",
                              "Give two or more (begin, end) in us, in order of time.")
    if lux and light is not None:
        raise EvflowDataError("EV020", "both light and lux.", "Give one of them.")
    levels = _levels(recording, spans, light)
    if light is None:
        check_steps(levels)
    unit: Unit = "DN" if light is None else "light"
    doubts = []
    if lux:
        seen = np.median(levels, (1, 2))
        unit, light = "lux", light_of_rests(seen, lux)
        doubts = lux_notes(seen, lux)
        levels = _levels(recording, spans, light)
    settled = [min(a + SETTLE_US, (a + b) // 2) for a, b in spans]
    counts = [events.slice(before[1], after).count_map()
              for before, after in zip(spans, settled[1:], strict=False)]
    seconds = [(after - before[1]) * 1e-6
               for before, after in zip(spans, settled[1:], strict=False)]
    quiet = [(a, b) for a, (_, b) in zip(settled, spans, strict=True)]
    rests = np.stack([events.slice(a, b).count_map() for a, b in quiet])
    busiest = max((events.slice(a, b) for a, b in quiet), key=len)
    shown = (np.asarray(light, np.float64) if light is not None else
             np.asarray(lin_log_inverse(jnp.asarray(np.median(levels, (1, 2)))), np.float64))
    return Steps(levels, np.array(counts, np.float64), np.array(seconds), rests, spans, quiet,
                 shown, unit, (*_restless(busiest), *doubts))


def _restless(rest: Events) -> list[Note]:
    """A note if the events of a rest are not noise alone."""
    hot = hot_at_rest(rest.count_map().sum(0))
    if len(rest) < LEAST_EVENTS or coincidence_excess(rest, hot) <= MOVING:
        return []
    return [Note(
        "scene.restless", "neighbouring pixels fire together while the light should rest: does it "
        "flicker or still settle, are its edges not where frames or triggers say, or does the "
        "camera regulate its exposure? Then noise rates, and thresholds, are wrong.")]


def _levels(
    recording: Recording, spans: list[Span], light: Sequence[float] | None
) -> np.ndarray:
    width, height = recording.events.size
    if light is not None:
        given = np.asarray(light, np.float64)
        if given.shape != (len(spans),) or not (np.isfinite(given) & (given > 0)).all():
            raise EvflowDataError("EV020", f"light={light!r} for {len(spans)} rests.",
                                  "Give one positive number per rest.")
        return np.broadcast_to(np.log(given)[:, None, None], (len(spans), height, width))
    times, levels = recording.frame_times, []
    for begin, end in spans:
        inside = np.flatnonzero((times >= begin) & (times <= end))
        if not len(inside):
            raise EvflowDataError("EV011", f"no frame between {begin} and {end} us.",
                                  "Give light, its value at each rest.")
        mean = np.mean([recording.frame_dn(int(i)) for i in inside], 0, np.float64)
        levels.append(np.asarray(lin_log(mean.astype(np.float32)), np.float64))
    return np.stack(levels)


def _estimate(
    theta: np.ndarray, theta_std: np.ndarray, medians: list[tuple[float, float]],
    spreads: list[float], eta: np.ndarray, of_eta: tuple[np.ndarray, list[tuple[float, float]]],
    valid: np.ndarray, n_events: np.ndarray, hot: np.ndarray, count: int, notes: tuple[Note, ...],
    undetermined: tuple[str, ...],
) -> CameraEstimate:
    eta_std, rates = of_eta
    values = [*(m for m, _ in medians), *(m for m, _ in rates), *spreads]
    pixels = max(int(valid.sum()), 1)
    errors = [*(s for _, s in medians), *(s for _, s in rates),
              *(s / np.sqrt(2 * pixels) for s in spreads)]
    return CameraEstimate(
        Camera(*(jnp.asarray(m, jnp.float32) for m in (*theta, *eta))).validate(),
        Camera(*(jnp.asarray(m, jnp.float32) for m in (*theta_std, *eta_std))),
        Summary(*(jnp.float32(v) for v in values)), Summary(*(jnp.float32(e) for e in errors)),
        valid, n_events, hot, dead_pixels(n_events), count, notes, undetermined)

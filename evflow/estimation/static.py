"""A camera's noise from a static scene: rates per pixel, thresholds unknown.

Whether the scene is static is decided from the events (recordings/stillness.py).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera, Summary
from evflow.camera.leak import MOST_SHOT, STEPS, leak_among, shot_eta, without_leak
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.estimation.bench.levels import Bench, Level
from evflow.estimation.intervals import waits_at_rest
from evflow.estimation.leak import Leak, measured_leak
from evflow.estimation.pixel_noise import ODD, pixel_rates
from evflow.estimation.remarks import (
    ASSUMED,
    EVEN_NOISE,
    UNLIT,
    dead_notes,
    noise_notes,
    uneven_notes,
)
from evflow.estimation.result import THRESHOLDS, CameraEstimate
from evflow.estimation.shot import Shot, by_light, measured_noise, scatter, shot_beside_leak
from evflow.light.log_maps import noise_factor, normalised_intensity
from evflow.notes import Note, why_no_frames
from evflow.recordings.faulty_pixels import dead_at_rest, hot_at_rest
from evflow.recordings.gaps import joined, stretches_at_rest
from evflow.recordings.stillness import unlike_noise
from evflow.recordings.windows import check_overlap, covered_us
from evflow.training.config import PRESETS
from evflow.types import Events, Recording

APART, FALL = 4.0, 0.1  # ratio of lights at which noise that falls with light falls by more


def estimate_noise(
    recording: Recording, *, lux: float | None = None, alone: bool = True
) -> CameraEstimate:
    """eta_on, eta_off (Hz) of every pixel, from the events of a static scene.

    A pixel's rate is that of `pixel_rates`, a hot pixel's its own count; at the scene's mean light
    if the noise falls with light. The summary is the mean over pixels that are neither hot nor
    dead. Thresholds are those of the network's training prior, with its width; `valid` is False
    everywhere. lux: the illuminance, for `.bench`, which `noise_over_light` joins. Leak is
    identified by its intervals, shot noise if frames show the light. alone: noise is what was asked
    for, not what is left without frames. Gaps in the events, as of lost packets, are not counted as
    time of observation. Raises EV017 (EV011 unless `alone`) if the scene moves, or the recording is
    too short to decide; EV012 if frames lie elsewhere in time.
    """
    parts = stretches_at_rest(
        recording.events, hot_at_rest(recording.events.count_map().sum(0, dtype=np.uint32)))
    events = joined(parts)
    counts = events.count_map()
    total = counts.sum(0, dtype=np.uint32)
    hot, dead = hot_at_rest(total), dead_at_rest(total)
    _require_static(recording, events, hot, alone)
    if len(recording.frame_times) > 1:
        check_overlap(recording)
    seconds = events.duration_us * 1e-6
    leak, shot = _kinds(recording, parts, counts, hot | dead)
    watched = np.full((2, *hot.shape), seconds)
    if shot.falls:
        faulty = hot | dead
        watched *= _by_light(counts / seconds, _lit(recording, faulty), faulty, leak)
    rates, errors, means, mean_errors = zip(
        *(_rates(n, hot, dead, w) for n, w in zip(counts, watched, strict=True)), strict=True)
    middle, width = uniform(PRESETS["default"].prior.theta)
    mismatch, mismatch_width = uniform(PRESETS["default"].prior.mismatch)

    def camera(theta: float, eta: tuple[np.ndarray, ...]) -> Camera:
        flat = jnp.full(hot.shape, theta, jnp.float32)
        return Camera(flat, flat, *(jnp.asarray(e, jnp.float32) for e in eta))

    def summary(theta: float, eta: tuple[float, ...], sigma: float) -> Summary:
        return Summary(*(jnp.float32(v) for v in (theta, theta, *eta, sigma, sigma)))

    known = summary(middle, means, mismatch)
    sensor, std = measured_noise(SensorModel(noise_resets_memory=True), {}, leak, shot, known)
    level = () if lux is None else (Level(
        lux, 1, seconds, means[0], mean_errors[0], means[1], mean_errors[1]),)
    return CameraEstimate(
        camera(middle, rates), camera(width, errors), known,
        summary(width, mean_errors, mismatch_width), np.zeros(hot.shape, bool), total, hot,
        dead, 0,
        (*_notes(hot, total, seconds, recording.has_frames),
         *_gap_notes(recording.events, len(parts) - 1, seconds),
         *dead_notes(dead), *noise_notes(shot), *uneven_notes(counts[:, ~(hot | dead)], leak.hz)),
        THRESHOLDS,
        sensor=sensor, sensor_std=std,
        bench=Bench("lux", level) if level else None)


def _kinds(
    recording: Recording, parts: list[Events], counts: np.ndarray, faulty: np.ndarray
) -> tuple[Leak, Shot]:
    """Leak and, if frames show the light, shot noise. parts: the events between gaps, which end
    every pixel's wait."""
    begins = [int(part.t[0]) for part in parts]
    if recording.has_frames:
        begins[0] = min(begins[0], max(int(recording.frame_times[0]), covered_us(recording)[0]))
    waits = [waits_at_rest(part, faulty, (begin, int(part.t[-1])))
             for part, begin in zip(parts, begins, strict=True)]
    leak = measured_leak(sum(waits[1:], waits[0]))
    if not recording.has_frames:
        return leak, Shot()
    watched = np.full(faulty.shape, sum(part.duration_us for part in parts) * 1e-6)
    quiet = np.stack([np.stack([n, watched]) for n in counts])
    light = by_light(quiet, _frame(recording), faulty)
    return leak, shot_beside_leak(light, leak, scatter(quiet, faulty))


def _frame(recording: Recording) -> np.ndarray:
    """A frame (H, W) in DN from the middle of the recording."""
    return recording.frame_dn(len(recording.frame_times) // 2)


def _lit(recording: Recording, faulty: np.ndarray) -> np.ndarray:
    """(H, W): v2e's shot noise of a pixel's light, relative to its mean over the others."""
    factor = noise_factor(normalised_intensity(_frame(recording).astype(np.float64).clip(0, 255)))
    return np.asarray(factor / factor[~faulty].mean())


def _by_light(rates: np.ndarray, lit: np.ndarray, faulty: np.ndarray, leak: Leak) -> np.ndarray:
    """(2, H, W): ON and OFF noise in Hz at each pixel's light, relative to that at mean light. Shot
    noise is as lit (H, W), leak the same in any light, but for what resets it; so are faults.
    rates: (2, H, W) as seen."""
    on, off = rates[:, ~faulty].mean(1)
    leaked, profile = np.zeros_like(lit), np.stack([lit, lit])
    if leak.hz:
        for _ in range(STEPS):
            shot = max(on - float(leaked[~faulty].mean()), 0.0)
            leaked = leak_among(leak.hz, (shot + off) * lit)
        there = shot + float(leak_among(leak.hz, np.float64(shot + off)))
        profile[0] = (shot * lit + leaked) / there
    return np.where(rates > MOST_SHOT * 0.5 * (on + off), 1.0, profile)


def noise_over_light(found: Sequence[CameraEstimate]) -> CameraEstimate:
    """The first of several estimates of one camera's noise, each with its lux; `.bench` has the
    levels of all. They tell whether noise falls with light, and leak is that of the level that
    shows it best, as shot noise hides it. EV015 if their sizes differ."""
    sizes = {f.camera.shape for f in found}
    if len(sizes) > 1:
        raise EvflowDataError("EV015", f"recordings of cameras of different sizes: {sizes}.",
                              "Noise against illuminance needs recordings of one camera.")
    levels = sorted((level for f in found if f.bench for level in f.bench.levels),
                    key=lambda level: level.light)
    first = _with_leak(dataclasses.replace(found[0], bench=Bench("lux", tuple(levels))), found)
    low, high = _fall(levels[0], levels[-1], first.sensor.leak_hz)
    sensor, std, notes = first.sensor, first.sensor_std, first.notes
    if sensor.shot_hz and high < FALL:
        sensor = dataclasses.replace(sensor, shot_hz=0.0)
        std, notes = {**std, "shot_hz": float("nan")}, (*_but(notes, ASSUMED), EVEN_NOISE)
    elif sensor.shot_hz and low > FALL:
        notes = _but(notes, ASSUMED)  # by v2e's law or another: the error stays
    elif not sensor.shot_hz and low > FALL:
        notes = (*notes, UNLIT)
    return dataclasses.replace(first, sensor=sensor, sensor_std=std, notes=notes)


def _with_leak(first: CameraEstimate, found: Sequence[CameraEstimate]) -> CameraEstimate:
    """The first estimate with the leak of the one that shows it best, if it shows none."""
    seen = [(f.sensor_std["leak_hz"], f.sensor.leak_hz) for f in found if f.sensor.leak_hz]
    if first.sensor.leak_hz or not seen:
        return first
    error, hz = min(seen)
    sensor = dataclasses.replace(first.sensor, leak_hz=hz)
    if sensor.shot_hz:
        rates = float(first.summary.eta_on), float(first.summary.eta_off)
        sensor = dataclasses.replace(sensor, shot_eta_hz=shot_eta(*rates, hz))
    return dataclasses.replace(
        first, sensor=sensor, sensor_std={**first.sensor_std, "leak_hz": error})


def _but(notes: tuple[Note, ...], left_out: Note) -> tuple[Note, ...]:
    return tuple(note for note in notes if note != left_out)


def _fall(dark: Level, bright: Level, leak_hz: float) -> tuple[float, float]:
    """By how much noise other than leak falls from dark to bright light, in log units: two standard
    deviations below and above; 0 and infinity where the lights are too close."""
    if bright.light <= APART * dark.light:
        return 0.0, float("inf")
    rates = [v.eta_off + float(without_leak(
        np.float64(v.eta_on), v.eta_off, leak_hz) if leak_hz else v.eta_on) for v in (dark, bright)]
    rates = [max(rate, 1e-9) for rate in rates]
    errors = [np.hypot(v.eta_on_std, v.eta_off_std) for v in (dark, bright)]
    error = float(np.hypot(errors[0] / rates[0], errors[1] / rates[1]))
    falls_by = float(np.log(rates[0] / rates[1]))
    return falls_by - 2.0 * error, falls_by + 2.0 * error


def uniform(bounds: tuple[float, float]) -> tuple[float, float]:
    """Mean and standard deviation of a uniform prior, for what was not measured."""
    return 0.5 * sum(bounds), (bounds[1] - bounds[0]) / float(np.sqrt(12.0))


def _require_static(recording: Recording, events: Events, hot: np.ndarray, alone: bool) -> None:
    reason = unlike_noise(events, hot)
    if reason and alone:
        raise EvflowDataError(
            "EV017", f"noise is measured in a static scene, and {reason}",
            "Record some seconds in which nothing moves and the light is steady" + (
                ", or measure the thresholds of this recording too: --protocol motion."
                if recording.has_frames else "; the thresholds of a moving scene need frames."))
    if reason:
        why = why_no_frames(recording.notes)
        raise EvflowDataError(
            "EV011", f"the recording has no frames{why}; without them only the noise of a static "
            f"scene can be measured, and {reason}", "Thresholds are measured against intensity: "
            f"{'mend what left the frames out, or ' if why else ''}provide frames, --frames DIR "
            "--timestamps FILE. To measure only noise, record some seconds of a static scene.")


def _rates(
    counts: np.ndarray, hot: np.ndarray, dead: np.ndarray, watched: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Rates (H, W) of one polarity in Hz and their std; and the mean over pixels that are neither
    hot nor dead with its std. Dead pixels have that mean. watched: (H, W) seconds at mean light."""
    normal, seconds = counts[~(hot | dead)].astype(np.float64), watched[~(hot | dead)].mean()
    mean, variance, least = float(normal.mean()), float(normal.var()), 1.0 / normal.size
    mean_error = float(np.sqrt(max(variance, mean, least) / normal.size))
    rate, error = pixel_rates(
        counts, np.where(dead, 0.0, watched), max(mean, least) / seconds, hot,
        error=mean_error / max(mean, least), odd=ODD)
    return rate, error, mean / seconds, mean_error / seconds


def _gap_notes(events: Events, gaps: int, seconds: float) -> tuple[Note, ...]:
    lost = events.duration_us * 1e-6 - seconds
    return (Note("events.gaps", f"for {lost:.3g} s no pixel sent an event ({gaps} "
                 f"gap{'s' if gaps > 1 else ''}), as where packets are lost: the rates refer to "
                 f"the other {seconds:.3g} s."),) if gaps else ()


def _notes(hot: np.ndarray, total: np.ndarray, seconds: float, frames: bool) -> tuple[Note, ...]:
    code, why = (("scene.static", "nothing moves in frames and events") if frames else
                 ("frames.none", "no frames"))
    found = [Note(code, f"{why}: theta_on and theta_off are undetermined and have the "
                  "prior's values; the noise rates are those of a static scene"
                  + (", at its mean light." if frames else "."))]
    if hot.any():
        share = float(total[hot].sum()) / float(total.sum())
        y, x = np.unravel_index(int(np.argmax(np.where(hot, total, 0))), total.shape)
        found.append(Note("pixels.hot", f"{hot.sum()} hot pixels send {share:.0%} of the events, "
                          f"most of them x={x}, y={y} ({total[y, x] / seconds:.3g} Hz); they are "
                          "left out of the summary."))
    return tuple(found)

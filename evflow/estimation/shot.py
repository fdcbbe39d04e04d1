"""Shot noise against light: how much of it a pixel would have in the dark.

v2e's is proportional to 1 - .75 I01, from a tenth below the dark value to a quarter of it (R/2 for
each polarity, `shot_hz` R). Events of quiet pixels, by the light they see, show whether a camera's
is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from evflow.camera.leak import leak_among, shot_eta
from evflow.camera.prior import Summary
from evflow.camera.sensors import SensorModel
from evflow.estimation.leak import Leak
from evflow.light.log_maps import noise_factor, normalised_intensity

Array = np.ndarray

LIGHTS = 8  # bins of I01
LEAST_EVENTS = 200.0
ODDS = 3.0  # log odds required to decide whether noise depends on light
LEAK_ERROR = 0.02  # relative, of leak events
UNSURE = 0.25  # relative error of shot_hz if undecided


@dataclasses.dataclass(frozen=True)
class Shot:
    """hz, std_hz: v2e's rate in the dark, both polarities; 0 and NaN if undetermined. even: enough
    events show that the noise does not fall with light as v2e's does; falls: that it does."""

    hz: float = 0.0
    std_hz: float = float("nan")
    even: bool = False
    falls: bool = False


def by_light(quiet: Array, dn: Array, hot: Array) -> Array:
    """(2, 3, LIGHTS), ON and OFF: events, seconds, and seconds times `noise_factor` of pixels, by
    the light dn (H, W) they see; quiet (2, 2, H, W): their events and seconds."""
    i01 = normalised_intensity(np.clip(dn, 0.0, 255.0)[~hot].astype(np.float64))
    step = np.minimum((i01 * LIGHTS).astype(np.int64), LIGHTS - 1)
    factor = noise_factor(i01)
    return np.array([[np.bincount(step, v, LIGHTS) for v in (n[~hot], s[~hot], s[~hot] * factor)]
                     for n, s in quiet])


def scatter(quiet: Array, hot: Array) -> float:
    """Overdispersion of the events (2, 2, H, W) of quiet pixels; at least 1."""
    events, seconds = quiet[:, 0][:, ~hot], quiet[:, 1][:, ~hot]
    rate = events.sum(1) / np.maximum(seconds.sum(1), 1e-9)
    expected = rate[:, None] * seconds
    return max(1.0, float(((events - expected) ** 2).sum() / max(expected.sum(), 1e-9)))


def measured_noise(
    sensor: SensorModel, std: Mapping[str, float], leak: Leak, shot: Shot, summary: Summary
) -> tuple[SensorModel, dict[str, float]]:
    """A circuit with the measured parts of its noise, which add up to the camera's eta, that of the
    summary, and the standard deviations."""
    eta = shot_eta(float(summary.eta_on), float(summary.eta_off), leak.hz) if shot.hz else 0.0
    return (dataclasses.replace(
                sensor, leak_hz=leak.hz, shot_hz=shot.hz, shot_eta_hz=eta, eta_is_all=True),
            {**std, "leak_hz": leak.std_hz, "shot_hz": shot.std_hz})


def measured_shot(
    light: Array, leak_hz: float | Array, scattered: float, error: float = 0.0
) -> Shot:
    """v2e's shot noise, from events by light (2, 3, LIGHTS). leak_hz: ON events from leak, at any
    light or (LIGHTS,); scattered: from `scatter`; error: relative, of the events, e.g. for residual
    signal among them."""
    events, seconds, falling = np.moveaxis(light, 1, 0)
    leaks = bool(np.any(leak_hz))
    leaked = np.stack([leak_hz * seconds[0], np.zeros(LIGHTS)])
    noise = np.maximum(events.sum(1) - leaked.sum(1), 0.0)
    if noise.sum() < LEAST_EVENTS:
        return Shot()
    odds = 0.0
    for side, (n, other, sent, shapes) in enumerate(zip(
            events, leaked, noise, zip(falling, seconds, strict=True), strict=True)):
        if side == 0 and not leaks:
            continue  # ON noise may contain leak, which does not depend on light
        likely = []
        for shape in shapes:
            expected = np.maximum(sent * shape / max(shape.sum(), 1e-12) + other, 1e-12)
            likely.append(float((n * np.log(expected) * (n > 0) - expected).sum()))
        odds += (likely[0] - likely[1]) / scattered
    if odds < -ODDS:
        return Shot(even=True)
    halves = noise / np.maximum(falling.sum(1), 1e-9)
    excess = 0.0 if leaks else max(float(halves[0] - halves[1]), 0.0)  # of ON: maybe leak
    hz = float(halves.sum()) - excess
    if hz <= 0.0:
        return Shot()
    relative = np.sqrt(scattered / noise.sum() + error**2 + (odds < ODDS) * UNSURE**2
                       + (0.5 * excess / hz) ** 2 + (LEAK_ERROR * leaked.sum() / noise.sum()) ** 2)
    return Shot(hz, hz * float(relative), falls=odds > ODDS)


def shot_beside_leak(light: Array, leak: Leak, scattered: float) -> Shot:
    """`measured_shot` of a scene at rest, where leak shows less in the dark, as more noise resets
    the memory there."""
    shot = measured_shot(light, leak.rate_hz, scattered)
    if not (leak.hz and shot.falls):
        return shot
    _, seconds, falling = light[0]
    seen = leak_among(leak.hz, shot.hz * falling / np.maximum(seconds, 1e-9))
    seen *= leak.rate_hz * seconds.sum() / (seen @ seconds)
    return measured_shot(light, seen, scattered)


def at_mean_light(
    eta: Array, std: Array, light: Array, leak_hz: float, factor: float, error: float
) -> tuple[Array, Array]:
    """Noise rates (2,) in Hz of a camera whose shot noise falls with light, and their std: corrects
    for quiet places being darker or brighter than the rest.

    eta, std (2,): rates before correction; light (2, 3, LIGHTS), leak_hz, error: as in
    `measured_shot`; factor: mean of `noise_factor` over pixels and time."""
    events, seconds, falling = np.maximum(light.sum(-1), 1e-9).T
    leaked = leak_hz * np.array([1.0, 0.0])
    shot = np.maximum(events - leaked * seconds, 0.1) / falling
    there = shot * factor + leaked
    own = np.hypot(std / eta, np.log(factor * seconds / falling)) ** -2.0
    seen = 1.0 / (1.0 / events + error**2)
    rates = np.exp((own * np.log(eta) + seen * np.log(there)) / (own + seen))
    return rates, rates * (own + seen) ** -0.5

"""From pooled evidence to the camera's summary and to maps of its pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import PARAMETERS, THETA_MIN, Camera, Summary
from evflow.camera.optics import Optics
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.pixel_noise import pixel_rates, threshold_law, uneven_rate
from evflow.estimation.pooled import window_inputs
from evflow.estimation.refine import (
    Chunk,
    Found,
    Lost,
    PixelEvidence,
    pixel_posterior,
    refine_summary,
)
from evflow.network import api
from evflow.network.coordinates import SCALE, per_channel, unsquash_summary
from evflow.network.posterior import Evidence, evidence, posterior
from evflow.recordings.glitches import exposed
from evflow.types import Window

Array = jax.Array

# Of log noise rates: what signal that looks like noise adds to their error where nothing of a
# long recording is quiet, the quiet share that halves it (30 recordings of 10 s), and the noise
# events that do: with few of them, a rate leans on the network's and on Eq. 12.
UNQUIET, QUIET_HALF, EVENTS_HALF = 0.3, 0.03, 300.0
# Relative error of the network's thresholds if pixels are not ideal, and log units per second of
# tau by which it finds those of slow ones too high: measured on 124 cameras, tau 0 to 13 ms.
SLOW_ERROR, SLOW_BIAS = 0.15, 15.5
# Relative error of thresholds by a second that frames take to be read, and the largest: 10 to 30 ms
# made them 5 to 17 % too high.
ROLLING, ROLLING_MOST = 8.0, 0.15


def by_flow(
    params: api.Params, windows: Iterable[Window], summary: Summary, summary_std: Summary
) -> tuple[Camera, Camera]:
    """Combines the windows' measurements by the flow with the summary and the mismatch; the
    summary's own error, which all pixels share, is added to the std."""
    found: Evidence | None = None
    for window in windows:
        voxels, dlogI, given = window_inputs(window)
        y, s = api.estimate_y(params, voxels, dlogI, summary=summary, **given)
        more = evidence(y, s, jnp.asarray(exposed(window.frame0, window.frame1)))
        found = more if found is None else found + more
    assert found is not None  # iter_windows raises EV017 rather than yield nothing
    y6 = unsquash_summary(summary)[None, None]
    relative = [getattr(summary_std, n) / getattr(summary, n) for n in PARAMETERS]
    return posterior(found, y6, jnp.stack(relative, -1)[None, None] / per_channel(SCALE, y6))


def by_regression(
    evidence: PixelEvidence, summary: Summary, summary_std: Summary
) -> tuple[Camera, Camera]:
    """Each pixel's thresholds from its regression on the path, combined with the summary, and the
    summary's noise rates; the summary's own error, which all pixels share, is added to the std."""
    theta, error = pixel_posterior(evidence, summary)
    shared = (float(summary_std.theta_on), float(summary_std.theta_off))
    on, off = (np.sqrt(e**2 + np.float32(s**2)) for e, s in zip(error, shared, strict=True))

    def flat(value: Array) -> Array:
        return jnp.asarray(np.full(theta.shape[1:], value, np.float32))

    return (Camera(jnp.asarray(theta[0]), jnp.asarray(theta[1]), flat(summary.eta_on),
                   flat(summary.eta_off)),
            Camera(jnp.asarray(on), jnp.asarray(off), flat(summary_std.eta_on),
                   flat(summary_std.eta_off)))


def with_rates(
    camera: Camera, std: Camera, quiet: np.ndarray, hot: np.ndarray, summary: Summary,
    summary_std: Summary,
) -> tuple[Camera, Camera, Summary, Summary]:
    """The maps with each pixel's noise rates from its quiet time: a window contains too little
    noise of a pixel for the network to improve on the camera's rate. And the summary, in which the
    camera's rates are those of the maps where noise follows the thresholds."""
    rates, errors = {}, {}
    means: dict[str, Any] = {}
    mean_errors: dict[str, Any] = {}
    law = threshold_law(quiet, np.stack([camera.theta_on, camera.theta_off]), hot)
    for p, (name, (events, seconds)) in enumerate(zip(("eta_on", "eta_off"), quiet, strict=True)):
        mean, error = (float(getattr(s, name)) for s in (summary, summary_std))
        error = error / mean
        if law is not None:
            mean, error = uneven_rate(events, seconds, mean, error, hot, law[p])
            means[name], mean_errors[name] = jnp.float32(mean), jnp.float32(mean * error)
        rate, own = pixel_rates(
            events, seconds, mean, hot, 1.0 if law is None else law[p], error=error)
        rates[name] = jax.device_put(rate.astype(np.float32))
        errors[name] = jax.device_put(own.astype(np.float32))
    return (dataclasses.replace(camera, **rates), dataclasses.replace(std, **errors),
            dataclasses.replace(summary, **means), dataclasses.replace(summary_std, **mean_errors))


def with_hot_rates(
    camera: Camera, std: Camera, hot: np.ndarray, rates: np.ndarray, errors: np.ndarray
) -> tuple[Camera, Camera]:
    """The maps with these noise rates (2, N) of the hot (H, W) pixels, and their std; where they
    are NaN the maps stay."""
    def put(of: Camera, values: np.ndarray) -> Camera:
        maps = {name: getattr(of, name) for name in ("eta_on", "eta_off")}
        return dataclasses.replace(of, **{
            name: rate.at[hot].set(np.where(np.isnan(v), rate[hot], v).astype(np.float32))
            for (name, rate), v in zip(maps.items(), values, strict=True)})

    return put(camera, rates), put(std, errors)


def with_unquiet_error(
    summary: Summary, std: Summary, share: np.ndarray, pixel_s: float
) -> Summary:
    """The std, that of noise rates larger the smaller the share (2,) of the recording's pixel_s
    seconds in which nothing but noise comes: what else is taken for noise does not average out."""
    rate, error = (np.array([s.eta_on, s.eta_off], np.float64) for s in (summary, std))
    events = rate * pixel_s
    added = UNQUIET * QUIET_HALF / (QUIET_HALF + share) * events / (events + EVENTS_HALF)
    on, off = np.hypot(error, added * rate).astype(np.float32)
    return dataclasses.replace(std, eta_on=jnp.asarray(on), eta_off=jnp.asarray(off))


def with_rolling_error(summary: Summary, std: Summary, seconds: float) -> Summary:
    """The std, that of thresholds larger if this is the time from the first row of a frame to the
    last."""
    return _wider(summary, std, np.full(2, min(ROLLING * seconds, ROLLING_MOST)))


def with_contrast_lost(
    camera: Camera, std: Camera, summary: Summary, summary_std: Summary, lost: Lost,
    lacking: Sequence[str],
) -> tuple[Camera, Camera, Summary, Summary]:
    """The maps and the summary, and their errors, with thresholds of pixels that lose contrast in
    their dead time: all above took it as kept. lacking: polarities whose thresholds are the
    prior's, and stay so."""
    for p, name in enumerate(("on", "off")):
        if name in lacking:
            continue
        theta, sigma = f"theta_{name}", f"sigma_{name}"
        taken, error = (float(getattr(s, theta)) for s in (summary, summary_std))
        value, new_error = lost.corrected(p, taken, error)
        by, old, new = np.float32(taken / value), error / taken, new_error / value
        camera, std = _divided(camera, std, theta, by, old, new)
        summary, summary_std = _divided(summary, summary_std, sigma, by, 0.0, max(new - old, 0.0))
        summary = dataclasses.replace(summary, **{theta: jnp.float32(value)})
        summary_std = dataclasses.replace(summary_std, **{theta: jnp.float32(new_error)})
    return camera, std, summary, summary_std


def _divided(
    values: Any, errors: Any, name: str, by: np.float32, old: float, new: float
) -> tuple[Any, Any]:
    """A camera or a summary, and its errors, with the field `name` divided. old, new: relative
    error that all pixels share, before and after."""
    value, error = (getattr(s, name) / by for s in (values, errors))
    own = jnp.sqrt(jnp.maximum(error**2 - (np.float32(old) * value) ** 2, 0.0))
    return (dataclasses.replace(values, **{name: value}),
            dataclasses.replace(errors, **{name: jnp.hypot(own, np.float32(new) * value)}))


def refined(
    params: api.Params, chunks: list[Chunk], summary: Summary, std: Summary, front_end: FrontEnd
) -> tuple[Summary, Summary, Optics | None]:
    """The summary and its std after refinement, and the optics that agree with it. What the log
    map, an offset and a dead time leave open widens the std, and not the optics."""
    parts = next(iter(params.values()))
    fusion, found = parts.get("fusion"), front_end.found
    refined = refine_summary(chunks, summary, std, fusion, parts.get("signal"),
                             found=found, noise_dn=front_end.noise_dn, blur_s=front_end.blur_s)
    if found is None:
        return refined.summary, refined.std, None
    std = _with_open(refined.summary, refined.std, found)
    if fusion is None:
        return refined.summary, std, found.optics
    theta, stepped, error = (np.array([s.theta_on, s.theta_off], np.float64)
                             for s in (refined.summary, refined.stepped, refined.std))
    change, relative = np.log(theta / stepped).mean(), (error / theta).mean()
    return refined.summary, std, found.optics_given(float(change), float(relative))


def _with_open(summary: Summary, std: Summary, found: Found) -> Summary:
    """The std with the errors of thresholds by a log map that may be another one, by an offset that
    may be there, and by contrast that may be lost in a dead time."""
    errors = np.hypot(found.offset_open, found.loss_open)
    if found.other_map is not None:
        errors = np.hypot(errors, found.other_map.theta_error)
    return _wider(summary, std, errors)


def _wider(summary: Summary, std: Summary, errors: np.ndarray) -> Summary:
    """The std with further relative errors (2,) of the thresholds."""
    wider = {name: jnp.hypot(getattr(std, name), np.float32(error) * getattr(summary, name))
             for name, error in zip(("theta_on", "theta_off"), errors, strict=True)}
    return dataclasses.replace(std, **wider)


def regressed(summary: Summary, std: Summary, found: Found) -> tuple[Summary, Summary]:
    """The network's summary with its thresholds averaged with those of the pooled regression,
    weighted by precision: the network knows no slow pixels, whose thresholds it finds too high, and
    a poor path determines little."""
    late = SLOW_BIAS * found.seen.typical_tau_s
    theta, error = found.thresholds()
    values, errors = {}, {}
    for name, other in zip(("theta_on", "theta_off"), theta, strict=True):
        own = float(getattr(summary, name))
        relative = max(float(getattr(std, name)) / own, float(np.hypot(SLOW_ERROR, late)))
        middle, left = _averaged((own * np.exp(-late), relative), (float(other), error))
        values[name], errors[name] = jnp.float32(middle), jnp.float32(left * middle)
    return dataclasses.replace(summary, **values), dataclasses.replace(std, **errors)


def _averaged(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """The geometric mean of two thresholds, each with its relative error, weighted by precision,
    and its relative error."""
    known = np.array([one[1], other[1]]) ** -2.0
    middle = np.average(np.log(np.maximum([one[0], other[0]], THETA_MIN)), weights=known)
    return float(np.exp(middle)), float(known.sum() ** -0.5)

"""The camera summary: a set network over all pixels of any number of windows and tiles.

Every pixel gives features and weights; only their *sums* are kept (`Stats`), so windows and tiles
of one camera simply add, tiling equals the whole, and the std shrinks with the data. `finish` turns
the sums into six medians and mismatches with their standard deviations.

The scale of theta comes from the event model dL = theta_on n_on - theta_off n_off + phase, for
which the sums contain two calibrations with learned pixel weights: normal equations (least
squares), and instrumental variables. The latter add the equation over pixels that got brighter and
over those that got darker: ON-OFF pairs caused by motion between the frames, and quantisation of
counts, bias least squares but cancel in these sums.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from evflow.network.config import ModelConfig
from evflow.network.coordinates import CENTRE, SCALE, per_channel
from evflow.process.chunks import in_chunks

Array = jax.Array

RIDGE, RIDGE_THETA = 0.5, 0.22  # pseudo-observations that keep an empty calibration at .22
DEAD_CHANGE = 0.03  # log units: smaller changes are frame noise and count on neither side
WINDOW_S, MIDDLE = 0.05, 4.0  # window length and log intensity on which inputs are centred
SIGNAL_UNIT, EXPOSURE_UNIT = 1000.0, 100.0  # units of the std: pixels with events, pixel seconds


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Stats:
    """Additive statistics of one camera, float32: `a + b` is that of both. A pytree.

    Attributes:
        active: (..., A) features summed over pixels with events.
        rates: (..., R) positive features summed over all pixels.
        normal: (..., gates, 5) weighted normal equations of the event model.
        balance: (..., gates, 2, 3) weighted n_on, n_off, dL over brighter and darker pixels.
        pixels: (...,) number of pixels.
        pixels_active: (...,) number of pixels with events.
        exposure: (...,) pixel seconds.
        events_on: (...,) number of ON events.
        events_off: (...,) number of OFF events.
    """

    active: Array
    rates: Array
    normal: Array
    balance: Array
    pixels: Array
    pixels_active: Array
    exposure: Array
    events_on: Array
    events_off: Array

    def __add__(self, other: Stats) -> Stats:
        return _added(self, other)

    def __radd__(self, other: int) -> Stats:
        """`sum(...)` starts with 0."""
        return self if isinstance(other, int) and other == 0 else NotImplemented


@jax.jit
def _added(one: Stats, other: Stats) -> Stats:
    return jax.tree.map(jnp.add, one, other)


def window_features(window_s: Array, intensity: Array | None, shape: tuple[int, ...]) -> Array:
    """(..., 3): log window length, centred log intensity, and whether it was given."""
    window = jnp.broadcast_to(jnp.log(window_s / WINDOW_S), shape)
    if intensity is None:
        zero = jnp.zeros(shape, window.dtype)
        return jnp.stack([window, zero, zero], -1)
    known = jnp.isfinite(intensity)
    value = jnp.where(known, intensity - MIDDLE, 0.0)
    return jnp.stack([window, value, known.astype(window.dtype)], -1)


def given_features(context: Array) -> tuple[Array, Array]:
    """Window length in seconds and log intensity (...,) from `window_features`; an intensity that
    was not given is the centre."""
    return WINDOW_S * jnp.exp(context[..., 0]), context[..., 1] + MIDDLE


def of_pixels(context: Array) -> Array:
    """The context for encoder, flow and spread, which are trained with the intensity: one that was
    not given is the centre. The pooling network is trained without, too."""
    return context.at[..., 2].set(1.0)


def pixel_features(voxels: Array, dlogI: Array, context: Array) -> Array:
    """Features of one pixel: voxels (..., 2B), dlogI (...,), context (..., 3) -> (..., F)."""
    on, off = jnp.split(voxels, 2, -1)
    n_on, n_off = on.sum(-1), off.sum(-1)
    scalars = [dlogI * 5.0, jnp.arcsinh(dlogI * 10.0), jnp.arcsinh(jnp.abs(dlogI) * 10.0),
               jnp.arcsinh(n_on), jnp.arcsinh(n_off), jnp.arcsinh(n_on - n_off)]
    return jnp.concatenate([jnp.arcsinh(voxels), jnp.stack(scalars, -1), context], -1)


class PixelNet(nn.Module):
    """Per-pixel part: features (..., F) -> active (A), rates (R) before their softplus, gate
    weights (3 G) > 0."""

    config: ModelConfig

    @nn.compact
    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        c = self.config
        for _ in range(2):
            x = nn.relu(nn.Dense(c.summary_hidden)(x))
        active = nn.Dense(c.summary_features)(x)
        rates = nn.Dense(c.rate_features)(x)
        return active, rates, nn.softplus(nn.Dense(3 * c.gates)(x))


class FinishNet(nn.Module):
    """Camera-wide part: pooled features -> means (6,), log std per unit of data (6,) and log std
    that more data of the same scenes cannot reduce (6,)."""

    config: ModelConfig

    @nn.compact
    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        for _ in range(2):
            x = nn.relu(nn.Dense(2 * self.config.summary_hidden)(x))
        out = nn.Dense(18)(x)
        return out[..., :6], out[..., 6:12] - 2.0, out[..., 12:] - 2.0


def pool(
    config: ModelConfig, params: dict, voxels: Array, dlogI: Array, window_s: Array,
    intensity: Array | None, *, at_a_time: int | None = None, weight: Array | None = None,
) -> Stats:
    """Sum over pixels: voxels (..., H, W, 2B), dlogI (..., H, W) -> Stats of (...,). at_a_time:
    pixels that go through the network together, None: all; the sums are the same. weight: how often
    each pixel counts, (..., H, W); None: once."""
    context = window_features(jnp.asarray(window_s)[..., None, None], intensity, dlogI.shape)
    features = pixel_features(voxels, dlogI, context)

    def network(x: Array) -> Any:
        return PixelNet(config).apply({"params": params["pixel"]}, x)

    if at_a_time is None:
        active, rates, gates = network(features)
    else:
        flat = features.reshape(-1, features.shape[-1])
        active, rates, gates = (a.reshape(*dlogI.shape, -1)
                                for a in in_chunks(network, flat, at_a_time))
    rates = nn.softplus(rates)
    n_on, n_off = (half.sum(-1) for half in jnp.split(voxels, 2, -1))
    total = n_on + n_off
    fired = (total > 0).astype(voxels.dtype)
    moments = jnp.stack(
        [n_on * n_on, n_off * n_off, n_on * n_off, n_on * dlogI, n_off * dlogI], -1)
    # 1/(1+n): otherwise the few pixels at the clamp, with most of the events, dominate.
    weights = gates / (1.0 + total)[..., None]
    pixels = jnp.full(dlogI.shape[:-2], float(dlogI.shape[-1] * dlogI.shape[-2]), voxels.dtype)
    if weight is not None:
        pixels, fired = jnp.sum(weight, (-2, -1)), fired * weight
        rates, weights = rates * weight[..., None], weights * weight[..., None]
    squares, brighter, darker = jnp.split(weights, 3, -1)
    rise = jnp.stack([nn.relu(dlogI - DEAD_CHANGE), nn.relu(-dlogI - DEAD_CHANGE)], -1)
    sides = jnp.stack([brighter, darker], -1) * rise[..., None, :]
    terms = jnp.stack([n_on, n_off, dlogI], -1)
    if weight is not None:
        n_on, n_off = n_on * weight, n_off * weight
    return Stats(
        active=jnp.sum(active * fired[..., None], (-3, -2)),
        rates=jnp.sum(rates, (-3, -2)),
        normal=jnp.einsum("...hwg,...hwm->...gm", squares, moments, precision="highest"),
        balance=jnp.einsum("...hwgs,...hwm->...gsm", sides, terms, precision="highest"),
        pixels=pixels,
        pixels_active=jnp.sum(fired, (-2, -1)),
        exposure=pixels * window_s,
        events_on=jnp.sum(n_on, (-2, -1)),
        events_off=jnp.sum(n_off, (-2, -1)),
    )


def least_squares(normal: Array) -> Array:
    """Thresholds (..., 2) from normal equations (..., 5), ridge-regularised towards .22."""
    on2, off2, cross, on_dl, off_dl = jnp.moveaxis(normal, -1, 0)
    a, d = on2 + RIDGE, off2 + RIDGE
    x, y = on_dl + RIDGE * RIDGE_THETA, -off_dl + RIDGE * RIDGE_THETA
    det = a * d - cross * cross
    return jnp.stack([(d * x + cross * y) / det, (a * y + cross * x) / det], -1)


def balance(sums: Array) -> Array:
    """Thresholds (..., 2) that balance dL = theta_on n_on - theta_off n_off over the brighter and
    over the darker pixels (..., 2, 3), ridge-regularised towards .22."""
    (a, b, up), (c, d, down) = (jnp.moveaxis(row, -1, 0) for row in jnp.moveaxis(sums, -2, 0))
    a, d = a + RIDGE, d + RIDGE
    up, down = up + RIDGE * RIDGE_THETA, -down + RIDGE * RIDGE_THETA
    # Few ON events come from darker pixels and few OFF events from brighter ones: det > 0.
    det = jnp.maximum(a * d - b * c, 0.05 * a * d)
    return jnp.stack([(d * up + b * down) / det, (a * down + c * up) / det], -1)


def pooled_features(stats: Stats) -> Array:
    """Scale-free description of the sums: means, log rates, calibrations, (..., F)."""
    def log_rate(events: Array) -> Array:
        return jnp.log((events + 0.5) / stats.exposure)

    mean_active = stats.active / (stats.pixels_active + 1.0)[..., None]
    log_rates = jnp.log((stats.rates + 1e-3) / stats.exposure[..., None])
    theta = jnp.concatenate([least_squares(stats.normal), balance(stats.balance)], -2)
    theta = jnp.clip(theta, 0.01, 2.0)
    theta_y = (jnp.log(theta) - per_channel(CENTRE[:2], theta)) / per_channel(SCALE[:2], theta)
    scalars = jnp.stack(
        [jnp.log((stats.pixels_active + 0.5) / stats.pixels), log_rate(stats.events_on),
         log_rate(stats.events_off), jnp.log(stats.exposure / stats.pixels)], -1)
    flat = theta_y.reshape(*theta_y.shape[:-2], -1)
    return jnp.concatenate([mean_active, log_rates * 0.3, flat, scalars * 0.3], -1)


def finish(config: ModelConfig, params: dict, stats: Stats) -> tuple[Array, Array]:
    """Stats -> y (..., 6) of the summary and its std in y. One part of the variance falls with the
    amount of data (signal pixels for theta and sigma, exposure for eta), the rest does not."""
    outputs: Any = FinishNet(config).apply({"params": params["finish"]}, pooled_features(stats))
    mean, per_data, rest = outputs
    signal = SIGNAL_UNIT / (stats.pixels_active + 1.0)
    quiet = EXPOSURE_UNIT / stats.exposure
    scale = jnp.stack([signal, signal, quiet, quiet, signal, signal], -1)
    variance = jnp.exp(2.0 * per_data) * scale + jnp.exp(2.0 * rest)
    return mean, jnp.sqrt(variance)


def init(key: Array, config: ModelConfig) -> dict:
    """Parameters of both parts."""
    k_pixel, k_finish = jax.random.split(key)
    features = jnp.zeros((1, 2 * config.bins + 9))
    width = (config.summary_features + config.rate_features + 4 * config.gates + 4)
    return {
        "pixel": PixelNet(config).init(k_pixel, features)["params"],
        "finish": FinishNet(config).init(k_finish, jnp.zeros((1, width)))["params"],
    }

"""Noise events: Poisson counts per pixel, polarity and interval, and the leak of the memory.

Rates follow the camera's eta maps and, where asked for, v2e's shot noise. A rate is exact at
any interval length: counts are Poisson, not one Bernoulli draw per frame.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from evflow.camera import Camera, SensorModel
from evflow.errors import EvflowDataError
from evflow.intensity import noise_factor

Array = jax.Array

GOLDEN = 0.6180339887498949
MAX_MEAN = 60.0  # noise events per pixel and interval; beyond it exp(-mean) nears underflow


def uniform_pair(key: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Two float32 uniforms in (0, 1) from one 32-bit draw per element.

    The first has 2^-32 resolution near zero (jax.random.uniform's 2^-23 is too coarse for a
    probability of 1e-6 per pixel and frame) and decides the count; the second is made of the
    low 12 bits, which stay uniform given that the first is small, and places the event in time.
    """
    bits = jax.random.bits(key, shape, jnp.uint32)
    low = (bits & 0xFFF).astype(jnp.float32)
    return (bits.astype(jnp.float32) + 0.5) * 2.0**-32, (low + 0.5) * 2.0**-12


def placed(model: SensorModel, at: Array, k: Array | int) -> Array:
    """Time of the k-th noise event of an interval, as a fraction: the first is uniform, further
    ones follow at the golden ratio (an interval with two is rare: mean = rate x dt). v2e puts
    them all at the frame."""
    if model.timestamps == "v2e":
        return jnp.ones_like(at)
    return jnp.mod(at + k * GOLDEN, 1.0)


def poisson(u: Array, mean: Array) -> Array:
    """Poisson counts (float32) by inversion of the upper tail: exact for small means.

    Loops until no pixel is left, so the cost follows the largest count (jax.random.poisson
    is ~20x slower here). Means above 80 underflow exp(-mean) in float32 and are refused on
    the host; counts beyond mean + 8 sd + 12 (probability < 1e-10) lie in the rounding error of
    the tail and end the loop.
    """
    limit = mean + 8.0 * jnp.sqrt(mean) + 12.0

    def unfinished(carry: tuple[Array, Array, Array, Array]) -> Array:
        return jnp.any(u < carry[2])

    def count_one(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        count, k, tail, term = carry
        more = u < tail
        term = term * mean / k
        tail = jnp.where(more & (k < limit), tail - term, 0.0)
        return count + more, k + 1.0, tail, term

    zero = jnp.zeros_like(u + mean)
    start = (zero, jnp.ones((), zero.dtype), -jnp.expm1(-mean) + zero, jnp.exp(-mean) + zero)
    return jax.lax.while_loop(unfinished, count_one, start)[0]


def noise_rates(
    model: SensorModel, camera: Camera, i01: Array, reference: Array
) -> tuple[Array, Array]:
    """Noise rates (ON, OFF) in Hz per pixel at normalised intensity i01.

    reference: the I01 at which eta is given (the mean of the first frame). v2e's shot noise
    adds R/2 ((F-1) I01 + 1) theta_median / theta per polarity.
    """
    eta = jnp.stack([camera.eta_on, camera.eta_off])
    if model.eta_intensity:
        eta = eta * (noise_factor(i01) / noise_factor(reference))[None]
    if model.shot_hz > 0:
        theta = jnp.stack([camera.theta_on, camera.theta_off])
        median = jnp.median(theta.reshape(2, -1), axis=1).reshape(2, *[1] * (theta.ndim - 1))
        eta = eta + 0.5 * model.shot_hz * noise_factor(i01)[None] * (median / theta)
    return eta[0], eta[1]


def peak_rate(model: SensorModel, camera: Camera) -> float:
    """Bound on the noise rate (Hz per polarity) of any pixel at any intensity (host side; 0 for
    traced cameras, of which nothing is known)."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(camera)):
        return 0.0
    with jax.ensure_compile_time_eval():
        dark, bright = jnp.zeros(camera.shape, jnp.float32), jnp.ones((), jnp.float32)
        return float(jnp.max(jnp.stack(noise_rates(model, camera, dark, bright))))


def check_rate(rate_hz: float, dt_s: float) -> None:
    """Raise EV014 where `rate_hz` is more than the counts of an interval of dt_s can hold."""
    if rate_hz * dt_s > MAX_MEAN:
        raise EvflowDataError(
            "EV014", f"noise reaches {rate_hz:.3g} Hz: {rate_hz * dt_s:.3g} events per pixel in "
            f"one frame interval of {dt_s * 1e3:.3g} ms.",
            "Rates (eta, shot_hz) are in Hz per pixel, typically .01-10; or shorten the interval.")


def leak_contrast(
    model: SensorModel, theta_on: Array, fixed_pattern: Array, key: Array, dt: Array
) -> Array:
    """ON contrast leaked in dt: rate x fixed pattern x (1 - jitter N(0,1)) x theta_on (v2e)."""
    leaked = dt * model.leak_hz * fixed_pattern * theta_on
    if model.leak_jitter > 0:
        normal = jax.random.normal(key, theta_on.shape, theta_on.dtype)
        leaked = leaked * (1.0 - model.leak_jitter * normal)
    return leaked


def leak_pattern(model: SensorModel, key: Array, shape: tuple[int, ...]) -> Array:
    """Fixed pattern of leak rates: log-normal, median 1, `leak_fpn_decades` wide."""
    if model.leak_hz <= 0 or model.leak_fpn_decades <= 0:
        return jnp.ones(shape, jnp.float32)
    return 10.0 ** (model.leak_fpn_decades * jax.random.normal(key, shape, jnp.float32))

"""Noise events: a Poisson process per pixel and polarity, and the leak of the memory.

Rates follow the camera's eta maps and, optionally, v2e's shot noise. A pixel's draw in an interval
is a hash of (key, pixel, interval): nothing is stored, any subset of pixels can be evaluated, and
all programs give the same events. The functions from `scramble` to `next_tail` also take NumPy
arrays, for the host to place the few events. Counts are exact at any interval length; the events of
an interval are independent and uniform in it.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.camera.leak import MOST_SHOT, without_leak
from evflow.errors import EvflowDataError
from evflow.light.log_maps import Values, noise_factor
from evflow.simulator.constants import Constants

Array = jax.Array

MAX_MEAN = 70.0  # noise events per pixel and interval; beyond ~85 exp(-mean) underflows
LEAK_THETA = 10.0  # natural log; the range of an image sensor is 5.5
GOLDEN = np.uint32(0x9E3779B9)  # 2^32 / golden ratio: distinct numbers far apart
# sin(2 pi y) / y in powers of y^2, |y| <= 1/4: the fit of least relative error, 5e-9.
SINE = (6.28318548, -41.3416786, 81.6022339, -76.5749893, 39.7109184)
JITTER = 1 << 30  # first number of the leak's draws; those of events count from 0


def scramble(x: Values) -> Values:
    """Hash: a bijection of uint32 by xor-shift and multiply, twice, with the constants of C.
    Wellons' hash prospector."""
    x = (x ^ (x >> 16)) * np.uint32(0x21F0AAAD)
    x = (x ^ (x >> 15)) * np.uint32(0xD35A2D97)
    return x ^ (x >> 15)


def pixel_words(key: Array, count: int) -> Array:
    """uint32 (count,): a random word for each pixel."""
    return jax.random.bits(key, (count,), jnp.uint32)


def salts(key: Array, intervals: Array) -> Array:
    """uint32 (T, 2): a multiplier and an offset for each frame interval, by key and index."""
    def salt(interval: Array) -> Array:
        bits = jax.random.bits(jax.random.fold_in(key, interval), (2,), jnp.uint32)
        return bits | jnp.array([1, 0], jnp.uint32)  # an odd multiplier loses no bit

    return jax.vmap(salt)(intervals)


def draw(words: Array, salt: Array) -> Array:
    """uint32 per pixel: its draw in the interval of this salt (2,). The multiply-add makes any two
    pixels independent; the hash removes the remaining structure."""
    return scramble(words * salt[0] + salt[1])


def further(words: Values, drawn: Values, number: Values) -> Values:
    """Uniforms in (0, 1]: further draws of the interval, by number (uint32)."""
    return uniform(scramble(drawn + words + (number + np.uint32(1)) * GOLDEN))


def uniform(bits: Values) -> Values:
    """float32 in (0, 1] of uint32. Near zero the resolution is 2^-32 (that of
    jax.random.uniform, 2^-23, is too coarse for a probability of 1e-6 per interval)."""
    return (bits.astype(np.float32) + np.float32(0.5)) * np.float32(2.0**-32)


def event(
    model: Constants, words: Values, drawn: Values, k: Values, share: Values
) -> tuple[Values, Values]:
    """The k-th (uint32) noise event of an interval: its fraction of the interval (v2e: 1, at the
    frame), and whether it is ON. share: probability of ON."""
    at, mark = (further(words, drawn, np.uint32(2) * k + np.uint32(i)) for i in (0, 1))
    return at if model.timestamps == "crossing" else at * 0 + 1, mark <= share


Tail = tuple[Values, Values, Values]


def some(mean: Values) -> Values:
    """P(N > 0) of a Poisson count N: 1 - exp(-mean), by its series below .03."""
    xp = mean.__array_namespace__()
    series = mean * (1.0 - mean / 2.0 * (1.0 - mean / 3.0 * (1.0 - mean / 4.0)))
    return xp.where(mean < 0.03, series, 1.0 - xp.exp(-mean))


def next_tail(mean: Values, current: Tail) -> Tail:
    """From P(N > k) and P(N = k) to those of k + 1.

    A pixel sends its event k (0, 1, ...) if the interval's uniform is below P(N > k). Where
    P(N = k) < 1e-12 the remainder is rounding and set to 0, which ends any loop.
    """
    more, equal, k = current
    k = k + np.float32(1.0)
    equal = equal * mean / k
    return (more - equal) * ((equal > 1e-12) | (k < mean)).astype(np.float32), equal, k


def poisson(u: Array, mean: Array) -> Array:
    """Poisson counts (float32) by inversion of the upper tail: exact for small means. The cost
    follows the largest count (jax.random.poisson is ~20x slower here)."""
    def unfinished(carry: tuple[Array, Tail]) -> Array:
        return jnp.any(u < carry[1][0])

    def step(carry: tuple[Array, Tail]) -> tuple[Array, Tail]:
        return carry[0] + (u < carry[1][0]), next_tail(mean, carry[1])

    mean = mean + jnp.zeros_like(u)
    tail = some(mean), jnp.exp(-mean), jnp.zeros((), u.dtype)
    return jax.lax.while_loop(unfinished, step, (jnp.zeros_like(u), tail))[0]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rates:
    """Noise rates in Hz, ON and OFF maps each: rate = steady + varying x noise_factor(I01).
    varying: None where intensity does not matter."""

    steady: tuple[Values, Values]
    varying: tuple[Values, Values] | None

    def at(self, i01: Values) -> tuple[Values, Values]:
        """(ON, OFF) rates at normalised intensity i01."""
        (on, off), factor = self.steady, noise_factor(i01)
        if self.varying is None:
            return on, off
        return on + self.varying[0] * factor, off + self.varying[1] * factor


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Odds:
    """Noise of an interval, per pixel: mean number of events, probabilities of any and of none,
    share of ON among them."""

    mean: Values
    some: Values
    none: Values
    share: Values

    def tail(self) -> Tail:
        """(P(N > 0), P(N = 0), k = 0), the start of `next_tail`."""
        return self.some, self.none, np.float32(0.0)


def odds(rates: Rates, i01: Values, dt: Values) -> Odds:
    """The odds of an interval of dt seconds at normalised intensity i01."""
    xp = i01.__array_namespace__()
    on, off = rates.at(i01)
    mean = dt * (on + off)
    return Odds(mean, some(mean), xp.exp(-mean), on / xp.maximum(on + off, 1e-30))


def rates(model: Constants, camera: Camera, reference: Array, nominal: Array) -> Rates:
    """The camera's noise rates.

    reference: the I01 at which eta is given (the mean of the first frame). nominal: of
    `nominal_thresholds`; v2e's shot noise adds R/2 ((F-1) I01 + 1) nominal / theta. If eta includes
    all noise (`eta_is_all`), leak is subtracted, and the rest, normalised by `nominal`, is the
    pattern of shot noise, unless there is none. Beyond `MOST_SHOT` it is a hot pixel's, steady.
    """
    eta = _but_leak(model, camera)
    if not model.eta_intensity and model.shot_hz is None:
        return Rates(eta, None)
    zero = jnp.zeros_like(camera.eta_on)
    steady, varying = eta, (zero, zero)
    if model.eta_intensity:
        gain = 1.0 / noise_factor(reference)
        steady, varying = varying, (eta[0] * gain, eta[1] * gain)
    if model.shot_hz is not None and model.eta_is_all:
        half, shot = 0.5 * model.shot_hz, model.shot_hz > 0  # a traced one may be 0
        hot = tuple(jnp.where(own * n > MOST_SHOT, own, 0.0)
                    for own, n in zip(eta, nominal, strict=True))
        falling = tuple(half * n * (own - steadily)
                        for n, own, steadily in zip(nominal, eta, hot, strict=True))
        return Rates(*jax.tree.map(lambda with_it, none: jnp.where(shot, with_it, none),
                                   (hot, falling), (steady, varying)))
    if model.shot_hz is not None:
        half = 0.5 * model.shot_hz
        varying = (varying[0] + half * (nominal[0] / camera.theta_on),
                   varying[1] + half * (nominal[1] / camera.theta_off))
    return Rates(steady, varying)


def _but_leak(model: Constants, camera: Camera) -> tuple[Array, Array]:
    """Noise rates ON and OFF, minus the leak if eta includes it."""
    on, off = camera.eta_on, camera.eta_off
    if not model.eta_is_all or model.leak_hz is None:
        return on, off
    return without_leak(on, off, model.leak_hz, model.noise_resets_memory), off


def nominal_thresholds(model: Constants, camera: Camera) -> Array:
    """Median thresholds (ON, OFF) to which shot noise refers, (2, ...) for maps (..., H, W); if eta
    includes all noise, one over the eta to which it refers, less leak.

    A median is a sort: 17 ms on the device for a sensor of 346x260, 1 ms on the host. Call it
    outside jit where the camera is known. Skipped for models without shot noise.
    """
    theta = (camera.theta_on, camera.theta_off)
    lead = camera.shape[:-2]
    if model.shot_hz is None:
        return jnp.ones((2, *lead), jnp.float32)
    if model.eta_is_all:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((camera, model))):
            return _one_over_eta(model, camera)
        with jax.ensure_compile_time_eval():
            return _one_over_eta(model, camera)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in theta):
        return jnp.median(jnp.stack(theta).reshape(2, *lead, -1), axis=-1)
    maps = np.stack([np.asarray(t) for t in theta])
    with jax.ensure_compile_time_eval():  # concrete within jit too, for `most_rate`
        return jnp.asarray(np.median(maps.reshape(2, *lead, -1), axis=-1))


def _one_over_eta(model: Constants, camera: Camera) -> Array:
    eta = jnp.stack(_but_leak(model, camera)).mean((0, -2, -1))
    if model.shot_eta_hz is not None:
        eta = jnp.where(model.shot_eta_hz > 0, model.shot_eta_hz, eta)  # it may be traced
    return jnp.broadcast_to(1.0 / jnp.maximum(eta, 1e-12), (2, *camera.shape[:-2]))


def is_noisy(model: Constants, camera: Camera) -> bool:
    """False only where no noise event can occur (host side; traced cameras count as noisy)."""
    etas = (camera.eta_on, camera.eta_off)
    if model.shot_hz is not None or any(isinstance(e, jax.core.Tracer) for e in etas):
        return True
    return any(bool(np.any(np.asarray(eta) > 0)) for eta in etas)


def peak(rates: Rates) -> Array:
    """Bound on each pixel's rate, both polarities together, at any intensity (Hz)."""
    on, off = rates.at(jnp.zeros((), rates.steady[0].dtype))
    return on + off


def most_rate(model: Constants, camera: Camera, nominal: Array) -> float:
    """Bound on the rate of any pixel at any intensity and reference, Hz (host side; 0, no bound,
    for traced cameras and models)."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((camera, model))):
        return 0.0
    with jax.ensure_compile_time_eval():
        nominal = jnp.reshape(nominal, (*nominal.shape, 1, 1))
        brightest = jnp.ones((), jnp.float32)
        return float(jnp.max(peak(rates(model, camera, brightest, nominal))))


def check_rate(rate_hz: float, dt_s: float) -> None:
    """Raise EV014 where `rate_hz` is more than the counts of an interval of dt_s can hold."""
    if rate_hz * dt_s > MAX_MEAN:
        raise EvflowDataError(
            "EV014", f"noise reaches {rate_hz:.3g} Hz: {rate_hz * dt_s:.3g} events per pixel in "
            f"one frame interval of {dt_s * 1e3:.3g} ms.",
            "Rates (eta, shot_hz) are in Hz per pixel, typically .01-10, a hot pixel's hundreds: "
            "shorten the interval (more frames per second), or lower its rate in the camera.")


def leak_rates(model: Constants, theta_on: Array, pattern: Array) -> Array:
    """Contrast that leaks into ON per second: rate x fixed pattern x theta_on (v2e). Pixels with
    thresholds out of reach of light are dead, and do not leak either."""
    return model.leak_hz * pattern * jnp.minimum(theta_on, LEAK_THETA)


def leak(model: Constants, leaking: Array, words: Array, drawn: Array, dt: Array) -> Array:
    """Contrast leaked in an interval: `leak_rates` x dt x (1 - jitter N(0,1)) (v2e)."""
    if model.leak_jitter is None:
        return leaking * dt
    u, v = (further(words, drawn, jnp.uint32(JITTER + i)) for i in (0, 1))
    normal = jnp.sqrt(-2.0 * jnp.log(u)) * cosine(v)
    return leaking * dt * (1.0 - model.leak_jitter * normal)


def cosine(turns: Array) -> Array:
    """cos(2 pi turns) of float32 turns in [0, 1], to 2e-7. On a CPU XLA calls the C library for
    each number, which takes 10 ns against .3 ns here."""
    y = 0.25 - jnp.minimum(turns, 1.0 - turns)
    square, sine = y * y, jnp.full_like(y, SINE[-1])
    for coefficient in SINE[-2::-1]:
        sine = sine * square + coefficient
    return y * sine


def leak_pattern(model: Constants, key: Array, shape: tuple[int, ...]) -> Array:
    """Fixed pattern of leak rates: log-normal, median 1, `leak_fpn_decades` wide."""
    if model.leak_hz is None or model.leak_fpn_decades is None:
        return jnp.ones(shape, jnp.float32)
    return 10.0 ** (model.leak_fpn_decades * jax.random.normal(key, shape, jnp.float32))

"""DVS-Voltmeter: first passages against their closed forms, published counts, both exits."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import SHAPE, code_of, drifting

from evflow.camera import Camera, CameraPrior
from evflow.camera.sensors import DVS240, DVS346, Voltmeter
from evflow.simulator import voltmeter
from evflow.simulator.voltmeter import (
    Circuit,
    State,
    exit_against,
    fired,
    passage,
    settle,
    start,
    weights,
)

pytestmark = pytest.mark.usefixtures("optimised")

KEY = jax.random.key(0)
PRESETS = {"dvs346": DVS346, "dvs240": DVS240}
NOISY = Voltmeter(5.0, 20.0, 5e-3, 1e-6, 1e-8, 2e-3)  # sigma such that every draw matters
CAMERA = Camera.sample(jax.random.key(1), SHAPE, CameraPrior(theta=(0.1, 0.2)))
MANY = 200_000


def published(constants: Voltmeter, shape: tuple[int, int]) -> Camera:
    return Camera.constant(shape, 1 / constants.k1, 1 / constants.k1)


def run(constants: Voltmeter, camera: Camera, frames: np.ndarray, dt_us: float, key=KEY,
        state: State | None = None, first: int = 0) -> tuple[State, list[tuple]]:
    """The state after the video, and each interval's (pixel, fraction, on)."""
    if state is None:
        state, frames = start(frames[0]), frames[1:]
    columns = []
    for i, frame in enumerate(frames, first):
        state, *events = fired(key, i, constants, camera, state, frame, dt_us)
        columns.append(tuple(events))
    return state, columns


def totals(columns: list[tuple]) -> np.ndarray:
    return np.array([sum(c[2].sum() for c in columns), sum((~c[2]).sum() for c in columns)])


def same(a: list[tuple], b: list[tuple]) -> None:
    for left, right in zip(a, b, strict=True):
        for x, y in zip(left, right, strict=True):
            np.testing.assert_array_equal(x, y)


def constant(mu: float, sigma: float, on: float = 1.0, off: float = 1.0) -> Circuit:
    return Circuit(*(jnp.full(MANY, v, jnp.float32) for v in (mu, sigma**2, on, off)))


def draw(c: Circuit, residual: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(polarity, time) of one passage of each of MANY pixels at `residual`."""
    k_u, k_z = jax.random.split(jax.random.key(seed))
    distance, pace = jax.jit(jax.vmap(passage))(
        c, jnp.full(MANY, residual, jnp.float32), 1.0 - jax.random.uniform(k_u, (MANY,)),
        jax.random.normal(k_z, (MANY,)))
    return np.asarray(pace) > 0, np.asarray(distance / jnp.abs(pace), np.float64)


@pytest.mark.parametrize(("mu", "sigma", "on", "off", "residual"), [
    (0.7, 0.8, 1.0, 1.0, 0.0), (-0.7, 0.8, 1.0, 1.0, 0.3), (0.2, 1.0, 1.5, 0.6, -0.2),
    (0.0, 1.0, 1.0, 3.0, 0.0), (1e-12, 1.0, 1.0, 1.0, 0.5), (3.0, 0.3, 1.0, 1.0, -0.999)])
def test_polarity_has_the_two_sided_exit_probability(
    mu: float, sigma: float, on: float, off: float, residual: float
) -> None:
    polarity, _ = draw(constant(mu, sigma, on, off), residual)
    a, b, r = on - residual, off + residual, 2 * mu / sigma**2
    expected = b / (a + b) if abs(r) < 1e-9 else np.expm1(-r * b) / np.expm1(-r * (a + b))
    error = max(np.sqrt(expected * (1 - expected) / MANY), 1e-6)
    assert abs(polarity.mean() - expected) < 4 * error


@pytest.mark.parametrize(("mu", "sigma", "level"), [
    (0.5, 0.1, 1.0), (-0.5, 0.1, 1.0), (2.0, 0.7, 1.0), (-1e-3, 0.01, 0.4)])
def test_times_are_inverse_gaussian(mu: float, sigma: float, level: float) -> None:
    """Mean d / mu, variance d sigma^2 / mu^3; given the polarity, with or against the drift."""
    polarity, time = draw(constant(mu, sigma, level, level), 0.0)
    mean, variance = level / abs(mu), level * sigma**2 / abs(mu) ** 3
    shape = (level / sigma) ** 2
    kurtosis = 15 * mean / shape
    for chosen in (polarity, ~polarity):
        count = chosen.sum()
        if count > 500:
            assert abs(time[chosen].mean() - mean) < 4 * np.sqrt(variance / count)
            spread = 4 * variance * np.sqrt((kurtosis + 2) / count)
            assert abs(time[chosen].var() - variance) < spread
    assert (polarity == (mu > 0)).mean() > 0.95


def test_times_without_drift_are_levys() -> None:
    """Quantiles d^2 / (sigma z)^2: P(t < x) = P(|z| > d / (sigma sqrt x))."""
    polarity, time = draw(constant(0.0, 0.5, 1.0, 1.0), 0.4)
    for on, distance in ((True, 0.6), (False, 1.4)):
        scaled = distance / (0.5 * np.sqrt(time[polarity == on]))
        assert np.mean(scaled > 0.67449) == pytest.approx(0.5, abs=0.007)
        assert np.mean(scaled > 1.95996) == pytest.approx(0.05, abs=0.003)


def test_bridges_carry_the_noise_that_frames_cut_off() -> None:
    """The voltage at the end of a short interval is N(mu dt, sigma^2 dt)."""
    c = constant(0.01, 0.02)
    _, time = draw(c, 0.2)
    assert time.min() > 1.0
    k_u, k_z = jax.random.split(jax.random.key(5))
    pace = jnp.asarray(0.8 / time, jnp.float32)
    end = np.asarray(jax.vmap(settle)(
        c, jnp.full(MANY, 0.8), pace, jnp.ones(MANY), 1.0 - jax.random.uniform(k_u, (MANY,)),
        jax.random.normal(k_z, (MANY,))), np.float64)
    assert end.mean() - 0.2 == pytest.approx(0.01, abs=4 * 0.02 / np.sqrt(MANY))
    assert end.std() == pytest.approx(0.02, rel=0.01)


@pytest.mark.parametrize("intervals", [1, 300])
def test_event_times_do_not_depend_on_the_frame_rate(intervals: int) -> None:
    """A still scene under a leak of 1 per 100 ms: gaps are inverse Gaussian in 1 s as in 300
    pieces, where a residual without the bridge would keep a tenth of the deviation."""
    shape, mu, sigma, span = (40, 50), 1e-5, 3e-4, 1_000_000.0
    leak = Voltmeter(1.0, 20.0, 0.0, mu, 0.0, sigma)
    still = np.repeat(np.full((1, *shape), 100.0, np.float32), intervals + 1, axis=0)
    _, columns = run(leak, Camera.constant(shape, 1.0, 1.0), still, span / intervals)
    pixel = np.concatenate([c[0] for c in columns])
    t = np.concatenate([(i + c[1]) * (span / intervals) for i, c in enumerate(columns)])
    assert all(c[2].all() for c in columns)
    order = np.lexsort((t, pixel))
    starts = np.searchsorted(pixel[order], np.arange(shape[0] * shape[1]))
    gaps = np.stack([t[order][starts + k + 1] - t[order][starts + k] for k in range(4)])
    assert (np.diff(pixel[order])[starts[:, None] + np.arange(4)] == 0).all()
    variance = sigma**2 / mu**3
    assert gaps.mean() == pytest.approx(1 / mu, abs=4 * np.sqrt(variance / gaps.size))
    spread = 4 * np.sqrt((15 * sigma**2 / mu + 2) / gaps.size)
    assert gaps.var() / variance == pytest.approx(1.0, abs=spread)


@pytest.mark.parametrize(("preset", "dn", "expected"), [
    ("dvs346", 5, 0), ("dvs346", 50, 0), ("dvs346", 128, 0), ("dvs346", 250, 1),
    ("dvs240", 5, 0), ("dvs240", 50, 2), ("dvs240", 128, 6), ("dvs240", 250, 12)])
@pytest.mark.parametrize("intervals", [1, 50])
def test_still_scenes_leak_as_published(
    preset: str, dn: int, expected: int, intervals: int
) -> None:
    """ON events of each pixel in one second; no OFF."""
    still = np.full((intervals + 1, *SHAPE), dn, np.uint8)
    camera = published(PRESETS[preset], SHAPE)
    _, columns = run(PRESETS[preset], camera, still, 1e6 / intervals)
    assert all(c[2].all() for c in columns)
    counts = sum(np.bincount(c[0], minlength=SHAPE[0] * SHAPE[1]) for c in columns)
    np.testing.assert_array_equal(counts, expected)


@pytest.mark.parametrize("preset", PRESETS)
def test_counts_are_those_of_a_voltage_without_noise(preset: str) -> None:
    """The published constants are nearly deterministic: an integrator that resets at its levels,
    in float64 and event by event, has the same counts but for a pixel here and there."""
    k, frames = PRESETS[preset], drifting(40)
    camera = Camera.constant(SHAPE, 0.1, 0.15)
    _, columns = run(k, camera, frames, 1000.0)
    v, expected = np.zeros(SHAPE), np.zeros(2)
    for before, after in zip(*(frames[s].astype(float) for s in (np.s_[:-1], np.s_[1:])),
                             strict=True):
        mean = (before + after) / 2
        v += k.k1 * (after - before) / (mean + k.k2) + 1000.0 * (k.k4 + k.k5 * mean)
        on, off = (np.floor(np.maximum(s * v, 0) / (k.k1 * th)) for s, th in ((1, .1), (-1, .15)))
        v -= k.k1 * (0.1 * on - 0.15 * off)
        expected += on.sum(), off.sum()
    assert expected.min() > 300
    np.testing.assert_allclose(totals(columns), expected, rtol=0.01)


@pytest.mark.parametrize("constants", [DVS346, NOISY])
def test_one_key_gives_the_same_bytes_for_any_chunking(constants: Voltmeter) -> None:
    frames = drifting(20)
    state, whole = run(constants, CAMERA, frames, 1000.0)
    again, repeated = run(constants, CAMERA, frames, 1000.0)
    same(whole, repeated)
    state_a, first = run(constants, CAMERA, frames[:8], 1000.0)
    state_b, second = run(constants, CAMERA, frames[8:], 1000.0, state=state_a, first=7)
    same(whole, first + second)
    for a, b, c in zip(state, again, state_b, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
    _, other = run(constants, CAMERA, frames, 1000.0, key=jax.random.key(9))
    assert not np.array_equal(whole[0][1], other[0][1])


def test_events_are_well_formed_and_pixels_fire_in_order() -> None:
    state, columns = run(NOISY, CAMERA, drifting(6, speed=6.0), 1000.0)
    assert max(len(np.unique(c[0])) for c in columns) > 100
    assert max(np.bincount(c[0]).max() for c in columns) > 1 + 2 * voltmeter.BURST
    for pixel, fraction, on in columns:
        assert (fraction.dtype, on.dtype) == (np.float32, bool)
        assert fraction.min() > 0
        assert fraction.max() <= 1
        for p in np.unique(pixel):
            assert (np.diff(fraction[pixel == p]) >= 0).all()
    assert (state.residual <= NOISY.k1 * CAMERA.theta_on).all()
    assert (state.residual >= -NOISY.k1 * CAMERA.theta_off).all()


def test_pixels_draw_alone() -> None:
    """What the first rows do does not depend on the rows below (and so not on compaction)."""
    frames = drifting(4, speed=6.0)
    _, whole = run(NOISY, CAMERA, frames, 1000.0)
    half = SHAPE[0] // 2
    _, part = run(NOISY, jax.tree.map(lambda m: m[:half], CAMERA), frames[:, :half], 1000.0)
    for (pixel, fraction, on), above in zip(whole, part, strict=True):
        keep = np.lexsort((fraction, pixel))[: np.sum(pixel < half * SHAPE[1])]
        order = np.lexsort((above[1], above[0]))
        for x, y in zip((pixel, fraction, on), above, strict=True):
            np.testing.assert_array_equal(x[keep], y[order])


def on_device(key: jax.Array, frames: jax.Array, camera: Camera, *, constants: Voltmeter,
              dt_us: float, bins: int) -> tuple[State, jax.Array]:
    """Voxel grid (2, bins, H, W) of a video, one scan over its intervals."""
    length = (bins - 1) / (len(frames) - 1)

    def body(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
        index, frame = inputs
        state, grid = weights(key, index, constants, camera, carry[0], frame, dt_us, carry[1],
                              index * length, length)
        return (state, grid), None

    grid = jnp.zeros((2, bins, *frames.shape[1:]))
    index = jnp.arange(len(frames) - 1, dtype=jnp.int32)
    return jax.lax.scan(body, (start(frames[0]), grid), (index, frames[1:]))[0]


def from_events(columns: list[tuple], bins: int, size: int) -> np.ndarray:
    grid = np.zeros((2, bins, size))
    for i, (pixel, fraction, on) in enumerate(columns):
        at = (i + fraction.astype(float)) * (bins - 1) / len(columns)
        for j in range(bins):
            np.add.at(grid, (1 - on.astype(int), j, pixel), np.maximum(0, 1 - np.abs(at - j)))
    return grid


@pytest.mark.parametrize(("constants", "shape", "speed"), [
    (DVS346, SHAPE, 0.5), (NOISY, (40, 60), 3.0)])
def test_both_exits_have_the_same_events(
    constants: Voltmeter, shape: tuple[int, int], speed: float
) -> None:
    """(40, 60) has more pixels than a batch of the device exit."""
    frames = drifting(9, shape, speed)
    camera = Camera.sample(jax.random.key(1), shape, CameraPrior(theta=(0.1, 0.2)))
    state, columns = run(constants, camera, frames, 500.0)
    assert totals(columns).min() > 200
    call = jax.jit(partial(on_device, constants=constants, dt_us=500.0, bins=6))
    final, grid = call(KEY, jnp.asarray(frames), camera)
    expected = from_events(columns, 6, shape[0] * shape[1]).reshape(grid.shape)
    np.testing.assert_allclose(grid, expected, atol=1e-4)
    np.testing.assert_allclose(final.residual, state.residual, atol=1e-4)


def test_device_exit_under_vmap_is_the_single_call() -> None:
    frames = jnp.stack([jnp.asarray(drifting(5, speed=s)) for s in (0.0, 0.5, 3.0)])
    keys = jax.random.split(KEY, 3)
    one = partial(on_device, camera=CAMERA, constants=NOISY, dt_us=500.0, bins=3)
    _, grids = jax.jit(jax.vmap(one))(keys, frames)
    for key, video, grid in zip(keys, frames, grids, strict=True):
        np.testing.assert_allclose(grid, jax.jit(one)(key, video)[1], atol=1e-4)


@pytest.mark.parametrize("mu", [0.0, 1e-30, 1e-9, 1e-3, 10.0, 1e4])
@pytest.mark.parametrize("variance", [0.0, 1e-30, 1e-12, 1e-4, 1e3])
def test_probabilities_and_passages_stay_finite(mu: float, variance: float) -> None:
    """Exponents from 0 to 1e34, and voltages on a level; at zero variance the path is straight."""
    ahead = jnp.array([1e-6, 1e-3, 1.0, 2.0 - 1e-6], jnp.float32)
    against = exit_against(jnp.full(4, mu, jnp.float32), jnp.full(4, variance, jnp.float32),
                           ahead, 2.0 - ahead)
    assert np.isfinite(against).all()
    assert (against >= 0).all()
    assert (against <= 1).all()
    for drift in (mu, -mu):
        c = Circuit(*(jnp.float32(v) for v in (drift, variance, 1.0, 1.0)))
        for residual in (-1.0, 0.0, 0.5, 1.0):
            for u, z in ((2.0**-33, 0.0), (0.5, 5.3), (1.0, 1e-7)):
                distance, pace = passage(c, jnp.float32(residual), jnp.float32(u), jnp.float32(z))
                end = settle(c, distance, pace, jnp.float32(1.0), jnp.float32(u), jnp.float32(z))
                assert np.isfinite([distance, pace, end]).all()
                assert abs(pace) > 0
                assert abs(end) <= 1
                if variance == 0 and mu > 1e-20:
                    assert float(pace) == pytest.approx(drift, rel=1e-6)


def test_black_frames_and_empty_intervals_are_silent() -> None:
    black = np.zeros((4, *SHAPE), np.float32)
    state, columns = run(DVS346, CAMERA, black, 1e-3)
    assert totals(columns).sum() == 0
    assert np.isfinite(state.residual).all()
    frame = drifting(1)[0]
    before = State(jnp.asarray(frame), jnp.linspace(-0.2, 0.2, frame.size).reshape(SHAPE))
    after, pixel, *_ = fired(KEY, 0, DVS346, CAMERA, before, frame, 0.0)
    assert pixel.size == 0
    np.testing.assert_allclose(after.residual, before.residual, atol=1e-6)


def test_no_second_compilation() -> None:
    run(NOISY, CAMERA, drifting(4, speed=3.0), 1000.0)
    caches = voltmeter._first._cache_size(), voltmeter._burst._cache_size()
    run(NOISY, Camera.constant(SHAPE, 0.3, 0.2), drifting(7, speed=2.0), 300, jax.random.key(2))
    assert (voltmeter._first._cache_size(), voltmeter._burst._cache_size()) == caches


def test_bad_input_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for constants in ((0.0, 20, 0, 0, 0, 0), (5, -1.0, 0, 0, 0, 0), (5, 20, -1e-9, 0, 0, 0),
                      (5, 20, 0, np.nan, 0, 0), (5, 20, 0, 0, 0, np.inf)):
        assert code_of(lambda c=constants: Voltmeter(*c)) == "EV020"
    frames = drifting(2, speed=3.0)
    assert code_of(lambda: run(DVS346, Camera.constant((3, 4)), frames, 1e3)) == "EV015"
    assert code_of(lambda: fired(KEY, 0, DVS346, CAMERA, start(frames[0]), frames[1, :5], 1e3)
                   ) == "EV015"
    monkeypatch.setattr(voltmeter, "MAX_ROUNDS", 9)
    bright = Camera.constant(SHAPE, 0.01, 0.01)
    assert code_of(lambda: run(DVS346, bright, frames, 1e3)) == "EV014"

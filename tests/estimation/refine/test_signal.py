"""Noise told from signal: what surrounds events and random points, and the rate that follows."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.estimation.refine import points as points_module
from evflow.estimation.refine.chunk import Chunk
from evflow.estimation.refine.pixels import PixelEvidence
from evflow.estimation.refine.points import (
    BOXES,
    FEATURES,
    NEAR,
    RANDOM_POINTS,
    Points,
    chunk_points,
)
from evflow.estimation.refine.sightings import sight
from evflow.estimation.refine.signal import joined, log_intensity, noise_rate, separated_noise_rates
from evflow.estimation.refine.trace import trace_of_events
from evflow.types import Events

SHAPE, STEPS, INTERVALS = (40, 48), 16, 8
TIMES = 25_000 * np.arange(INTERVALS + 1)
SECONDS = 1e-6 * float(TIMES[-1])
ETA = np.array([0.6, 0.2])
THETA = np.array([0.2, 0.3])
SILENT = -20.0  # log Hz


def noise(seed: int, shape: tuple[int, int] = SHAPE) -> Events:
    rng = np.random.default_rng(seed)
    on = np.repeat([True, False], rng.poisson(ETA * SECONDS * shape[0] * shape[1]))
    t = np.sort(rng.integers(1, TIMES[-1] + 1, len(on)))
    rng.shuffle(on)
    y, x = (rng.integers(0, n, len(on)) for n in shape)
    return Events(x, y, t, on, shape[::-1])


def chunk(events: Events, bright: np.ndarray | None = None) -> Chunk:
    height, width = events.size[::-1]
    shape = (height, width)
    path = np.random.default_rng(9).normal(5, 0.02, (INTERVALS * STEPS + 1, *shape))
    path = path.astype(np.float32)
    return Chunk(path, np.ones(shape, bool) if bright is None else bright,
                 np.full(INTERVALS, 0.025, np.float32), np.zeros(INTERVALS, np.float32),
                 trace_of_events(events, TIMES, STEPS), PixelEvidence.nothing(shape),
                 np.zeros((2, *shape)), sight(events, TIMES, path, STEPS))


def network(bias: float) -> dict[str, Any]:
    """The same log rate of signal everywhere."""
    layer = {"kernel": jnp.zeros((FEATURES, 1)), "bias": jnp.full(1, bias)}
    return {"mean": jnp.zeros(FEATURES), "scale": jnp.ones(FEATURES), "layers": {"0": layer},
            "widen": jnp.float32(1.0)}


def test_company_is_that_of_all_events_but_the_point_itself() -> None:
    events = noise(1)
    step = np.minimum(events.t * STEPS * INTERVALS / TIMES[-1], STEPS * INTERVALS - 1).astype(int)
    made = chunk(events)
    for side, points in enumerate(chunk_points(made, THETA, STEPS, 0)):
        same = events.p == (side == 0)
        number = points.event[points.event >= 0]
        used = made.sightings.number[number]
        for i, (size, span) in enumerate(BOXES):
            near = ((np.abs(step[used][:, None] - step) <= span // 2)
                    & (np.abs(events.x[used].astype(int)[:, None] - events.x) <= size // 2)
                    & (np.abs(events.y[used].astype(int)[:, None] - events.y) <= size // 2))
            expected = np.stack([(near & same).sum(1) - 1, (near & ~same).sum(1)], -1)
            np.testing.assert_allclose(
                np.expm1(points.features[:len(number), 2 * i:2 * i + 2]), expected, atol=1e-4)


def test_noise_is_surrounded_as_random_points_are() -> None:
    """Mecke's formula: means of all features agree within the counts' errors."""
    parts = [chunk_points(chunk(noise(s)), THETA, STEPS, s) for s in range(12)]
    for points in map(joined, zip(*parts, strict=True)):
        assert points.features.shape[1] == FEATURES
        assert np.isfinite(points.features).all()
        event = points.event >= 0
        a, b = points.features[event], points.features[~event]
        error = np.sqrt(a.var(0) / len(a) + b.var(0) / len(b)) + 1e-4
        assert (np.abs(a.mean(0) - b.mean(0)) / error).max() < 4.5


@pytest.mark.parametrize("most", [points_module.MOST_EVENTS, 100])
def test_pure_noise_comes_back(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Also where events are thinned; half of the sensor is not used."""
    monkeypatch.setattr(points_module, "MOST_EVENTS", most)
    bright = np.broadcast_to(np.arange(SHAPE[1]) < SHAPE[1] // 2, SHAPE)
    chunks = [chunk(noise(s), bright) for s in range(10)]
    found, std = separated_noise_rates(chunks, THETA, np.log([0.1, 0.1]), np.array([2.0, 2.0]),
                            network(SILENT))
    assert (std < 0.12).all()
    assert (np.abs(found - np.log(ETA)) < 3 * std).all()


def process(
    seed: int, eta: float, scale: float, exponent: float
) -> tuple[np.ndarray, Points]:
    """log rates of signal that a network gives at points, and the points of a process whose
    signal departs from it by a scale and an exponent."""
    rng = np.random.default_rng(seed)
    exposure, steps = 800.0, 200_000
    log_signal = rng.normal(-4.0, 3.0, steps)  # of all places there are
    truth = np.exp(np.log(0.3) + scale + exponent * (log_signal - np.log(0.3)))
    rate = (np.minimum(truth, 200.0) + eta) * exposure / steps
    where = np.repeat(np.arange(steps), rng.poisson(rate))
    random = rng.integers(0, steps, RANDOM_POINTS)
    both = np.concatenate([where, random])
    return log_signal[both], Points(
        np.zeros((len(both), 0)), np.where(np.arange(len(both)) < len(where), 1, -1),
        np.full(len(both), RANDOM_POINTS / exposure))


@pytest.mark.parametrize("eta", [0.05, 0.4])
@pytest.mark.parametrize(("scale", "exponent"), [(0.0, 1.0), (-0.6, 1.15), (0.7, 0.9)])
def test_the_rate_is_found_whatever_the_signal(eta: float, scale: float, exponent: float) -> None:
    away = []
    for seed in range(12):
        log_signal, points = process(seed, eta, scale, exponent)
        found, std = noise_rate(log_signal, points, np.log(0.14), 1.3)
        away.append((found - np.log(eta)) / std)
    assert np.abs(np.mean(away)) < 1.0
    assert 0.5 < np.sqrt(np.mean(np.square(away))) < 1.6


@pytest.mark.parametrize("start", [0.02, 0.14, 1.0, 2.0])
def test_the_rate_is_found_from_any_start(start: float) -> None:
    """Also where the first step would be long in scale and exponent."""
    log_signal, points = process(0, 0.05, 0.9, 1.3)
    found, std = noise_rate(log_signal, points, np.log(start), 1.5)
    assert std < 0.3
    assert abs(found - np.log(0.05)) < 2.0 * std


def test_without_points_nothing_is_learnt() -> None:
    nothing = Points(np.zeros((0, FEATURES), np.float32), np.zeros(0, int), np.zeros(0))
    found, std = noise_rate(np.zeros(0), nothing, np.log(0.3), 0.5)
    assert found == pytest.approx(np.log(0.3))
    assert std == pytest.approx(0.5)
    none = np.zeros(0, int)
    empty = Events(none, none, none, none > 0, SHAPE[::-1])
    rate, _ = separated_noise_rates(
        [chunk(empty)], THETA, np.log([0.1, 0.1]), np.ones(2), network(SILENT))
    assert (rate < np.log(0.02)).all()  # 384 pixel seconds without an event


def test_an_error_is_left_however_much_noise_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many times the recording: the std shrinks slower than by counts, and not without end."""
    monkeypatch.setattr(points_module, "RANDOM_POINTS", 256)
    start, wide = np.log([0.1, 0.1]), np.array([2.0, 2.0])
    parts = [chunk(noise(s)) for s in range(2)]
    found = [separated_noise_rates(parts * many, THETA, start, wide, network(SILENT))[1]
             for many in (1, 16, 256)]
    assert (found[1] > 0.3 * found[0]).all()
    assert (found[2] > 0.8 * found[1]).all()
    assert (found[1] < found[0]).all()


def test_crowds_tell_nothing_and_are_left_out() -> None:
    rng = np.random.default_rng(3)
    t = np.sort(rng.integers(1, TIMES[-1] + 1, 40_000))
    crowd = Events(rng.integers(0, 8, len(t)), rng.integers(0, 8, len(t)), t,
                   rng.random(len(t)) < 0.5, SHAPE[::-1])
    column = 2 * BOXES.index(NEAR)
    for points in chunk_points(chunk(crowd), THETA, STEPS, 0):
        assert (points.features[:, column] <= np.log1p(1.0) + 1e-6).all()
        assert (points.event < 0).sum() > 0.9 * RANDOM_POINTS
        assert (points.event >= 0).sum() < 100


def test_the_network_is_the_same_in_numpy_and_jax() -> None:
    k1, k2, k3 = jax.random.split(jax.random.key(0), 3)
    layers = {"0": {"kernel": jax.random.normal(k1, (FEATURES, 8)), "bias": jnp.ones(8)},
              "1": {"kernel": jax.random.normal(k2, (8, 1)), "bias": jnp.ones(1)}}
    net = {"mean": jnp.ones(FEATURES), "scale": jnp.full(FEATURES, 2.0), "layers": layers}
    x = jax.random.normal(k3, (5, FEATURES))
    plain = log_intensity(jax.tree.map(np.asarray, net), np.asarray(x))
    assert isinstance(plain, np.ndarray)
    np.testing.assert_allclose(jax.jit(log_intensity)(net, x), plain, rtol=2e-5, atol=1e-5)

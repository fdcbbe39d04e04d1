"""Voxel grids against Eq. 2 written out event by event, and the edges of the window."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import code_of
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.types import Events
from evflow.voxel import voxelize, voxelize_padded

SIZE = (7, 5)  # width, height
T0, WINDOW = 1_643_243_628_000_000, 32_000
LENGTH = 256  # of the padded lists: one compilation for all tests


def random_events(n: int, seed: int = 0, span: tuple[int, int] = (-9_000, 41_000)) -> Events:
    """Events in, before and after the window [T0, T0 + WINDOW)."""
    rng = np.random.default_rng(seed)
    return Events(rng.integers(0, 7, n), rng.integers(0, 5, n),
                  T0 + np.sort(rng.integers(*span, n)), rng.integers(0, 2, n), SIZE)


def reference(events: Events, t0: int, window: int, bins: int) -> np.ndarray:
    """Eq. 2 in float64, every event against every bin."""
    grid = np.zeros((5, 7, 2, bins))
    for x, y, t, p in zip(events.x, events.y, events.t.tolist(), events.p, strict=True):
        if t0 <= t < t0 + window:
            distance = np.abs(np.arange(bins) - (bins - 1) * (t - t0) / window)
            grid[y, x, 0 if p else 1] += np.maximum(0.0, 1.0 - distance)
    return grid.reshape(5, 7, 2 * bins)


@partial(jax.jit, static_argnames="bins")
def on_device(x: Any, y: Any, t: Any, p: Any, valid: Any, bins: int = 16) -> jax.Array:
    return voxelize_padded(x, y, t, p, valid, shape=(5, 7), window=float(WINDOW), bins=bins)


def padded(events: Events) -> list[np.ndarray]:
    """The columns relative to T0, filled up to LENGTH with events that must not count."""
    n = len(events)
    columns = [events.x.astype(np.int32), events.y.astype(np.int32),
               (events.t - T0).astype(np.int32), events.p, np.ones(n, bool)]
    return [np.pad(c, (0, LENGTH - n)) for c in columns]


@pytest.mark.parametrize("bins", [2, 5, 16])
def test_host_grid_is_equation_2(bins: int) -> None:
    events = random_events(400)
    grid = voxelize(events, T0, WINDOW, bins)
    assert grid.dtype == np.float32
    np.testing.assert_allclose(grid, reference(events, T0, WINDOW, bins), atol=2e-6)


@pytest.mark.parametrize("bins", [2, 16])
def test_device_grid_is_equation_2(bins: int) -> None:
    events = random_events(LENGTH - 60)
    grid = on_device(*padded(events), bins=bins)
    assert grid.dtype == jnp.float32
    np.testing.assert_allclose(grid, reference(events, T0, WINDOW, bins), atol=2e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, LENGTH), st.integers(0, 2**20))
def test_every_event_of_the_window_counts_once_at_its_pixel(n: int, seed: int) -> None:
    events = random_events(n, seed)
    inside = events.slice(T0, T0 + WINDOW).count_map()
    for grid in (voxelize(events, T0, WINDOW), on_device(*padded(events))):
        counts = np.asarray(grid).reshape(5, 7, 2, 16).sum(-1)
        np.testing.assert_allclose(np.moveaxis(counts, -1, 0), inside, atol=1e-4)


@pytest.mark.parametrize("device", [False, True])
@pytest.mark.parametrize(("t", "bins"), [
    (-1, {}), (0, {0: 1.0}), (16_000, {7: 0.5, 8: 0.5}), (31_999, {14: 15 / 32e3, 15: 1.0}),
    (32_000, {}), (32_001, {})])
def test_window_is_half_open(t: int, bins: dict[int, float], device: bool) -> None:
    event = Events([3], [2], [T0 + t], [True], SIZE)
    grid = on_device(*padded(event)) if device else voxelize(event, T0, WINDOW)
    expected = np.zeros((5, 7, 32))
    for j, weight in bins.items():
        expected[2, 3, j] = weight
    np.testing.assert_allclose(grid, expected, atol=5e-4)


def test_adjacent_windows_share_no_event_and_lose_none() -> None:
    events = random_events(500, span=(0, 96_000))
    total = sum(voxelize(events, T0 + i * WINDOW, WINDOW).sum() for i in range(3))
    assert total == pytest.approx(500, abs=1e-3)


def test_on_channels_come_before_off_channels() -> None:
    for p, channel in ((True, 0), (False, 16)):
        event = Events([6], [4], [T0], [p], SIZE)
        for grid in (voxelize(event, T0, WINDOW), on_device(*padded(event))):
            assert np.argwhere(np.asarray(grid)).tolist() == [[4, 6, channel]]


@pytest.mark.parametrize("p", [np.array([True, False]), np.array([1, 0], np.uint8),
                               np.array([1, -1], np.int8), np.array([1, -1], np.int32)])
def test_device_takes_every_polarity_convention(p: np.ndarray) -> None:
    columns = padded(Events([1, 2], [1, 1], [T0, T0], [True, False], SIZE))
    columns[3] = np.pad(p, (0, LENGTH - 2))
    grid = on_device(*columns)
    assert np.argwhere(np.asarray(grid)).tolist() == [[1, 1, 0], [1, 2, 16]]


def test_padding_is_ignored_whatever_it_holds() -> None:
    events = random_events(100)
    clean, dirty = padded(events), padded(events)
    rng = np.random.default_rng(3)
    for column in dirty[:4]:
        column[100:] = rng.integers(0, 2, LENGTH - 100)
    np.testing.assert_array_equal(on_device(*dirty), on_device(*clean))


@pytest.mark.parametrize(("x", "y"), [(-1, 2), (7, 2), (3, -1), (3, 5), (-8, 1), (2**30, 0)])
def test_events_outside_the_sensor_go_nowhere(x: int, y: int) -> None:
    """JAX wraps index -1 and drops others in silence; neither an edge nor another row may gain."""
    columns = padded(Events([3], [2], [T0 + 9_000], [True], SIZE))
    columns[0][0], columns[1][0] = x, y
    assert not np.asarray(on_device(*columns)).any()


def test_device_times_may_be_seconds_and_nan_is_nowhere() -> None:
    events = random_events(200)
    x, y, t, p, valid = padded(events)
    seconds = (t * 1e-6).astype(np.float32)
    grid = voxelize_padded(*map(jnp.asarray, (x, y, seconds, p, valid)), shape=(5, 7),
                           window=WINDOW * 1e-6)
    np.testing.assert_allclose(grid, on_device(x, y, t, p, valid), atol=1e-4)
    seconds[:] = np.nan
    assert not np.asarray(on_device(x, y, seconds, p, valid)).any()


def test_vmap_and_no_jit_agree() -> None:
    several = [padded(random_events(150, seed)) for seed in (1, 2)]
    stacked = [jnp.stack(column) for column in zip(*several, strict=True)]
    together = jax.vmap(on_device)(*stacked)
    for grid, columns in zip(together, several, strict=True):
        np.testing.assert_allclose(grid, on_device(*columns), atol=1e-6)
    with jax.disable_jit():
        plain = on_device(*map(jnp.asarray, several[0]))
    np.testing.assert_allclose(plain, together[0], atol=1e-6)


def test_silence_is_zeros() -> None:
    silent = Events([], [], [], [], SIZE)
    assert voxelize(silent, T0, WINDOW).shape == (5, 7, 32)
    assert not voxelize(silent, T0, WINDOW).any()
    assert not np.asarray(on_device(*padded(silent))).any()


@pytest.mark.parametrize(("window", "bins"), [(0, 16), (-5, 16), (1000, 1), (1000, 0)])
def test_impossible_windows_are_refused(window: int, bins: int) -> None:
    assert code_of(lambda: voxelize(random_events(3), T0, window, bins)) == "EV020"


def test_windows_may_be_small_integers() -> None:
    t0, length = np.int32(2_147_480_000), np.int32(50_000)
    events = Events([1, 2], [1, 2], [int(t0) + 10, int(t0) + 40_000], [True, False], SIZE)
    assert voxelize(events, t0, length).sum() == 2


@pytest.mark.parametrize("window", [(0.0, 1000), (0, 1e3)])
def test_times_in_seconds_are_refused(window: tuple[Any, Any]) -> None:
    assert code_of(lambda: voxelize(random_events(10), *window)) == "EV003"

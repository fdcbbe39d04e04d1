"""Log maps: continuous, invertible, and the byte table agrees with the formula."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import code_of

from evflow.light.log_maps import (
    LINLOG_KNEE,
    LOG_MAPS,
    delta_log_intensity,
    lin_log,
    log_eps,
    noise_factor,
    normalised_intensity,
    to_dn,
    to_log,
    uint8_table,
)

DN = np.concatenate([np.linspace(0.0, 40.0, 401), np.linspace(40.5, 255.0, 430)])


def exact(dn: np.ndarray, log_map: str) -> np.ndarray:
    """The two maps in float64, from their definitions."""
    dn = dn.astype(np.float64)
    if log_map == "log_eps":
        return np.log(dn / 255.0 + 1e-3)
    return np.array([d * np.log(20.0) / 20.0 if d <= 20.0 else np.log(d) for d in dn])


def test_lin_log_is_continuous_at_its_knee_and_its_slope_falls_from_15_to_5_per_cent() -> None:
    below, at, above = np.asarray(lin_log(np.float32([19.999, 20.0, 20.001])), np.float64)
    assert at == pytest.approx(np.log(20.0), abs=3e-7)
    assert at - below == pytest.approx(1e-3 * 0.149787, abs=1e-6)
    assert above - at == pytest.approx(1e-3 * 0.05, abs=1e-6)


@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
def test_maps_follow_their_definitions_and_rise(log_map: str) -> None:
    value = np.asarray(LOG_MAPS[log_map][0](jnp.asarray(DN, jnp.float32)))
    np.testing.assert_allclose(value, exact(DN, log_map), atol=1e-6)
    assert (np.diff(value) > 0).all()


def test_lin_log_spans_zero_to_ln_255() -> None:
    assert np.asarray(lin_log(np.array([0, 255], np.uint8))) == pytest.approx([0.0, 5.5412636])


@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
def test_inverse_gives_the_pixel_value_back(log_map: str) -> None:
    there, back = LOG_MAPS[log_map]
    np.testing.assert_allclose(back(there(jnp.asarray(DN, jnp.float32))), DN, rtol=3e-6, atol=5e-6)


@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
def test_maps_and_inverses_keep_float64(log_map: str) -> None:
    there, back = LOG_MAPS[log_map]
    with jax.enable_x64(True):
        value = there(jnp.asarray(DN))
        assert value.dtype == jnp.float64
        np.testing.assert_allclose(value, exact(DN, log_map), atol=1e-14)
        np.testing.assert_allclose(back(value), DN, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("there", "slopes"), [
    (lin_log, [np.log(20) / 20, np.log(20) / 20, 1 / 100]),
    (log_eps, [1 / 0.255, 1 / 10.255, 1 / 100.255])])
def test_gradients_are_finite_down_to_black(there: Any, slopes: list[float]) -> None:
    gradient = jax.vmap(jax.grad(there))(jnp.array([0.0, 10.0, 100.0]))
    np.testing.assert_allclose(gradient, slopes, rtol=1e-5)


@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
def test_byte_table_is_the_map(log_map: str) -> None:
    dn = np.arange(256)
    table = uint8_table(log_map)
    assert table.dtype == np.float32
    np.testing.assert_allclose(table, exact(dn, log_map), rtol=6e-8, atol=1e-8)
    np.testing.assert_allclose(to_log(dn.astype(np.float32), log_map), table, atol=1e-6)
    np.testing.assert_array_equal(to_log(dn.astype(np.uint8).reshape(4, 64), log_map),
                                  table.reshape(4, 64))


def test_linlog_table_is_v2es_rounded_to_8_decimals() -> None:
    exact_table = np.round(exact(np.arange(256), "linlog"), 8).astype(np.float32)
    np.testing.assert_array_equal(uint8_table("linlog"), exact_table)


@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
def test_uint16_spans_the_same_range_as_uint8(log_map: str) -> None:
    dn = np.arange(256)
    np.testing.assert_allclose(to_log((dn * 257).astype(np.uint16), log_map),
                               uint8_table(log_map), atol=1e-5)


@pytest.mark.parametrize("full", [255, 1023, 4095, 65535])
def test_to_dn_maps_full_scale_to_255(full: int) -> None:
    scaled = to_dn(np.array([[0, full]], np.uint16), full)
    assert scaled.dtype == np.float32
    np.testing.assert_allclose(scaled, [[0.0, 255.0]], rtol=1e-6)


@pytest.mark.parametrize("full", [0, -1, float("nan")])
def test_to_dn_refuses_an_empty_scale(full: float) -> None:
    assert code_of(lambda: to_dn(np.zeros((2, 2)), full)) == "EV020"


def test_noise_factor_runs_from_095_in_the_dark_to_a_quarter_at_full_scale() -> None:
    i01 = normalised_intensity(jnp.array([0.0, 117.5, 255.0]))
    np.testing.assert_allclose(i01, [20 / 275, 0.5, 1.0], rtol=1e-6)
    np.testing.assert_allclose(noise_factor(i01), [1 - 15 / 275, 0.625, 0.25], rtol=1e-6)


def test_delta_log_intensity_is_signed_and_adds_up() -> None:
    rng = np.random.default_rng(0)
    a, b, c = rng.integers(0, 256, (3, 2, 5, 4)).astype(np.uint8)
    ab, bc = delta_log_intensity(a, b), delta_log_intensity(b, c)
    assert ab.dtype == jnp.float32
    assert ab.shape == (2, 5, 4)
    expected = exact(b.ravel(), "linlog") - exact(a.ravel(), "linlog")
    np.testing.assert_allclose(np.ravel(ab), expected, atol=1e-6)
    np.testing.assert_array_equal(delta_log_intensity(b, a), -ab)
    np.testing.assert_allclose(ab + bc, delta_log_intensity(a, c), atol=1e-6)


def test_delta_log_intensity_mixes_bytes_and_floats() -> None:
    a, b = np.full((2, 2), 10, np.uint8), np.full((2, 2), 200.0, np.float32)
    np.testing.assert_allclose(delta_log_intensity(a, b), np.log(200) - 10 * np.log(20) / 20,
                               atol=1e-6)
    assert LINLOG_KNEE == 20.0


def test_delta_log_intensity_takes_whole_numbers_of_any_kind() -> None:
    a, b = np.array([[0, 10]]), np.array([[3, 255]])
    expected = delta_log_intensity(a.astype(np.uint8), b.astype(np.uint8))
    for dtype in (np.int16, np.int64, np.uint32, np.float64):
        np.testing.assert_allclose(delta_log_intensity(a.astype(dtype), b.astype(dtype)), expected,
                                   atol=1e-6)
    deep = [257 * f for f in (a, b)]
    for dtype in ("<u2", ">u2"):
        np.testing.assert_allclose(
            delta_log_intensity(*(f.astype(dtype) for f in deep)), expected, atol=1e-5)
    assert not np.any(delta_log_intensity(*np.zeros((2, 3, 4), np.uint16)))  # black in any scale
    assert code_of(lambda: delta_log_intensity(a.astype(np.uint8), deep[1].astype("<u2"))) == (
        "EV003")  # two scales


@pytest.mark.parametrize(("a", "b"), [
    (np.zeros(4), np.zeros((2, 2))), (np.zeros((2, 2)), np.zeros(4)),
    (np.zeros((2, 3)), np.zeros((3, 2))), (np.zeros((1, 2, 3)), np.zeros((2, 3)))])
def test_delta_log_intensity_refuses_wrong_shapes(a: np.ndarray, b: np.ndarray) -> None:
    assert code_of(lambda: delta_log_intensity(a, b)) == "EV002"


@pytest.mark.parametrize(("frame", "code"), [
    (np.full((24, 32, 3), 100, np.uint8), "EV002"), (np.full((2, 3), 0.5), "EV003"),
    (np.full((2, 3), -1.0), "EV003"), (np.full((2, 3), 300.0), "EV003"),
    (np.full((2, 3), np.nan), "EV007"), (np.full((2, 3), -100, np.int16), "EV003"),
    (np.full((2, 3), 4000, np.int32), "EV003"), (np.full((2, 3), 4095, np.uint16), "EV003"),
    (jnp.full((2, 3), 1023, jnp.uint16), "EV003"), (np.ones((2, 3), bool), "EV003"),
    (np.full((2, 3), 10 + 1j), "EV003")])
def test_delta_log_intensity_refuses_what_is_no_gray_dn(frame: np.ndarray, code: str) -> None:
    assert code_of(lambda: delta_log_intensity(frame, frame)) == code

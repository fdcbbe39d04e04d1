"""The logarithm of a system's thresholds: inverse, slope, and light that the frames do not show."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from evflow.light.log_maps import LOG_EPS_DN, lin_log
from evflow.light.logarithm import LEAST_DN, LIN_LOG, Logarithm
from evflow.simulator.photoreceptor import seen_path

DN = np.linspace(0.5, 254.5, 300).astype(np.float32)


@pytest.mark.parametrize("logarithm", [
    LIN_LOG, Logarithm(18.0), Logarithm(-0.3), Logarithm(log_map="log_eps"),
    Logarithm(6.0, "log_eps"), Logarithm(100.0, "log")], ids=str)
def test_it_has_an_inverse_and_a_slope(logarithm: Logarithm) -> None:
    np.testing.assert_allclose(logarithm.dn(logarithm.of(DN)), DN, rtol=1e-4)
    # A central difference, not across the knee.
    rise = (np.asarray(logarithm.of(DN + 0.25)) - np.asarray(logarithm.of(DN - 0.25))) / 0.5
    away = (np.abs(DN + logarithm.offset_dn - 20) > 1) & (DN > 2)
    np.testing.assert_allclose(np.asarray(logarithm.slope(DN))[away], rise[away], rtol=5e-3)


@pytest.mark.parametrize("offset", [-16.0, 0.5, 24.0])
@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
def test_it_is_that_of_a_measured_pixel(offset: float, log_map: str) -> None:
    """Also below the black level, where the light is held above 0."""
    dn = np.array([0.0, 3.0, 16.0, 40.0, 200.0], np.float32)
    seen = seen_path(dn[:, None], np.full(4, 1.0, np.float32), np.float32(offset),
                     np.float32(1e-5), True, log_map == "log_eps")[:, 0]
    found = Logarithm(offset, log_map).of(dn)
    assert jnp.isfinite(found).all()
    np.testing.assert_allclose(found, seen, atol=2e-3)
    assert Logarithm(-16.0).of(3.0) == pytest.approx(float(lin_log(LEAST_DN)))


def test_published_ones_are_of_the_sum_alone() -> None:
    np.testing.assert_allclose(Logarithm(40.0, "log").of(DN), np.log(DN + 40.0), rtol=1e-6)
    np.testing.assert_allclose(
        Logarithm(log_map="log_eps").of(DN), np.log(DN + LOG_EPS_DN), rtol=1e-6)

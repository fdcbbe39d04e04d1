"""The contrast that the path keeps, where motion is too fast for the frames."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow import simulate
from evflow.camera import Camera, Summary
from evflow.estimation.refine.pixels import pixel_evidence, pixel_posterior
from evflow.light.log_maps import lin_log

SHAPE, STEPS, INTERVALS = (24, 32), 8, 12
MEDIAN, SIGMA = 0.2, 0.02
KNOWN = Summary(*(jnp.float32(v) for v in (MEDIAN, MEDIAN, 0.0, 0.0, SIGMA, SIGMA)))


@pytest.mark.parametrize(("kept", "error"), [(0.95, 0.05), (0.4, 0.25)], ids=["good", "poor"])
def test_maps_have_the_cameras_thresholds_on_a_path_that_misses_contrast(
    kept: float, error: float
) -> None:
    """A path with 40 % of the contrast pulled thousands of events' thresholds to half."""
    rng = np.random.default_rng(0)
    theta = np.maximum(MEDIAN + SIGMA * rng.standard_normal((2, *SHAPE)), 0.05)
    t = np.arange(STEPS * INTERVALS + 1)[:, None, None]
    log = 4.6 + 0.7 * np.sin(
        2 * np.pi * (t / rng.uniform(9, 16, SHAPE) + rng.uniform(0, 1, SHAPE)))
    camera = Camera(*(jnp.asarray(m, jnp.float32) for m in (*theta, *np.zeros((2, *SHAPE)))))
    events = simulate(
        jax.random.key(0), np.exp(log).astype(np.float32), 1000 * np.arange(len(t)), camera)
    path = np.asarray(lin_log(np.exp(log).astype(np.float32)))
    path = 4.6 + kept * (path - 4.6) + error * rng.standard_normal(path.shape)
    evidence = pixel_evidence(
        events, 1000 * np.arange(0, STEPS * INTERVALS + 1, STEPS), path.astype(np.float32), STEPS)
    found, std = pixel_posterior(evidence, KNOWN)
    assert np.median(found) == pytest.approx(MEDIAN, rel=0.07)
    away = np.abs(found - theta) / std
    assert (away < 1).mean() > 0.5
    assert (away < 2).mean() > 0.85

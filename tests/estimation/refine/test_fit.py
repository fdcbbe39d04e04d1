"""The Gauss-Newton steps: thresholds from a wrong start."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import hidden

from evflow.camera import Summary
from evflow.estimation.refine import refine_summary, refinement_chunks
from evflow.recordings import plan_windows


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_steps_find_the_thresholds_from_a_wrong_start(seed: int) -> None:
    """A start 25 % off, 3-8 px of motion between frames: half of the error goes at least (the
    steps keep a bias of some per cent, which the fusion knows)."""
    recording, camera = hidden(seed)
    true = Summary(*(jnp.median(m) for m in (
        camera.theta_on, camera.theta_off, camera.eta_on, camera.eta_off)), *jnp.full(2, 0.03))
    start = dataclasses.replace(true, theta_on=1.25 * true.theta_on,
                                theta_off=0.8 * true.theta_off)
    std = jax.tree.map(lambda v: 0.3 * v, start)
    chunks = refinement_chunks(recording, plan_windows(recording).pairs)
    found = refine_summary(chunks, start, std)
    again = refine_summary(chunks, start, std)
    for name in ("theta_on", "theta_off"):
        assert float(getattr(found.summary, name)) == pytest.approx(
            float(getattr(true, name)), rel=0.12)
    np.testing.assert_array_equal(found.features, again.features)
    assert np.isfinite(found.features).all()

"""The mismatch that steps of light show, beside the errors of the pixels' own thresholds."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.benches import CYCLES, STAIRS, bench, cameras

from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.steps import camera_wide


@pytest.mark.parametrize("levels", [CYCLES, STAIRS], ids=["cycles", "stairs"])
@pytest.mark.parametrize("mismatch", [0.005, 0.03, 0.1])
def test_its_error_knows_of_theirs(levels: list[float], mismatch: float) -> None:
    camera = cameras(mismatch)
    found = calibrate_step(bench(camera, levels), fresh=True)
    for name in ("on", "off"):
        true = float(np.std(getattr(camera, f"theta_{name}")))
        sigma, error = (float(getattr(s, f"sigma_{name}"))
                        for s in (found.summary, found.summary_std))
        assert abs(sigma - true) < 3 * error
        assert error < 0.01
        if mismatch > 0.02:
            assert sigma == pytest.approx(true, rel=0.05)


def test_of_many_pixels_it_stays() -> None:
    """What is known of the pixels' errors does not get better with their number."""
    rng, errors = np.random.default_rng(0), []
    for count in (1000, 100_000):
        theta = 0.3 + np.hypot(0.02, 0.02) * rng.standard_normal(count)
        (median, _), (spread, error) = camera_wide(theta, np.full(count, 0.02))
        assert median == pytest.approx(0.3, abs=0.005)
        assert abs(spread - 0.02) < 2 * error
        errors.append(error)
    assert errors[1] > 0.8 * errors[0]

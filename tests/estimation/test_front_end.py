"""What is measured of a recording before anything else is read."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from evflow.estimation.front_end import find_front_end
from evflow.estimation.refine import Stretch
from evflow.types import Events, Recording


def test_the_exposure_is_the_mean_of_the_stretches() -> None:
    """Recordings of one camera may be exposed differently, or not tell it."""
    shape, times = (24, 32), 25_000 * np.arange(3)
    frames = np.random.default_rng(0).integers(60, 200, (3, *shape)).astype(np.uint8)
    untold = Recording(Events([], [], [], [], shape[::-1]), frames, times)
    told = dataclasses.replace(untold, exposure_us=20_000)
    for recordings, expected in (((told,), 0.02), ((untold,), 0.0), ((told, untold), 0.01)):
        stretches = [Stretch(recording, (0, 1), ()) for recording in recordings]
        assert find_front_end(stretches, measured=False).blur_s == pytest.approx(expected)

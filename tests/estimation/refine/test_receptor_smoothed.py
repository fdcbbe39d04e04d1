"""A path with frames' noise, in which a low-pass and a delay that takes its lag back explain more
than an ideal pixel."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.samples import looked_at

from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.refine.receptor_search import find
from evflow.estimation.refine.receptor_smoothed import smoothed


def noisy(data: Sample, noise_dn: float, steps: int = 8) -> Sample:
    """Noise drawn anew every few fine steps, as it passes a pixel with what moves."""
    rng = np.random.default_rng(0)
    dn = np.asarray(data.dn)
    at, drawn = np.arange(dn.shape[1]), rng.normal(0.0, noise_dn, dn[:, ::steps].shape)
    before = drawn[:, at // steps]
    after = drawn[:, np.minimum(at // steps + 1, drawn.shape[1] - 1)]
    part = (at % steps / steps)[:, None]
    return data._replace(dn=(dn + before + part * (after - before)).astype(np.float32))


def test_noise_of_frames_is_no_delay() -> None:
    data = noisy(looked_at(0.0, 0.0), 5.0)
    taken, found = find(data), find(smoothed(data))
    assert taken.needed
    assert taken.seen.delay_s < -3 * taken.std[2]
    assert taken.seen.tau_s > 3 * taken.std[1]
    assert abs(found.seen.delay_s) < found.std[2]
    assert found.seen.tau_s < found.std[1]
    assert found.explained[0] > taken.explained[0]


@pytest.mark.parametrize("cutoff_hz", [300.0, 60.0])
def test_a_slow_pixel_is_found_behind_it(cutoff_hz: float) -> None:
    found = find(smoothed(noisy(looked_at(0.0, cutoff_hz), 3.0)))
    assert found.needed
    assert abs(found.seen.delay_s) < found.std[2]
    assert found.seen.cutoff_hz == pytest.approx(cutoff_hz, rel=0.15)


@pytest.mark.parametrize("cutoff_hz", [0.0, 60.0])
def test_without_noise_the_path_stays_as_it_is(cutoff_hz: float) -> None:
    data = looked_at(0.0, cutoff_hz)
    assert smoothed(data) is data

"""DVS-Voltmeter's constants, from events and noise made with constants that are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from evflow.baselines.noise_forms import voltmeter_noise
from evflow.baselines.voltmeter_fit import measured_constants, passage_rates, regressed
from evflow.camera.sensors import Voltmeter
from evflow.estimation.refine.receptor_data import Sample
from evflow.estimation.shot import LIGHTS

NOISY = Voltmeter(5.0, 26.0, 8e-3, 4e-8, 1e-9, 5e-5)
DN = np.clip((np.arange(LIGHTS) + 0.5) / LIGHTS * 275.0 - 20.0, 1.0, 255.0)


def crossed(theta_on: float, theta_off: float, k2: float, pixels: int = 48) -> Sample:
    """Events of pixels that send one whenever log(L + k2) has changed by a threshold."""
    steps = 700
    rng = np.random.default_rng(0)
    logs = np.log(rng.uniform(4.0, 60.0, pixels)) + np.concatenate(
        [np.zeros((1, pixels)), np.cumsum(0.025 * rng.standard_normal((steps, pixels)), 0)])
    dn = np.exp(np.clip(logs, 0.5, 5.4))
    memory, counts, rows = np.log(dn[0] + k2), np.zeros((2, pixels)), []
    for t in range(1, steps + 1):
        here = np.log(dn[t] + k2)
        for sign, side, theta in ((1.0, 0, theta_on), (-1.0, 1, theta_off)):
            fires = sign * (here - memory) >= theta
            memory = np.where(fires, here, memory)  # at a step, where brightness is known
            counts[side] += fires
            rows += [(p, t, counts[0, p], -counts[1, p]) for p in np.flatnonzero(fires)]
    pixel, at, on, off = np.array(rows, np.float64).T
    own = pixel.astype(int)
    fields = (dn, np.full(steps, 1e-3), own, at, on, off, np.ones(len(pixel)), own,
              np.zeros(pixels, int), np.zeros(2), np.float32(1e-3 * steps * pixels))
    return Sample(*(v[None] for v in fields))


def rested(constants: Voltmeter, seconds: float) -> np.ndarray:
    """Noise by light (2, 3, LIGHTS) of pixels at rest, as many events as are expected."""
    rates = np.stack([np.asarray(r) for r in voltmeter_noise(
        DN.astype(np.float32), constants=constants)])
    watched = np.full_like(rates, seconds)
    return np.stack([rates * watched, watched, watched], 1)


def test_drift_and_diffusion_are_those_of_the_noise_s_rates() -> None:
    rates = np.stack([np.asarray(r, np.float64) * 1e-6 for r in voltmeter_noise(
        DN.astype(np.float32), constants=NOISY)])
    drift, sigma = passage_rates(rates)
    np.testing.assert_allclose(drift, NOISY.k4 + NOISY.k5 * DN, rtol=1e-3)
    diffusion = NOISY.k3 * np.sqrt(DN) / (DN + NOISY.k2) + NOISY.k6
    np.testing.assert_allclose(sigma, diffusion, rtol=1e-3)


@pytest.mark.parametrize("k2", [10.0, 42.0])
def test_all_six_constants_are_found_where_the_recording_tells_them(k2: float) -> None:
    true = dataclasses.replace(NOISY, k2=k2)
    found = measured_constants(crossed(0.2, 0.2, k2), rested(true, 4000.0))
    assert found.undetermined == ()
    assert found.voltmeter.k2 == k2
    for name in ("k1", "k3", "k4", "k5", "k6"):
        assert getattr(found.voltmeter, name) == pytest.approx(getattr(true, name), rel=0.15)


def test_what_the_recording_does_not_tell_is_said() -> None:
    data = crossed(0.2, 0.2, 26.0)
    few = measured_constants(data, rested(NOISY, 1.0))
    assert few.undetermined == ("k3", "k4", "k5", "k6")
    assert few.voltmeter.k3 == few.voltmeter.k5 == 0
    none = measured_constants(data, np.zeros((2, 3, LIGHTS)))  # nothing was quiet
    assert none.undetermined == few.undetermined
    assert none.voltmeter.k4 == none.voltmeter.k6 == 0
    one_light = rested(NOISY, 4000.0) * (np.arange(LIGHTS) == 3)
    assert measured_constants(data, one_light).undetermined == ("k3", "k5")
    bright = data._replace(dn=data.dn + 1e4)  # where log(L + k2) is the same for all k2
    assert "k2" in measured_constants(bright, rested(NOISY, 1.0)).undetermined


def test_thresholds_of_both_polarities_are_told_apart_unless_tied() -> None:
    data = crossed(0.2, 0.3, 0.255)
    theta, left = regressed(data, 0.255, tied=False)
    np.testing.assert_allclose(theta, (0.2, 0.3), rtol=0.12)
    assert left < 0.02
    one, more = regressed(data, 0.255, tied=True)
    assert one[0] == one[1]
    assert 0.2 < one[0] < 0.3
    assert left < 0.5 * more

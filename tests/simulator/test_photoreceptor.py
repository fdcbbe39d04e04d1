"""A photoreceptor in front of a simulation: frames as an ideal pixel would see them."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import to_log
from evflow.simulator.photoreceptor import (
    IDEAL,
    Photoreceptor,
    as_measured,
    seen_frames,
    seen_log,
)

KNEE = np.log(20) / 20


def lin_log(dn: np.ndarray) -> np.ndarray:
    return np.where(dn <= 20, dn * KNEE, np.log(np.maximum(dn, 1)))


def flash(count: int, step_us: int) -> list[tuple[np.ndarray, int]]:
    """A dark, then a bright, field from frame 1 on."""
    return [(np.full((2, 3), 40.0 if i == 0 else 160.0), i * step_us) for i in range(count)]


def test_an_ideal_one_changes_nothing() -> None:
    pairs = flash(3, 1000)
    assert all(a is b for a, b in zip(seen_frames(pairs, IDEAL), pairs, strict=True))


@pytest.mark.parametrize("step_us", [100, 4000])
def test_a_step_of_light_is_followed_exponentially(step_us: int) -> None:
    """After the step's own ramp, whatever the frames' distance: the rest decays by the rate of
    the new light."""
    seen_by = Photoreceptor(tau_s=5e-3)
    made = list(seen_frames(flash(6, step_us), seen_by))
    rest = lin_log(np.array(160.0)) - np.array([lin_log(f[0, 0]) for f, _ in made[1:]])
    decay = np.exp(-(180 / 275) / 5e-3 * step_us * 1e-6)
    np.testing.assert_allclose(rest[1:] / rest[:-1], decay, rtol=2e-3)
    assert [t for _, t in made] == [step_us * i for i in range(6)]


def test_light_that_is_added_lowers_contrast_and_stays_within_8_bits() -> None:
    dn = np.array([[0.0, 10.0, 100.0, 255.0]])
    (seen, t), = seen_frames([(dn, 50)], Photoreceptor(offset_dn=24.0, delay_s=1e-3))
    assert t == 1050
    assert seen.min() >= 0
    assert seen.max() <= 255
    np.testing.assert_allclose(np.diff(lin_log(seen)), np.diff(np.log(dn + 24)), atol=2e-5)


def test_of_another_logarithm_frames_have_the_light_in_that_one() -> None:
    """So the circuit behind, whose logarithm it is, sees log(L + offset) in the dark too."""
    dn = np.array([[0.0, 3.0, 40.0, 255.0]])
    (seen, _), = seen_frames([(dn, 50)], Photoreceptor(offset_dn=6.0, log_map="log_eps"))
    signal = to_log(seen.astype(np.float32), "log_eps")
    np.testing.assert_allclose(np.diff(signal), np.diff(np.log(dn + 6.255)), atol=2e-5)
    (same, _), = seen_frames([(dn, 50)], Photoreceptor(log_map="log_eps"))
    assert same is dn


def test_it_is_that_of_a_measured_camera() -> None:
    measured = Photoreceptor.of(SensorModel(cutoff_hz=100.0), Optics(offset_dn=7.0, delay_s=2e-3))
    assert measured.cutoff_hz == pytest.approx(100.0)
    assert (measured.offset_dn, measured.delay_s) == (7.0, 2e-3)
    assert Photoreceptor.of(SensorModel(), Optics()).ideal
    assert Photoreceptor.of(SensorModel(log_map="log_eps"), Optics()).logarithmic


@pytest.mark.parametrize("offset_dn", [0.0, 12.0])
@pytest.mark.parametrize("sensor", [
    SensorModel(cutoff_hz=80.0, leak_hz=0.1), SensorModel(cutoff_hz=40.0, cutoff_by_light=False),
    SensorModel(cutoff_hz=100.0, log_map="log_eps"), SensorModel(refractory_s=1e-3)])
def test_on_the_device_frames_are_seen_as_on_the_host(
    sensor: SensorModel, offset_dn: float
) -> None:
    frames = np.random.default_rng(1).uniform(0, 255, (9, 4, 5)).astype(np.float32)
    made, circuit = seen_log(frames, 2e-3, sensor, offset_dn)
    seen_by, behind = as_measured(sensor, Optics(offset_dn))
    pairs = [(frame, 2000 * i) for i, frame in enumerate(frames)]
    wanted = to_log(np.stack([frame for frame, _ in seen_frames(pairs, seen_by)]), sensor.log_map)
    np.testing.assert_allclose(made, wanted, atol=2e-5)
    assert circuit == behind
    assert not circuit.cutoff_hz


def test_traced_numbers_are_those_that_are_known() -> None:
    frames = np.random.default_rng(0).uniform(20, 200, (6, 4, 4)).astype(np.float32)

    def seen(cutoff_hz: Any, offset_dn: Any) -> Any:
        return seen_log(frames, 1e-3, SensorModel(cutoff_hz=cutoff_hz), offset_dn)[0]

    given = np.array([[30.0, 0.0], [0.0, 0.0], [80.0, 12.0], [0.0, 5.0]])
    alone = [seen(*pair) for pair in given.tolist()]
    np.testing.assert_allclose(jax.vmap(seen)(*given.T), alone, atol=1e-5)
    slope = jax.grad(lambda c, o: seen(c, o)[-1].sum(), (0, 1))
    np.testing.assert_allclose(jax.jit(slope)(60.0, 3.0), slope(60.0, 3.0), rtol=1e-4)
    assert np.isfinite(jax.jit(slope)(0.0, 0.0)).all()

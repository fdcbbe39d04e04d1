"""A map of pixels is no worse than the camera's summary, nor than what was measured."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.camera import Camera, Summary
from evflow.network.coordinates import unsquash, unsquash_summary
from evflow.network.posterior import Evidence, evidence, posterior

THETA, SCALE = 0.3, 0.6


def joined(theta: jax.Array, width: float, sigma: float, *, windows: int = 1) -> tuple[
        Camera, Camera]:
    """The posterior of thresholds measured with a width, of a camera of THETA and a mismatch."""
    known = Summary(*(jnp.float32(v) for v in (THETA, THETA, 0.1, 0.1, sigma, sigma)))
    y6 = unsquash_summary(known)[None]
    y = unsquash(Camera(theta, theta, jnp.full_like(theta, 0.1), jnp.full_like(theta, 0.1)))
    said = evidence(y, jnp.broadcast_to(width / SCALE / theta[:, None], y.shape))
    return posterior(sum([said] * (windows - 1), said), y6, jnp.zeros((1, 6)))


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.03, 0.15])
@pytest.mark.parametrize("width", [0.002, 0.03, 0.1])
def test_it_is_better_than_the_summary_and_the_measurement(sigma: float, width: float) -> None:
    rng = np.random.default_rng(0)
    true = np.maximum(rng.normal(THETA, sigma, 20_000), 0.02).astype(np.float32)
    seen = np.maximum(true + rng.normal(0, width, true.size), 0.01).astype(np.float32)
    camera, std = joined(jnp.asarray(seen), width, sigma)
    errors = [np.abs(guess - true).mean() for guess in (np.asarray(camera.theta_on), seen, THETA)]
    assert errors[0] < 1.01 * min(errors[1:]) + 1e-6
    by_hand = THETA + sigma**2 / (sigma**2 + width**2) * (seen - THETA)
    np.testing.assert_allclose(camera.theta_off, by_hand, atol=2e-4)
    np.testing.assert_allclose(std.theta_on, min(sigma, width), rtol=1e-3, atol=1e-5)


def test_windows_add_up() -> None:
    seen = jnp.array([0.36, 0.24])
    camera, _ = joined(seen, 0.04, 0.04, windows=4)
    np.testing.assert_allclose(camera.theta_on, THETA + 0.8 * (seen - THETA), rtol=1e-4)


def test_a_pixel_that_says_nothing_is_as_its_camera() -> None:
    y6 = unsquash_summary(Summary(*(jnp.float32(v) for v in (0.2, 0.3, 0.1, 0.2, 0.03, 0.05))))
    nothing = Evidence(jnp.zeros((1, 4)), jnp.zeros((1, 4)))
    camera, std = posterior(nothing, y6[None], jnp.zeros((1, 6)))
    np.testing.assert_allclose([camera.theta_on[0], camera.eta_off[0]], [0.2, 0.2], rtol=1e-5)
    np.testing.assert_allclose([std.theta_on[0], std.theta_off[0], std.eta_off[0]],
                               [0.03, 0.05, 0.06], rtol=1e-4)


def test_a_hot_pixel_stays_hot() -> None:
    y6 = unsquash_summary(Summary(*(jnp.float32(v) for v in (0.2, 0.2, 0.1, 0.1, 0.03, 0.03))))
    eta = jnp.array([30.0, 0.12])
    y = unsquash(Camera(jnp.full(2, 0.2), jnp.full(2, 0.2), eta, eta))
    camera, _ = posterior(evidence(y, jnp.full((2, 4), 0.6)), y6[None], jnp.zeros((1, 6)))
    assert float(camera.eta_on[0]) > 20
    assert float(camera.eta_on[1]) == pytest.approx(0.1 * 1.2**0.2, rel=0.01)


def test_of_a_camera_whose_pixels_are_alike_gradients_are_numbers() -> None:
    def width(sigma: jax.Array) -> jax.Array:
        values = (jnp.float32(v) for v in (0.2, 0.3, 0.1, 0.2))
        y6 = unsquash_summary(Summary(*values, sigma, sigma))
        said = Evidence(jnp.ones((1, 4)), jnp.ones((1, 4)))
        return posterior(said, y6[None], jnp.zeros((1, 6)))[1].theta_on.sum()

    assert np.isfinite(jax.jit(jax.grad(width))(jnp.float32(0.0)))

"""Cameras drawn from an estimate, and compared: what JAX's transformations ask of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera


def test_errors_that_pixels_share_entirely_have_finite_gradients() -> None:
    camera = Camera.constant((3, 4), 0.2, 0.25, 0.1, 0.1)
    std = jax.tree.map(lambda m: 0.04 * m, camera)

    def drawn(camera: Camera, std: Camera) -> jax.Array:
        return camera.drawn(jax.random.key(0), std, {"theta_on": 0.05}).theta_on.sum()

    for slope in jax.grad(drawn, (0, 1))(camera, std):
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slope))
    once = camera.drawn(jax.random.key(0), std, {"theta_on": 0.05}).theta_on
    np.testing.assert_allclose(once, once[0, 0], rtol=1e-6)  # nothing is left to single pixels


def test_cameras_are_equal_to_themselves_and_can_be_keys() -> None:
    one, other = Camera.constant((2, 2)), Camera.constant((2, 2))
    assert one == one
    assert one != other
    assert {one: "a"}[one] == "a"

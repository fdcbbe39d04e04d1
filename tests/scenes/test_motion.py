"""Optical flow of scenes: exact where it is known, and it warps the next frame back."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.scenes import Layer, Scene, SceneConfig, Trajectory, make_bank, render, sample_scene
from evflow.scenes.motion import optical_flow


@functools.cache
def scenes(count: int = 8) -> list[tuple[Scene, tuple[int, int]]]:
    bank = make_bank(jax.random.key(0), 6, False, 96, 48)
    config = SceneConfig(static_fraction=0.0, speed_px_s=(40.0, 300.0))
    draw = jax.jit(sample_scene, static_argnames=("config", "shape"))
    return [(draw(k, bank, config, (72, 96)), (72, 96))
            for k in jax.random.split(jax.random.key(3), count)]


def warp(frame: np.ndarray, flow: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: frame.shape[0], : frame.shape[1]].astype(np.float32)
    return cv2.remap(frame, x + flow[0], y + flow[1], cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE)


def test_flow_warps_the_next_frame_back() -> None:
    """Errors in DN, over all scenes: small where a point stays visible and least for this flow."""
    errors = {scale: 0.0 for scale in (0.0, 0.9, 1.0, 1.1)}
    seen, hidden = [], []
    for scene, shape in scenes():
        frames = np.asarray(render(scene, jnp.array([-0.01, 0.015]), shape))
        flow, visible = map(np.asarray, optical_flow(scene, -0.01, 0.015, shape))
        assert 0.6 < visible.mean() < 1.0
        for scale in errors:
            errors[scale] += np.abs(warp(frames[1], scale * flow) - frames[0])[visible].mean()
        wrong = np.abs(warp(frames[1], flow) - frames[0])
        seen.append(np.median(wrong[visible]))
        hidden.append(wrong[~visible].mean())
    assert errors[1.0] < 0.2 * errors[0.0]
    assert errors[1.0] < 0.8 * min(errors[0.9], errors[1.1])
    assert max(seen) < 2.5
    assert np.mean(hidden) > 5 * errors[1.0] / len(seen)


def test_flow_there_and_back_cancels() -> None:
    """Flows of a background are affine, which bilinear sampling reproduces."""
    for scene, shape in scenes():
        bare = dataclasses.replace(scene, opacity=jnp.zeros_like(scene.opacity))
        there, inside = map(np.asarray, optical_flow(bare, -0.01, 0.015, shape))
        back, _ = optical_flow(bare, 0.015, -0.01, shape)
        returned = np.stack([warp(plane, there) for plane in np.asarray(back)])
        assert np.abs(there).max() > 0.5
        # cv2.remap samples at 1/32 px.
        assert np.abs(returned + there)[:, inside].max() < 0.01 + 0.03 * np.ptp(there) / 72


def moving(x: float, speed: float) -> Trajectory:
    zero = jnp.float32(0.0)
    return Trajectory(jnp.array([x, 12.0]), jnp.array([speed, 0.0]), zero, zero, zero,
                      jnp.zeros(2), zero, zero)


def square(x: float, speed: float) -> Scene:
    """A square of 9 px over a still background of a 24 x 32 frame."""
    half, one = jnp.float32(0.5), jnp.float32(1.0)
    planes = jnp.ones((2, 11, 11)).at[1].set(jnp.pad(jnp.ones((9, 9)), 1))
    back = Layer(jnp.zeros((1, 16, 16)), jnp.array([8.0, 8.0]), one, half, one, moving(0.0, 0.0))
    fore = Layer(planes, jnp.array([5.0, 5.0]), one, half, one, moving(x, speed))
    return Scene(back, jax.tree.map(lambda leaf: leaf[None], fore), jnp.array([6.0]),
                 jnp.ones(1), one)


def test_flow_of_a_square_and_what_it_hides() -> None:
    flow, visible = map(np.asarray, optical_flow(square(10.0, 300.0), 0.0, 0.02, (24, 32)))
    inside = np.zeros((24, 32), bool)
    inside[8:17, 6:15] = True
    np.testing.assert_allclose(flow[0], np.where(inside, 6.0, 0.0), atol=1e-5)
    np.testing.assert_allclose(flow[1], 0.0, atol=1e-5)
    covered = np.zeros((24, 32), bool)
    covered[8:17, 12:21] = True
    np.testing.assert_array_equal(visible, inside | ~covered)


def test_flow_of_what_leaves_the_frame_goes_on() -> None:
    """The renderer lets it come in on the far side; its points did not fly there."""
    scene = square(28.0, 400.0)
    flow, visible = map(np.asarray, optical_flow(scene, 0.0, 0.05, (24, 32)))
    assert flow[0, 12, 28] == pytest.approx(20.0, abs=1e-4)
    assert not visible[12, 28]
    assert visible[12, 5]
    np.testing.assert_allclose(np.unique(flow[0].round(3)), [0.0, 20.0])

"""Rendering: motion is exact, cut-outs cover by their alpha, frames are pure functions."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.scenery import SHAPE, TIMES, bank, draw, pair, path, plain_scene, show

from evflow.errors import EvflowDataError
from evflow.scenes import Layer, SceneConfig, render, sample_scene


def test_at_rest_the_texture_itself_is_seen() -> None:
    texture = bank().backgrounds[0]
    frame = pair(plain_scene(texture, path((20.0, 20.0))))[0]
    np.testing.assert_allclose(frame, 255 * texture[:24, :32], atol=2e-3)


def test_zooming_reproduces_bilinear_interpolation() -> None:
    texture = bank().backgrounds[1]
    frame = pair(plain_scene(texture, path((20.0, 20.0)), zoom=0.5))[0]
    v, u = jnp.meshgrid(10 + 0.5 * jnp.arange(24), 10 + 0.5 * jnp.arange(32), indexing="ij")
    expected = jax.scipy.ndimage.map_coordinates(texture, [v, u], order=1)
    np.testing.assert_allclose(frame, 255 * expected, atol=2e-3)


@pytest.mark.parametrize(("zoom", "angle"), [(1.0, 0.0), (0.7, 0.4), (1.9, -2.0)])
def test_a_pixel_of_translation_shifts_the_image(zoom: float, angle: float) -> None:
    moving = path((20.0, 20.0), velocity=(100.0, -200.0), angle=angle)
    before, after = pair(plain_scene(bank().backgrounds[2], moving, zoom), 0.0, 0.01)
    np.testing.assert_allclose(after[:-2, 1:], before[2:, :-1], atol=2e-2)


def test_a_quarter_turn_turns_the_image() -> None:
    """Positive spin carries what lies at +x to +y, clockwise on screen."""
    turning = path((11.0, 11.0), spin=math.pi / 2)
    before, after = pair(plain_scene(bank().backgrounds[3], turning), 0.0, 1.0)
    np.testing.assert_allclose(after[:23, :23], np.rot90(before[:23, :23], -1), atol=2e-2)


def test_growing_is_zooming_in() -> None:
    texture, t = bank().backgrounds[4], 0.5
    growing = plain_scene(texture, path((16.0, 12.0), scale_rate=0.4))
    still = plain_scene(texture, path((16.0, 12.0)), zoom=math.exp(-0.4 * t))
    np.testing.assert_allclose(pair(growing, t)[0], pair(still)[0], atol=2e-2)


def test_sub_pixel_motion_is_smooth() -> None:
    """Steps of 1/20 px over two pixels: each changes the image by about as much."""
    moving = path((20.0, 20.0), velocity=(50.0, 0.0))
    scene = plain_scene(bank().backgrounds[5], moving)
    steps = [np.abs(np.diff(pair(scene, k * 1e-3, (k + 1) * 1e-3), axis=0)).mean()
             for k in range(40)]
    assert max(steps) < 1.5 * np.mean(steps)
    assert min(steps) > 0.5 * np.mean(steps)


def test_a_cutout_covers_by_its_alpha() -> None:
    """Over a background of .2: opaque where alpha is 1, the mean where it is a half."""
    value, alpha = jnp.full((9, 9), 0.8), jnp.zeros((9, 9))
    alpha = alpha.at[1:8, 1:8].set(0.5).at[3:6, 3:6].set(1.0)
    scene = plain_scene(jnp.full((64, 64), 0.2), path((20.0, 20.0)),
                        cutout=jnp.stack([value, alpha]))
    frame = pair(scene)[0] / 255
    assert float(frame[12, 16]) == pytest.approx(0.8, abs=1e-4)
    assert float(frame[12, 18]) == pytest.approx(0.5, abs=1e-4)
    assert float(frame[2, 2]) == pytest.approx(0.2, abs=1e-4)
    absent = dataclasses.replace(scene, opacity=jnp.zeros(1))
    np.testing.assert_allclose(pair(absent), 51.0, atol=1e-2)


def test_frames_are_finite_within_range_and_of_many_brightnesses() -> None:
    frames = np.asarray(show(draw(4), 40 * TIMES))
    assert frames.shape == (64, 6, *SHAPE)
    assert frames.dtype == np.float32
    assert np.isfinite(frames).all()
    assert 0.0 <= frames.min() <= frames.max() <= 255.0
    mean, contrast = frames.mean((1, 2, 3)), frames.std((2, 3)).mean(1)
    assert mean.min() < 60 < 190 < mean.max()
    assert contrast.min() < 15 < 60 < contrast.max()


def test_excessive_contrast_clips_and_does_not_overflow() -> None:
    scenes = draw(4)
    loud = dataclasses.replace(scenes.background, contrast=4 * scenes.background.contrast)
    frames = np.asarray(show(dataclasses.replace(scenes, background=loud), TIMES))
    assert np.isfinite(frames).all()
    assert frames.min() >= 0.0
    assert frames.max() == 255.0
    assert (frames == 255.0).mean() > 0.01


def test_a_frame_depends_on_its_own_time_alone() -> None:
    scenes, order = draw(6), jnp.array([3, 1, 5, 5, 1, 3])
    frames = show(scenes, TIMES)
    np.testing.assert_array_equal(show(scenes, TIMES[order]), frames[:, order])


def test_a_batch_is_a_loop() -> None:
    """Up to rounding: fused differently, a coordinate moves by an ulp, 2e-5 texels."""
    scenes = draw(7)
    frames = show(scenes, TIMES)
    for n in range(6):
        one = render(jax.tree.map(lambda leaf, n=n: leaf[n], scenes), TIMES, SHAPE)
        np.testing.assert_allclose(frames[n], one, atol=1e-2)


def test_scenes_are_functions_of_key_bank_and_config() -> None:
    one, again, other = draw(8), draw(8), draw(9)
    jax.tree.map(np.testing.assert_array_equal, one, again)
    assert not np.array_equal(one.background.path.velocity, other.background.path.velocity)
    key = jax.random.split(jax.random.key(8), 64)[2]
    alone = jax.jit(lambda key, bank: sample_scene(key, bank, SceneConfig(), SHAPE))(key, bank())
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b[2], rtol=1e-5, atol=1e-5), alone, one)


def test_change_grows_with_speed() -> None:
    scenes = draw(10)

    def at_speed(layer: Layer, speed: float) -> Layer:
        velocity = np.asarray(layer.path.velocity)
        heading = velocity / np.maximum(np.linalg.norm(velocity, axis=-1, keepdims=True), 1e-6)
        zero = np.zeros_like(layer.path.spin)
        return dataclasses.replace(layer, path=dataclasses.replace(
            layer.path, velocity=np.float32(speed) * heading, spin=zero, scale_rate=zero,
            shake=0 * heading))

    def change(speed: float) -> float:
        layers = {name: at_speed(getattr(scenes, name), speed)
                  for name in ("background", "foregrounds")}
        frames = show(dataclasses.replace(scenes, **layers), jnp.arange(6) * 1e-3)
        return float(np.abs(np.diff(frames, axis=1)).mean())

    slow, middle, fast = (change(speed) for speed in (4.0, 40.0, 400.0))
    assert 8 < middle / slow < 12  # in proportion, while steps are far below a pixel
    assert 4 < fast / middle < 12


def test_other_sizes_and_no_foregrounds() -> None:
    bare = draw(0, SceneConfig(foregrounds=0), (12, 60))
    frames = show(bare, TIMES, (12, 60))
    assert frames.shape == (64, 6, 12, 60)
    assert jnp.isfinite(frames).all()
    with pytest.raises(EvflowDataError, match="EV002"):
        render(jax.tree.map(lambda leaf: leaf[0], bare), jnp.float32(0.0), (12, 60))


def test_gradients_through_the_renderer_match_differences() -> None:
    """d mean DN / d velocity at t = 1 s, by autodiff and by central differences."""
    texture = bank().backgrounds[5]

    def at(speed: jax.Array) -> jax.Array:
        start = path((20.3, 20.3), angle=0.2)
        moving = dataclasses.replace(start, velocity=jnp.stack([speed, speed]))
        return pair(plain_scene(texture, moving), 0.0, 1.0)[1, 5:15, 5:25].mean()

    slope = float(jax.grad(at)(jnp.float32(0.0)))
    rise = float((at(jnp.float32(0.02)) - at(jnp.float32(-0.02))) / 0.04)
    assert abs(rise) > 0.1
    assert slope == pytest.approx(rise, rel=0.1)

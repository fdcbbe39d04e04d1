"""Scenes: textures and masks keep their contracts, motion is exact, rendering is pure."""

from __future__ import annotations

import dataclasses
import functools
import math
import socket
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.errors import EvflowDataError
from evflow.scenes import (
    Layer,
    Scene,
    SceneConfig,
    TextureBank,
    Trajectory,
    load_photos,
    make_bank,
    render,
    sample_scene,
)
from evflow.scenes.photos import crop
from evflow.scenes.textures import cutout_mask, finish
from evflow.scenes.trajectory import SCALE_LIMIT, Pose, mirror, pose, recycle

SHAPE = (24, 32)
TIMES = jnp.linspace(-0.05, 0.05, 6)
finish_texture = jax.jit(finish)


@functools.cache
def bank() -> TextureBank:
    """12 procedural and 16 photographic textures, drawn once."""
    return small_bank(jax.random.key(0))


def small_bank(key: jax.Array, procedural: int = 12, photos: Any = True) -> TextureBank:
    return make_bank(key, procedural, photos, size=64, cutout_size=64, crops=1)


@functools.partial(jax.jit, static_argnames=("config", "shape"))
def _draw(keys: jax.Array, bank: TextureBank, config: SceneConfig, shape: tuple[int, int]) -> Scene:
    return jax.vmap(lambda key: sample_scene(key, bank, config, shape))(keys)


def draw(seed: int, config: SceneConfig | None = None, shape: tuple[int, int] = SHAPE) -> Scene:
    """64 scenes on a leading axis. Few configs are used: each compiles anew, a second or so."""
    return _draw(jax.random.split(jax.random.key(seed), 64), bank(), config or SceneConfig(), shape)


@functools.partial(jax.jit, static_argnames="shape")
def show(scenes: Scene, times: jax.Array, shape: tuple[int, int] = SHAPE) -> jax.Array:
    """Frames (N, T, H, W) of a batch of scenes."""
    return jax.vmap(lambda s: render(s, times, shape))(scenes)


def pair(scene: Scene, first: float = 0.0, second: float = 0.0) -> jax.Array:
    """Two frames (2, H, W) of one scene: the same program for every test."""
    return render(scene, jnp.array([first, second]), SHAPE)


def path(position: tuple[float, float], **motion: Any) -> Trajectory:
    """A trajectory at rest, but for `motion`."""
    rest = dict.fromkeys(("angle", "spin", "scale_rate", "shake_hz", "shake_phase"), 0.0)
    rest |= {"velocity": (0.0, 0.0), "shake": (0.0, 0.0)} | motion
    return Trajectory(jnp.array(position), **{k: jnp.array(v) for k, v in rest.items()})


def plain_scene(texture: jax.Array, trajectory: Trajectory, zoom: float = 1.0,
                cutout: jax.Array | None = None) -> Scene:
    """A background anchored at its texel (20, 20), and maybe one resting cut-out (2, S, S) at
    pixel (16, 12); contrast 1 and gamma 1, so that DN = 255 value."""
    one, half = jnp.float32(1.0), jnp.float32(0.5)
    back = Layer(texture[None], jnp.array([20.0, 20.0]), jnp.float32(zoom), half, one, trajectory)
    planes = jnp.zeros((2, 9, 9)) if cutout is None else cutout
    middle = jnp.full((2,), (planes.shape[-1] - 1) / 2, jnp.float32)
    fore = Layer(planes, middle, one, half, one, path((16.0, 12.0)))
    fores = jax.tree.map(lambda leaf: leaf[None], fore)
    present = jnp.array([0.0 if cutout is None else 1.0])
    return Scene(back, fores, jnp.array([planes.shape[-1] / 2]), present, one)


# ---------------------------------------------------------------- textures, photographs, bank


def test_bank_values_shapes_and_dtypes() -> None:
    b = bank()
    assert b.backgrounds.shape == (28, 64, 64)
    assert b.cutouts.shape == (28, 2, 64, 64)
    assert b.diameter.shape == (28,)
    for leaf in (b.backgrounds, b.cutouts):
        assert leaf.dtype == jnp.float32
        assert jnp.isfinite(leaf).all()
        assert 0.0 <= float(leaf.min()) <= float(leaf.max()) <= 1.0
    assert float(jnp.median(b.backgrounds.std((1, 2)))) > 0.1  # textures, not grey cards


def test_bank_is_a_function_of_its_key() -> None:
    again, other = small_bank(jax.random.key(0)), small_bank(jax.random.key(1))
    for a, b, c in zip(*map(jax.tree.leaves, (bank(), again, other)), strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)


def test_textures_are_band_limited() -> None:
    """The finest octave keeps little: bilinear motion by half a texel then loses little energy."""
    white = np.random.default_rng(0).random((64, 64), dtype=np.float32)
    spectrum = np.abs(np.fft.rfft2(np.asarray(finish_texture(white)) - 0.5))
    low = spectrum[1:8, 1:8].mean()
    assert spectrum[30:34, :4].mean() / low < 0.25  # along one axis: 18 %
    assert spectrum[30:34, 30:].mean() / low < 0.08  # along both: 3 %


def test_a_nearly_uniform_picture_is_not_stretched_to_full_contrast() -> None:
    faint = 0.5 + 0.01 * np.random.default_rng(0).random((64, 64), dtype=np.float32)
    assert np.ptp(finish_texture(faint)) < 0.05


def test_masks_are_whole_soft_edged_and_of_their_diameter() -> None:
    size = 96
    alpha, diameter = jax.lax.map(
        lambda k: cutout_mask(k, size), jax.random.split(jax.random.key(2), 60))
    alpha, diameter = np.asarray(alpha), np.asarray(diameter)
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    radius = np.hypot(x, y)
    for mask, extent in zip(alpha, diameter, strict=True):
        assert mask.min() == 0.0
        assert mask.max() == 1.0
        assert max(mask[[0, -1]].max(), mask[:, [0, -1]].max()) == 0.0
        assert abs(radius[mask >= 0.5].max() - extent / 2) < 1.5
        soft = ((mask > 0) & (mask < 1)).sum()  # the edge: about one texel times the perimeter
        assert 0.5 * math.pi * extent * 0.25 < soft < 4 * math.pi * extent
    assert diameter.min() < 30 < 80 < diameter.max()


def test_photographs_come_from_the_installed_wheel_without_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("the network was touched")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    photos = load_photos()
    assert {"astronaut", "camera", "coffee"} <= photos.keys()
    for name, photo in photos.items():
        assert photo.dtype == np.float32, name
        assert photo.ndim == 2, name
        assert 0.0 <= photo.min() < photo.max() <= 1.0, name
    assert photos["astronaut"].shape == (512, 512)


def test_no_photographs_is_a_coded_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evflow.scenes.photos.FILES", ())
    with pytest.raises(EvflowDataError, match="EV016"):
        load_photos()


def test_an_upright_crop_is_the_photograph_itself() -> None:
    photo = np.random.default_rng(0).random((40, 50), dtype=np.float32)
    centre = (29.5 / 49, 19.5 / 39)  # the window then starts at column 14, row 4
    window = crop(photo, 32, centre, 1.0, 0.0, flip=False)
    np.testing.assert_allclose(window, photo[4:36, 14:46], atol=1e-5)
    flipped = crop(photo, 32, centre, 1.0, 0.0, flip=True)
    np.testing.assert_allclose(flipped, window[:, ::-1], atol=1e-5)


def test_own_photographs_make_a_bank_and_bad_ones_are_refused() -> None:
    image = np.random.default_rng(0).random((80, 70))
    assert small_bank(jax.random.key(0), 0, [image]).backgrounds.shape == (1, 64, 64)
    unfit = {"EV002": image[None], "EV003": (255 * image).astype(np.uint8),
             "EV007": np.where(image > 0.9, np.nan, image)}
    for code, bad in unfit.items():
        with pytest.raises(EvflowDataError, match=code):
            small_bank(jax.random.key(0), 0, [bad])
    for options in ({"procedural": 0, "photos": False}, {"size": 8}, {"crops": -1}):
        with pytest.raises(EvflowDataError, match="EV020"):
            make_bank(jax.random.key(0), **options)


# --------------------------------------------------------------------------------- trajectories


@given(st.floats(-1e3, 1e3), st.floats(0.5, 300))
@settings(max_examples=50, deadline=None)
def test_mirror_folds_into_its_interval_and_is_continuous(u: float, top: float) -> None:
    a, b = float(mirror(np.float32(u), top)), float(mirror(np.float32(u + 1e-2), top))
    assert -1e-3 <= a <= top + 1e-3
    assert abs(a - b) < 1.2e-2
    if 0 <= u <= top:
        assert abs(a - u) < 1e-3


def test_pose_is_the_stated_motion() -> None:
    moving = path((3.0, 4.0), velocity=(20.0, -10.0), angle=0.3, spin=0.5, scale_rate=0.2,
                  shake=(1.0, 2.0), shake_hz=5.0, shake_phase=0.7)
    for t in (-0.4, 0.0, 0.13, 1.0):
        swing = math.sin(2 * math.pi * 5 * t + 0.7)
        expected = (3 + 20 * t + swing, 4 - 10 * t + 2 * swing, 0.3 + 0.5 * t, math.exp(0.2 * t))
        np.testing.assert_allclose(pose(moving, jnp.float32(t)), expected, atol=2e-5)


def test_scale_stays_within_its_limit_for_ever() -> None:
    scales = jax.vmap(lambda t: pose(path((0.0, 0.0), scale_rate=0.3), t).scale)(
        jnp.linspace(-60.0, 60.0, 500))
    assert float(scales.max()) == pytest.approx(SCALE_LIMIT, rel=1e-2)
    assert float(scales.min()) == pytest.approx(1 / SCALE_LIMIT, rel=1e-2)


@given(st.floats(-500, 500), st.floats(2, 20))
@settings(max_examples=50, deadline=None)
def test_recycling_moves_only_what_is_out_of_sight(x: float, radius: float) -> None:
    zero = jnp.float32(0.0)
    at = recycle(Pose(jnp.float32(x), zero, zero, zero + 1), jnp.float32(radius), SHAPE)
    reach = SCALE_LIMIT * radius
    if -reach <= x <= SHAPE[1] - 1 + reach:
        assert float(at.x) == pytest.approx(x, abs=1e-3)
    assert -reach - 1.01 <= float(at.x) <= SHAPE[1] + reach + 0.01


def test_sampled_motion_keeps_to_the_config() -> None:
    config = SceneConfig(static_fraction=0.25)
    batches = [draw(n, config) for n in range(6)]
    scenes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *batches)
    speed = np.hypot(*np.moveaxis(scenes.foregrounds.path.velocity, -1, 0))
    still = (speed == 0).all(axis=1)
    assert 0.15 < still.mean() < 0.35
    moving = speed[~still]
    assert moving.min() >= 2 * 0.999
    assert moving.max() <= 350 * 1.001
    assert abs(np.log(moving).mean() - np.log(2 * 350) / 2) < 0.15  # log-uniform
    shake = np.hypot(*np.moveaxis(scenes.background.path.shake, -1, 0))
    assert (2 * np.pi * shake * scenes.background.path.shake_hz).max() <= 350 * 1.001
    assert 0.2 < (shake[~still] > 0).mean() < 0.4
    assert 0.65 < scenes.opacity.mean() < 0.85
    diameter = 2 * (scenes.radius - 1 / scenes.foregrounds.zoom) * 64 / min(SHAPE)
    assert 11.9 < diameter.min() <= diameter.max() < 50.1


def test_static_scenes_do_not_change_and_others_do() -> None:
    scenes = draw(0, SceneConfig(static_fraction=0.25))
    still = np.asarray(jnp.abs(scenes.background.path.velocity).sum(-1) == 0)
    change = np.asarray(jnp.ptp(show(scenes, TIMES), axis=1).max((1, 2)))
    assert still.any()
    assert (change[still] == 0).all()
    assert (change[~still] > 0.1).all()


def test_the_paper_preset_is_steady_similarity_motion() -> None:
    scenes = draw(3, SceneConfig.preset("paper"))
    for layer in (scenes.background, scenes.foregrounds):
        assert float(jnp.abs(layer.path.shake).max()) == 0.0
        assert float(jnp.abs(layer.path.velocity).sum(-1).min()) > 0.0
    assert float(scenes.opacity.min()) == 1.0
    with pytest.raises(EvflowDataError, match="EV020"):
        SceneConfig.preset("papyrus")  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [
    {"speed_px_s": (0.0, 10.0)}, {"zoom": (2.0, 1.0)}, {"static_fraction": 1.5},
    {"gamma": (0.5, math.inf)}, {"foregrounds": -1}, {"brightness": (0.0, 1.2)},
    {"shake_px": (-1.0, 2.0)},
])
def test_a_bad_config_is_a_coded_error(bad: dict[str, Any]) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        SceneConfig(**bad)


# ------------------------------------------------------------------------------------ rendering


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

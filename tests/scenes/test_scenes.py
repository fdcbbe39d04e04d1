"""Scenes: textures and masks keep their contracts, motion is as stated and drawn as configured."""

from __future__ import annotations

import math
import socket
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.scenery import SHAPE, TIMES, bank, draw, path, show, small_bank
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.errors import EvflowDataError
from evflow.scenes import SceneConfig, load_photos, make_bank
from evflow.scenes.photos import crop
from evflow.scenes.textures import cutout_mask, finish
from evflow.scenes.trajectory import SCALE_LIMIT, Pose, mirror, pose, recycle

finish_texture = jax.jit(finish)

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
    once, again, other = (small_bank(jax.random.key(seed)) for seed in (0, 0, 1))
    for a, b, c in zip(*map(jax.tree.leaves, (once, again, other)), strict=True):
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


def test_backgrounds_rest_behind_what_moves() -> None:
    config = SceneConfig(static_fraction=0.1, resting_fraction=0.4, shake_probability=1.0)
    batches = [draw(n, config) for n in range(6)]
    scenes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *batches)
    behind = np.hypot(*np.moveaxis(scenes.background.path.velocity, -1, 0)) == 0
    before = np.hypot(*np.moveaxis(scenes.foregrounds.path.velocity, -1, 0)).max(1) == 0
    assert 0.35 < behind.mean() < 0.65
    assert 0.03 < before.mean() < 0.2
    assert behind[before].all()
    for leaf in (scenes.background.path.shake, scenes.background.path.spin):
        assert not np.any(leaf[behind])
    # What is drawn else does not depend on it.
    plain = draw(0, SceneConfig(static_fraction=0.1, shake_probability=1.0))
    np.testing.assert_array_equal(batches[0].foregrounds.texture, plain.foregrounds.texture)
    np.testing.assert_array_equal(batches[0].gamma, plain.gamma)


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
    {"resting_fraction": -0.1},
    {"gamma": (0.5, math.inf)}, {"foregrounds": -1}, {"brightness": (0.0, 1.2)},
    {"shake_px": (-1.0, 2.0)},
])
def test_a_bad_config_is_a_coded_error(bad: dict[str, Any]) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        SceneConfig(**bad)


@pytest.mark.parametrize("field", [{"speed_px_s": 3.0}, {"zoom": [0.5, 1.0]}, {"foregrounds": 1.5}])
def test_settings_of_another_type_are_refused(field: dict[str, Any]) -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*SceneConfig"):
        SceneConfig(**field)

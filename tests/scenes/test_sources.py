"""Scenes of your own pictures: folders and objects cut out, as banks that render."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from helpers.scenery import square, write_coco
from helpers.sources import message
from helpers.videos import code_of

from evflow.scenes import (
    SceneConfig,
    TextureBank,
    coco_bank,
    folder_bank,
    join_banks,
    load_folder,
    read_coco,
    render,
    sample_scene,
)
from evflow.scenes.sources import cut_out

SIZES: dict[str, Any] = {"size": 48, "cutout_size": 48}


def test_missing_and_resized_images(tmp_path: Path) -> None:
    path = write_coco(tmp_path, [{"segmentation": [square(10, 12, 20)]}])
    key = jax.random.key(0)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((20, 30), np.uint8))
    assert code_of(lambda: coco_bank(key, path, **SIZES)) == "EV015"
    (tmp_path / "a.png").unlink()
    text = message(lambda: coco_bank(key, path, **SIZES))
    assert "EV016" in text
    assert "0 of 1 images" in text
    assert code_of(lambda: read_coco(path, tmp_path / "none")) == "EV016"


def test_a_cut_out_holds_the_object_and_nothing_behind_it() -> None:
    y, x = np.mgrid[:90, :120]
    mask = np.hypot(x - 70, y - 30) < 20.5
    picture = np.where(mask, 0.8, 0.1).astype(np.float32)
    for size, extent in ((96, 0.9), (96, 0.3), (32, 0.5)):
        planes, diameter = cut_out(picture, mask, size, extent)
        value, alpha = planes
        assert planes.dtype == np.float32
        assert diameter == pytest.approx(min(extent * size, 2 * 41), rel=0.05)
        np.testing.assert_allclose(value, 0.8, atol=1e-5)  # none of the .1 around it
        assert max(alpha[[0, -1]].max(), alpha[:, [0, -1]].max()) == 0.0
        v, u = np.mgrid[:size, :size] - (size - 1) / 2
        assert abs(np.hypot(u, v)[alpha >= 0.5].max() - diameter / 2) < 1.5
        assert alpha.sum() == pytest.approx(np.pi / 4 * diameter**2, rel=0.06)


def test_a_cut_out_keeps_its_shape_and_an_object_at_the_edge_is_not_mirrored() -> None:
    mask = np.zeros((50, 80), bool)
    mask[30:50, 60:80] = True  # in the corner
    picture = np.linspace(0, 1, 80, dtype=np.float32) * np.ones((50, 1), np.float32)
    (value, alpha), diameter = cut_out(picture, mask, 96)
    assert alpha.sum() == pytest.approx((diameter / np.hypot(20, 20) * 20) ** 2, rel=0.1)
    row = value[48][alpha[48] > 0.99]
    assert (np.diff(row[2:]) > 0).all()  # the outermost pixel repeats its inner neighbour
    assert row.min() > 60 / 80


def coco_folder(root: Path) -> Path:
    return write_coco(root, [
        {"segmentation": [square(10, 12, 20)]}, {"segmentation": [square(35, 2, 22)]},
        {"segmentation": [square(40, 30, 3)], "area": 9},
        {"segmentation": {"size": [40, 60], "counts": [0, 2400]}, "iscrowd": 1, "area": 2400}])


def test_a_coco_bank(tmp_path: Path) -> None:
    path, key = coco_folder(tmp_path), jax.random.key(0)
    bank = coco_bank(key, path, crops=3, **SIZES)
    assert bank.backgrounds.shape == (3, 48, 48)
    assert bank.cutouts.shape == (2, 2, 48, 48)  # neither the small one nor the crowd
    assert coco_bank(key, path, crowds=True, **SIZES).cutouts.shape[0] == 3
    assert coco_bank(key, path, min_area=1, **SIZES).cutouts.shape[0] == 3
    assert coco_bank(key, path, limit=1, **SIZES).cutouts.shape[0] == 1
    again, other = (coco_bank(k, read_coco(path), crops=3, **SIZES)
                    for k in (key, jax.random.key(1)))
    for a, b, c in zip(*map(jax.tree.leaves, (bank, again, other)), strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)
        assert a.dtype == np.float32
    assert code_of(lambda: coco_bank(key, path, min_area=1e5, **SIZES)) == "EV001"
    assert code_of(lambda: coco_bank(key, path, limit=0, **SIZES)) == "EV020"


def test_banks_of_a_folder_join_and_render(tmp_path: Path) -> None:
    path, key = coco_folder(tmp_path), jax.random.key(0)
    deep = np.random.default_rng(1).integers(0, 4096, (50, 70, 3), np.uint16)
    cv2.imwrite(str(tmp_path / "b.tif"), deep)
    pictures = load_folder(tmp_path)
    assert list(pictures) == ["a.png", "b.tif"]
    grey = deep @ np.array([0.114, 0.587, 0.299]) / 4095
    np.testing.assert_allclose(pictures["b.tif"], grey, atol=1e-4)
    assert len(load_folder(tmp_path, key=key, limit=1)) == 1
    mine = folder_bank(key, tmp_path, crops=2, **SIZES)
    both = join_banks(mine, coco_bank(key, path, **SIZES))
    assert isinstance(both, TextureBank)
    assert both.backgrounds.shape[0] == 4 + 1
    assert both.cutouts.shape[0] == both.diameter.shape[0] == 4 + 2
    np.testing.assert_array_equal(both.backgrounds[:4], mine.backgrounds)

    @jax.jit
    def shown(key: jax.Array, bank: TextureBank) -> jax.Array:
        scene = sample_scene(key, bank, SceneConfig(), (24, 32))
        return render(scene, np.float32([0.0, 0.01]), (24, 32))

    frames = np.asarray(shown(key, both))
    assert np.isfinite(frames).all()
    assert frames.std() > 1
    smaller = dataclasses.replace(mine, backgrounds=mine.backgrounds[:, :32, :32])
    assert code_of(lambda: join_banks(mine, smaller)) == "EV002"
    for name, code in (("none", "EV016"), ("empty", "EV008")):
        (tmp_path / "empty").mkdir(exist_ok=True)
        assert code_of(lambda name=name: load_folder(tmp_path / name)) == code
    (tmp_path / "b.tif").write_bytes(b"II*\0 cut")
    assert "b.tif" in message(lambda: folder_bank(key, tmp_path, **SIZES))


def test_real_segments(data_file: Callable[[str], Path]) -> None:
    """Their polygons run through the centres of the outer pixels, so half an edge is missing."""
    coco = read_coco(data_file("data/images/bsds300_coco/annotations.json"))
    assert len(coco.objects) == 1914
    some = coco.objects[::16]
    share = np.array([o.mask().sum() / o.area for o in some])
    assert 0.96 < np.median(share) < 1.0
    assert (np.abs(share - 1) < 0.1).mean() > 0.95
    bank = coco_bank(jax.random.key(0), coco, limit=6, **SIZES)
    assert bank.cutouts.shape == (6, 2, 48, 48)
    assert np.asarray(bank.cutouts[:, 1]).max((1, 2)).min() > 0.6  # thin ones are soft

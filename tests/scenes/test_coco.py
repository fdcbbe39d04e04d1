"""COCO masks: run-length codes against a slow reference, polygons against their area."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.masks import pack
from helpers.scenery import square, write_coco
from helpers.sources import message
from helpers.videos import code_of
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.scenes import read_coco
from evflow.scenes.coco import CocoObject
from evflow.scenes.rle import decode_rle, unpack_counts

# ------------------------------------------------------------------------------ run-length codes


def plain_runs(mask: np.ndarray) -> list[int]:
    """Runs down the columns, counted pixel by pixel."""
    runs, value = [0], 0
    for pixel in mask.T.ravel().tolist():
        if pixel != value:
            runs.append(0)
            value = pixel
        runs[-1] += 1
    return runs


def unpack(text: str) -> list[int]:
    """The inverse, character by character."""
    runs: list[int] = []
    bits: list[int] = []
    for character in text:
        code = ord(character) - 48
        bits += [code >> k & 1 for k in range(5)]
        if not code & 32:
            value = sum(bit << k for k, bit in enumerate(bits)) - (bits[-1] << len(bits))
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            bits = []
    return runs


masks = st.tuples(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1),
                  st.floats(0, 1)).map(lambda d: cv2.blur(
                      np.random.default_rng(d[2]).random((d[0], d[1])), (3, 3)) < d[3])


@given(masks)
@settings(max_examples=150, deadline=None)
def test_masks_survive_their_codes(mask: np.ndarray) -> None:
    runs = plain_runs(mask)
    assert unpack(pack(runs)) == runs
    assert unpack_counts(pack(runs)).tolist() == runs
    for code in (runs, np.array(runs), pack(runs), pack(runs).encode()):
        decoded = decode_rle(code, mask.shape)
        assert decoded.dtype == bool
        np.testing.assert_array_equal(decoded, mask)


@given(st.lists(st.integers(0, 2**30), min_size=1, max_size=20))
def test_long_runs_survive_packing(runs: list[int]) -> None:
    assert unpack_counts(pack(runs)).tolist() == runs


@pytest.mark.parametrize(("code", "counts"), [
    ("EV009", [3, 4]), ("EV009", [30, -6]), ("EV009", ""), ("EV009", "a"), ("EV009", b""),
    ("EV009", pack([3, 20]) + " "), ("EV009", pack([10, 15])), ("EV009", "o" * 30 + "0"),
    ("EV009", "4\u2603"), ("EV003", [1.5, 22.5]), ("EV003", [[24]]),
])
def test_damaged_codes(code: str, counts: Any) -> None:
    assert decode_rle([4, 20], (4, 6)).sum() == 20
    assert code_of(lambda: decode_rle(counts, (4, 6), "it")) == code


@given(st.text(st.characters(min_codepoint=40, max_codepoint=120), max_size=12))
@settings(max_examples=300)
def test_any_string_is_a_mask_or_a_coded_error(text: str) -> None:
    assert code_of(lambda: decode_rle(text, (5, 7))) in ("", "EV009")


# ------------------------------------------------------------------------------------ COCO files


def test_polygons_and_codes_of_one_square_agree(tmp_path: Path) -> None:
    truth = np.zeros((40, 60), bool)
    truth[12:32, 10:30] = True
    runs = plain_runs(truth)
    halves = [[10, 12, 20, 12, 20, 32, 10, 32], [20, 12, 30, 12, 30, 32, 20, 32]]
    path = write_coco(tmp_path, [
        {"segmentation": [square(10, 12, 20)]}, {"segmentation": halves},
        {"segmentation": {"size": [40, 60], "counts": runs}, "iscrowd": 1},
        {"segmentation": {"size": [40, 60], "counts": pack(runs)}}, {"segmentation": []},
    ])
    coco = read_coco(path)
    assert len(coco.objects) == 4
    assert [o.crowd for o in coco.objects] == [False, False, True, False]
    for item in coco.objects:
        np.testing.assert_array_equal(item.mask(), truth)
        assert item.category == "square"


@given(st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_a_polygon_fills_its_area(seed: int) -> None:
    """Star-shaped polygons: the pixel count is the area by the shoelace formula, up to the
    pixels along the edge, which err either way."""
    rng = np.random.default_rng(seed)
    corners = int(rng.integers(5, 12))
    angle = (np.arange(corners) + rng.uniform(0, 0.9, corners)) * 2 * np.pi / corners
    radius = rng.uniform(15, 45, corners)
    x, y = 50 + radius * np.cos(angle), 50 + radius * np.sin(angle)
    area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    around = np.hypot(x - np.roll(x, -1), y - np.roll(y, -1)).sum()
    item = CocoObject("a", (100, 100), [np.stack([x, y], -1).ravel().tolist()], area, "", False, "")
    assert abs(item.mask().sum() - area) < 2 + 0.15 * around


@pytest.mark.parametrize(("code", "segmentation"), [
    ("EV002", [[1, 1, 5, 5]]), ("EV002", [[1, 1, 5, 5, 9]]), ("EV003", [[1, 1, 5, None, 9, 9]]),
    ("EV003", ["abc"]), ("EV002", {"size": [60, 40], "counts": [2400]}),
    ("EV009", {"size": [40, 60], "counts": [2399]}), ("EV009", {"size": [40, 60], "counts": "~"}),
    ("EV002", {"counts": [2400]}), ("EV003", {"size": [40, 60], "counts": [1.5, 2]}),
])
def test_bad_masks_are_named(tmp_path: Path, code: str, segmentation: Any) -> None:
    path = write_coco(tmp_path, [{"segmentation": [square(1, 1, 5)]},
                                 {"segmentation": segmentation}])
    text = message(lambda: read_coco(path).objects[1].mask())
    assert text.startswith(code)
    assert "annotation 1 (id 1)" in text


def test_bad_jsons(tmp_path: Path) -> None:
    path = write_coco(tmp_path, [{"segmentation": [square(10, 12, 20)]}])
    sound = path.read_text()
    for code, text in (
        ("EV009", sound[:-9]), ("EV009", ""), ("EV009", "[" * 100_000), ("EV008", "[]"),
        ("EV008", "{}"), ("EV008", sound.replace("file_name", "name")),
        ("EV008", sound.replace('"image_id": 7', '"image_id": 8')),
        ("EV008", sound.replace('"width": 60', '"width": null')),
        ("EV020", sound.replace("a.png", "../a.png")), ("EV020", sound.replace("a.png", "/a.png")),
    ):
        path.write_text(text)
        assert code_of(lambda: read_coco(path)) == code, text[:80]
    assert code_of(lambda: read_coco(tmp_path / "none.json")) == "EV016"


def test_real_codes_have_the_area_that_their_json_states(
    data_file: Callable[[str], Path]
) -> None:
    coco = read_coco(data_file("data/images/coco_tiny/panoptic_coco_detection_format.json"))
    assert sum(o.crowd for o in coco.objects) == 3
    for item in coco.objects:
        mask = item.mask()
        assert mask.sum() == item.area, item.where
        runs = unpack(item.segmentation["counts"])
        flat = np.repeat(np.arange(len(runs)) % 2, runs)
        np.testing.assert_array_equal(mask.T.ravel(), flat)


def test_real_polygons_have_their_area(data_file: Callable[[str], Path]) -> None:
    coco = read_coco(data_file("data/images/coco_tiny/test_coco.json"))
    assert len(coco.objects) == 14
    for item in coco.objects:
        assert item.mask().sum() == pytest.approx(item.area, rel=0.02), item.where

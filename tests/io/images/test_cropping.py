"""Frames cropped and scaled to a sensor, slow motion, and saccades over one picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.videos import code_of

from evflow.io.images.cropping import cropped, cropping_of, slowed
from evflow.io.images.frames import FrameSource
from evflow.io.images.saccades import saccades, swept
from evflow.io.source import open_frames


def source(frames: np.ndarray, step_us: int = 10_000) -> FrameSource:
    height, width = frames.shape[1:3]
    return FrameSource((width, height), len(frames), lambda: (
        (frame, step_us * i) for i, frame in enumerate(frames)))


def all_of(made: FrameSource) -> np.ndarray:
    frames = np.stack([frame for frame, _ in made.open()])
    assert frames.shape[2:0:-1] == made.size
    return frames


FRAMES = np.random.default_rng(0).integers(0, 256, (2, 12, 20), np.uint8)


@pytest.mark.parametrize(("options", "expected"), [
    ({"crop": "8x6"}, FRAMES[:, 3:9, 6:14]), ({"crop": "8x6+1+2"}, FRAMES[:, 2:8, 1:9]),
    ({"crop": "20x12"}, FRAMES), ({"resize": "20x12"}, FRAMES),
    ({"resize": "10x6"}, FRAMES.reshape(2, 6, 2, 10, 2).mean((2, 4))),
    ({"crop": "8x8+4+2", "resize": "4x2"},
     FRAMES[:, 2:10, 4:12].reshape(2, 2, 4, 4, 2).mean((2, 4))),
    ({"sensor_size": "6x6"}, FRAMES[:, :, 4:16].reshape(2, 6, 2, 6, 2).mean((2, 4))),
    ({"sensor_size": "10x3"}, FRAMES[:, 3:9].reshape(2, 3, 2, 10, 2).mean((2, 4)))])
def test_a_new_pixel_collects_the_light_of_its_area(
    options: dict[str, str], expected: np.ndarray
) -> None:
    made = cropped(source(FRAMES), **options)
    np.testing.assert_allclose(all_of(made), expected, rtol=1e-5)
    assert len(made.notes) == (expected.shape != FRAMES.shape)
    colour = np.stack([FRAMES, 255 - FRAMES, FRAMES // 2], -1)
    np.testing.assert_allclose(
        all_of(cropped(source(colour), **options))[..., 0], expected, rtol=1e-5)


def test_rounding_makes_nothing_brighter_than_white() -> None:
    white = np.full((1, 180, 240), 255, np.uint8)
    for resize in ("77x59", "500x333"):
        np.testing.assert_allclose(
            all_of(cropped(source(white), resize=resize)), 255, rtol=1e-6)
        assert all_of(cropped(source(white), resize=resize)).max() <= 255


@pytest.mark.parametrize(("name", "size"), [
    ("davis346", (346, 260)), ("DAVIS 240", (240, 180)), ("dvs128", (128, 128)),
    ("evk4", (1280, 720)), ("GenX320", (320, 320)), ("100x50", (100, 50))])
def test_sensors_by_name(name: str, size: tuple[int, int]) -> None:
    cropping = cropping_of((1920, 1080), None, None, name)
    assert cropping.size == size
    (width, height), (x, y) = cropping.used, (cropping.left, cropping.top)
    assert abs(width / height - size[0] / size[1]) < 0.01  # nothing is squeezed
    assert width == 1920 or height == 1080  # and all is used that can be
    assert abs(2 * x + width - 1920) <= 1
    assert abs(2 * y + height - 1080) <= 1


@pytest.mark.parametrize("options", [
    {"crop": "21x5"}, {"crop": "8x6+13+0"}, {"crop": "8"}, {"crop": "0x4"}, {"resize": "8x"},
    {"resize": "8x4", "sensor_size": "dvs128"}, {"sensor_size": "davis"}, {"resize": "0x0"}])
def test_what_is_no_part_of_the_frames(options: dict[str, str]) -> None:
    assert code_of(lambda: cropped(source(FRAMES), **options)) == "EV020"


def test_slow_motion_divides_the_times() -> None:
    made = slowed(source(np.repeat(FRAMES, 3, 0)), 8)
    assert [t for _, t in made.open()] == [round(10_000 * i / 8) for i in range(6)]
    assert code_of(lambda: list(slowed(source(FRAMES), 1e5).open())) == "EV004"
    for bad in (0.0, -1.0, float("nan")):
        assert code_of(lambda bad=bad: slowed(source(FRAMES), bad)) == "EV020"


def test_saccades_go_along_a_triangle_and_show_what_lies_there() -> None:
    path = saccades(12.0)
    assert path.times_us[[0, -1]].tolist() == [0, 300_000]
    assert (np.diff(path.times_us) > 0).all()
    step = np.hypot(*np.diff(path.at_px, axis=0).T)
    assert step.max() <= 0.5 + 1e-9
    assert step[0] < 0.01
    assert step[-1] < 0.01
    corners = path.at_px[np.searchsorted(path.times_us, [0, 100_000, 200_000, 300_000])]
    sides = np.hypot(*np.diff(corners, axis=0).T)
    np.testing.assert_allclose(sides, 12.0, atol=1e-9)
    np.testing.assert_allclose(corners[0], corners[-1], atol=1e-9)

    y, x = np.mgrid[:40, :60].astype(np.float64)

    def scene(dx: float, dy: float) -> np.ndarray:
        return 120 + 50 * np.sin((x + dx) / 4) + 50 * np.cos((y + dy) / 5 + (x + dx) / 9)

    made = swept(source(scene(0, 0)[None].astype(np.float32)), 6.0)
    seen = all_of(made)
    assert made.count == len(seen)
    assert [note.code for note in made.notes] == ["frames.swept"]
    inner = np.s_[8:-8, 8:-8]
    for frame, (dx, dy) in zip(seen[::7], saccades(6.0).at_px[::7], strict=True):
        np.testing.assert_allclose(frame[inner], scene(dx, dy)[inner], atol=1.0)
    for bad in (0.0, -3.0, 1e9):
        assert code_of(lambda bad=bad: swept(source(FRAMES[:1]), bad)) == "EV020"
    assert code_of(lambda: swept(source(FRAMES), 5.0)) == "EV020"


def test_one_picture_is_a_source_only_where_a_sensor_moves_over_it(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), FRAMES[0])
    assert code_of(lambda: open_frames(tmp_path / "a.png")) == "EV008"
    one = open_frames(tmp_path / "a.png", picture=True)
    assert (one.size, one.count, len(list(one.open()))) == ((20, 12), 1, 1)
    fine = swept(one, 2.0, sensor_size="5x3")
    assert fine.size == (5, 3)
    assert all_of(fine).shape[1:] == (3, 5)

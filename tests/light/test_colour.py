"""Colour: luma agrees with OpenCV to the bit, mosaics show the right channel, planes come back."""

from __future__ import annotations

import typing
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import make, write_ijrr
from helpers.tables import write_evreal
from helpers.videos import code_of
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.commands.simulate import Simulate
from evflow.errors import EvflowDataError
from evflow.io.images.frames import FrameHints, Image, converted
from evflow.io.registry import read_recording
from evflow.io.source import open_frames
from evflow.light.colour import (
    COLOURS,
    PATTERNS,
    as_seen,
    luma,
    mosaic,
    mosaic_luma,
    stack_planes,
    unstack_planes,
)
from evflow.simulator.interpolate import upsample
from evflow.types import Recording


def colours(shape: tuple[int, int] = (8, 10), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), np.uint8)


def test_luma_is_opencvs_for_every_byte_and_rec_601() -> None:
    every = np.arange(256, dtype=np.uint8)
    blue, green = np.meshgrid(every, every)
    for red in (0, 1, 77, 254, 255):
        bgr = np.stack([blue, green, np.full_like(blue, red)], -1)
        grey = luma(bgr)
        assert grey.dtype == np.uint8
        np.testing.assert_array_equal(grey, cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY))
        exact = 0.114 * bgr[..., 0] + 0.587 * bgr[..., 1] + 0.299 * bgr[..., 2]
        assert np.abs(grey - exact).max() <= 0.51  # rounded once


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_luma_keeps_deeper_dtypes(dtype: type) -> None:
    bgr = colours().astype(dtype) * 100
    grey = luma(bgr)
    assert grey.dtype == dtype
    np.testing.assert_allclose(grey, bgr @ [0.114, 0.587, 0.299], atol=1.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_grey_stays_what_it_is_and_stacks_are_as_single_frames(dtype: type) -> None:
    grey = colours().astype(dtype)
    np.testing.assert_allclose(luma(np.repeat(grey[..., None], 3, -1)), grey, rtol=1e-6)
    stack = np.stack([colours(seed=i) for i in range(3)]).astype(dtype)
    np.testing.assert_array_equal(luma(stack), np.stack([luma(frame) for frame in stack]))
    white = np.iinfo(dtype).max if dtype != np.float32 else 255
    assert (luma(np.full((2, 2, 3), white, dtype)) == white).all()  # full scale stays


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_pixel_of_a_mosaic_sees_its_own_channel(pattern: str) -> None:
    bgr = colours((7, 9))  # odd sides: the last cell is cut
    seen = mosaic(bgr, pattern)
    for y in range(7):
        for x in range(9):
            letter = pattern[2 * (y % 2) + x % 2]
            assert seen[y, x] == bgr[y, x, {"b": 0, "g": 1, "r": 2}[letter]]


def test_a_red_surface_is_bright_only_at_red_pixels_and_opencv_demosaics_it() -> None:
    bgr = np.zeros((16, 16, 3), np.uint8)
    bgr[..., 2] = 200
    seen = mosaic(bgr, "rggb")
    assert (seen[0::2, 0::2] == 200).all()
    assert seen.sum() == 200 * 64
    flat = np.broadcast_to(np.array([30, 90, 180], np.uint8), (16, 16, 3))
    again = cv2.cvtColor(mosaic(flat, "rggb"), cv2.COLOR_BayerRGGB2BGR)
    np.testing.assert_array_equal(again[2:-2, 2:-2], flat[2:-2, 2:-2])


@given(st.integers(1, 6), st.integers(1, 6), st.sampled_from([np.uint8, np.float32]))
@settings(max_examples=30, deadline=None)
def test_planes_stack_and_unstack(rows: int, columns: int, dtype: type) -> None:
    shape = (2 * rows, 2 * columns)
    bgr = colours(shape).astype(dtype)
    np.testing.assert_array_equal(unstack_planes(stack_planes(bgr), 3), bgr)
    raw = bgr[..., 0]
    np.testing.assert_array_equal(unstack_planes(stack_planes(raw), 4), raw)


def test_bad_frames_and_patterns_are_coded_errors() -> None:
    bgr = colours()
    for code, call in (
        ("EV002", lambda: luma(bgr[..., 0])),
        ("EV003", lambda: luma(bgr.astype(np.int64))),
        ("EV002", lambda: mosaic(bgr[..., :2], "rggb")),
        ("EV020", lambda: mosaic(bgr, "rgbg")),
        ("EV002", lambda: stack_planes(np.zeros((5, 6), np.uint8))),
    ):
        assert code_of(call) == code


def test_the_command_line_offers_every_colour() -> None:
    assert typing.get_args(typing.get_type_hints(Simulate)["colour"]) == COLOURS


def moving_edge(step: float) -> list[tuple[np.ndarray, int]]:
    """Two frames, 64x64, of stripes that move right by `step` px: red 200/40, green 120, and blue
    stripes of the opposite phase."""
    x = np.broadcast_to(np.arange(64.0), (64, 64))
    frames = []
    for shift in (0.0, step):
        wave = np.tanh(3 * np.sin((x - shift) * 2 * np.pi / 32 + 0.3))
        frames.append(np.stack([120 - 60 * wave, np.full_like(x, 120), 120 + 80 * wave], -1))
    return [(np.rint(f).astype(np.uint8), 10_000 * i) for i, f in enumerate(frames)]


@pytest.mark.parametrize("raw", [False, True])
def test_interpolation_does_not_mix_the_colours_of_a_mosaic(raw: bool) -> None:
    """Stripes that move 4 px: the frame half-way is the mosaic of the stripes moved by 2; had
    the grey mosaic been warped, red would show at green pixels, 80 DN off."""
    pairs = moving_edge(4.0)
    if raw:
        pairs = [(mosaic(f, "rggb"), t) for f, t in pairs]
    seen = list(as_seen(iter(pairs), "rggb", lambda slow, pixel: upsample(
        slow, max_motion_px=2.0 * pixel)))
    times = [t for _, t in seen]
    assert len(times) >= 3
    middle = min(range(len(times)), key=lambda i: abs(times[i] - 5000))
    truth = mosaic(moving_edge(4.0 * times[middle] / 10_000)[1][0], "rggb")
    off = np.abs(seen[middle][0] - truth)[8:-8, 8:-8]
    assert np.median(off) < 2
    assert off.mean() < 6
    assert off[0::2, 1::2].max() < 2  # green stands still


def test_luma_frames_pass_unchanged_without_interpolation() -> None:
    pairs = [(f[..., 1], t) for f, t in moving_edge(1.0)]
    assert all(a is b for (a, _), (b, _) in zip(as_seen(iter(pairs), "luma"), pairs, strict=True))
    assert list(as_seen(iter([]), "rggb")) == []


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_luma_of_a_mosaic(pattern: str, dtype: type) -> None:
    """Exact of one colour all over, and of ramps but at the edges; close in smooth pictures."""
    flat = np.broadcast_to(np.array([40, 90, 170], dtype), (6, 8, 3))
    grey = mosaic_luma(mosaic(flat, pattern), pattern)
    assert grey.dtype == dtype
    np.testing.assert_allclose(grey, luma(flat), atol=1)
    ramp = np.add.outer(3 * np.arange(12), 5 * np.arange(16))[..., None] + [0, 40, 90]
    grey = mosaic_luma(mosaic(ramp.astype(dtype), pattern), pattern)
    np.testing.assert_allclose(grey[1:-1, 1:-1], luma(ramp.astype(dtype))[1:-1, 1:-1], atol=1)


def test_a_mosaic_of_any_size_but_not_of_any_kind() -> None:
    grey = np.full((5, 7), 90, np.uint8)
    np.testing.assert_array_equal(mosaic_luma(grey, "gbrg"), grey)
    assert code_of(lambda: mosaic_luma(grey, "rgbg")) == "EV020"
    assert code_of(lambda: mosaic_luma(colours(), "rggb")) == "EV020"  # colours already
    np.testing.assert_array_equal(mosaic_luma(np.stack([grey] * 3, -1), "GBRG"), grey)
    assert code_of(lambda: mosaic_luma(grey[:1], "rggb")) == "EV002"
    assert code_of(lambda: mosaic_luma(grey.astype(np.int64), "rggb")) == "EV003"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_one_colour_video_has_one_grey_by_every_path(tmp_path: Path, dtype: type) -> None:
    """An RGB stack, PNG files, frames as a video decodes them, recordings that bring them along."""
    deep = dtype == np.uint16
    rgb = np.random.default_rng(5).integers(0, 65536 if deep else 256, (6, 48, 64, 3), dtype)
    bgr, us = rgb[..., ::-1], 10_000 * np.arange(6)
    np.savez(tmp_path / "stack.npz", frames=rgb, frame_times=us)
    made = make(200, count=6)
    folder = write_ijrr(tmp_path / "ijrr", made)
    for file, frame in zip(sorted((folder / "images").glob("*.png")), bgr, strict=True):
        cv2.imwrite(str(file), frame)
    evreal = write_evreal(tmp_path, made)
    np.save(evreal / "images.npy", bgr)
    video = (Image(frame, 10_000 * i, "a video") for i, frame in enumerate(bgr))
    by_path = {
        "stack": [frame for frame, _ in open_frames(tmp_path / "stack.npz").open()],
        "folder": [frame for frame, _ in open_frames(folder / "images", fps=100).open()],
        "video": [frame for frame, _ in converted(video, FrameHints(), [])],
        "ijrr": read_recording(folder).frames, "evreal": read_recording(evreal).frames,
        "array": Recording(made.events, luma(bgr), us).frames}
    red, green, blue = (rgb[..., i].astype(np.int64) for i in range(3))
    exact = (299 * red + 587 * green + 114 * blue) / 1000  # Rec. 601, in whole numbers
    for name, frames in by_path.items():
        scaled = deep and name in ("stack", "folder", "video")  # to 0..255, white at 65535
        dn = np.asarray(frames) * (257.0 if scaled else 1.0)
        np.testing.assert_allclose(dn, by_path["array"], rtol=1e-6, err_msg=name)
        assert np.abs(dn - exact).max() <= (3.0 if deep else 0.51), name  # weights of 14 bits


def test_colour_frames_are_refused_with_what_makes_them_grey() -> None:
    made = make(200, count=2)
    rgba = np.random.default_rng(0).integers(0, 256, (2, 48, 64, 4), np.uint8)
    with pytest.raises(EvflowDataError, match=r"EV002.*luma\(frames\[\.\.\., 2::-1\]\)"):
        Recording(made.events, rgba, made.frame_times)
    grey = Recording(made.events, luma(rgba[..., 2::-1]), made.frame_times).frames
    assert abs(grey[1, 2, 3] - rgba[1, 2, 3, :3] @ [0.299, 0.587, 0.114]) <= 0.51

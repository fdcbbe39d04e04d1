"""HDR images: Radiance, PFM and EXR, and what of them is white."""

from __future__ import annotations

import itertools
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sources import message, read
from helpers.videos import drifting

from evflow.io.images import exr
from evflow.light.colour import luma

LIGHT = (drifting(3, (37, 29)) / 60).astype(np.float32)  # radiance 0.08..4.2
COLOURS = np.stack([LIGHT, 0.5 * LIGHT, LIGHT[:, ::-1]], -1)  # B, G, R


def as_exr(image: np.ndarray, kind: str, half: bool) -> bytes:
    """An OpenEXR file of one part, after its published file layout."""
    dtype = np.dtype("<f2" if half else "<f4")
    names = [b"Y"] if image.ndim == 2 else [b"B", b"G", b"R"]
    planes = image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0)
    height, width = image.shape[:2]
    channels = b"".join(name + b"\0" + struct.pack("<iIii", 1 if half else 2, 0, 1, 1)
                        for name in names) + b"\0"
    box = struct.pack("<4i", 0, 5, width - 1, height + 4)  # the first row is number 5
    code = {"none": 0, "RLE": 1, "ZIPS": 2, "ZIP": 3, "PIZ": 4}[kind]
    head = struct.pack("<II", 20000630, 2)
    for name, sort, value in ((b"channels", b"chlist", channels),
                              (b"compression", b"compression", bytes([code])),
                              (b"dataWindow", b"box2i", box), (b"displayWindow", b"box2i", box)):
        head += name + b"\0" + sort + b"\0" + struct.pack("<i", len(value)) + value
    head += b"\0"
    blocks, lines = [], 16 if kind == "ZIP" else 1
    for y in range(0, height, lines):
        raw = b"".join(plane[row].astype(dtype).tobytes() for row in range(
            y, min(y + lines, height)) for plane in planes)
        blocks.append((y + 5, packed(raw, kind)))
    at, table = len(head) + 8 * len(blocks), b""
    for _, data in blocks:
        table += struct.pack("<Q", at)
        at += 8 + len(data)
    return head + table + b"".join(struct.pack("<ii", y, len(d)) + d for y, d in blocks)


def packed(raw: bytes, kind: str) -> bytes:
    if kind == "none":
        return raw
    order = raw[0::2] + raw[1::2]
    steps = order[:1] + bytes((b - a + 128) % 256 for a, b in itertools.pairwise(order))
    short = zlib.compress(steps)
    if kind == "RLE":
        groups = [(b, len(list(same))) for b, same in itertools.groupby(steps)]
        short = b"".join(struct.pack("bB", min(127, n - first) - 1 if n > 1 else -1, b)
                         for b, n in groups for first in range(0, n, 127))
    return short if len(short) < len(raw) else raw


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("kind", ["none", "RLE", "ZIPS", "ZIP"])
@pytest.mark.parametrize("image", [LIGHT[0], COLOURS[0], 0 * LIGHT[0]])
def test_exr_is_read_to_the_bit(image: np.ndarray, kind: str, half: bool) -> None:
    data = as_exr(image, kind, half)
    head = exr.header(data)
    assert head.size == (29, 37)
    assert exr.unread(head) == ""
    expected = image.astype(np.float16 if half else np.float32).astype(np.float32)
    np.testing.assert_array_equal(exr.decode(data, head), expected)


@pytest.mark.parametrize("suffix", ["hdr", "pfm", "exr"])
def test_a_folder_of_radiance_is_a_video(tmp_path: Path, suffix: str) -> None:
    """White is what 99 % of the first image stay below, or what is told; nothing is coded."""
    for i, frame in enumerate(COLOURS):
        if suffix == "exr":
            (tmp_path / f"{i}.exr").write_bytes(as_exr(frame, "ZIP", half=False))
        else:
            cv2.imwrite(str(tmp_path / f"{i}.{suffix}"), frame)
    grey = luma(COLOURS)
    for hints, white in (({}, np.percentile(grey[0], 99)), ({"full_scale": 10.0}, 10.0)):
        frames, times, notes = read(tmp_path, fps=10, response="auto", **hints)
        rough = 0.02 if suffix == "hdr" else 1e-3  # whose mantissa has 8 bits
        np.testing.assert_allclose(
            frames, 255 * luma(np.minimum(COLOURS, np.float32(white))) / white, rtol=2 * rough,
            atol=255 * rough)
        assert times == [0, 100_000, 200_000]
        said = [note.text for note in notes if note.code == "frames.white"]
        assert len(said) == 1
        told = float(said[0].split("radiance of ")[1].split()[0])
        assert told == pytest.approx(white, rel=rough)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    data = as_exr(LIGHT[0], "PIZ", half=True)
    (tmp_path / "a.exr").write_bytes(data)
    text = message(lambda: read(tmp_path, fps=1))
    assert text.startswith(("EV008", "EV009"))  # builds of OpenCV that know PIZ find it damaged
    sound = as_exr(COLOURS[0], "ZIP", half=False)
    for bad in (sound[:-30], sound[:200], sound[:9], sound.replace(b"dataWindow", b"datawindow")):
        (tmp_path / "a.exr").write_bytes(bad)
        assert message(lambda: read(tmp_path, fps=1)).startswith("EV009")
    (tmp_path / "a.exr").write_bytes(sound)
    with np.errstate(all="ignore"):
        (tmp_path / "b.exr").write_bytes(as_exr(COLOURS[1] * np.nan, "ZIP", half=False))
    assert "EV007" in message(lambda: read(tmp_path, fps=1))


def test_the_sun_and_what_is_negative(tmp_path: Path) -> None:
    frame = COLOURS[0].copy()
    frame[3, 4], frame[5, 6] = np.inf, -0.1
    (tmp_path / "a.exr").write_bytes(as_exr(frame, "ZIP", half=False))
    seen = read(tmp_path, fps=1)[0][0]
    assert seen[3, 4] == pytest.approx(255, rel=1e-5)
    assert seen[5, 6] == 0

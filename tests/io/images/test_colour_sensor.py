"""Events from behind a colour mosaic: the frames are what each pixel sees."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.bags import IMAGE, Messages, array_messages, header, needs_rosbags, write
from helpers.recordings import T0, make, refused
from helpers.streams import aedat3_packet

from evflow.cli import main
from evflow.io import read_recording, write_events
from evflow.io.source import open_frames
from evflow.light.colour import luma, mosaic, mosaic_luma

WANT = make(300, 2)
COLOUR = np.random.default_rng(0).integers(0, 250, (2, 48, 64, 3)).astype(np.uint8)  # B, G, R
SEEN = np.stack([mosaic(frame, "rggb") for frame in COLOUR])


def images(encoding: str, frames: np.ndarray) -> Messages:
    out: Messages = []
    for i, frame in enumerate(frames):
        ns = (T0 + 1000 + 50_000 * i) * 1000
        out.append(("/dvs/image_raw", IMAGE, ns, header(ns) + struct.pack("<2I", 48, 64)
                    + struct.pack("<I", len(encoding)) + encoding.encode()
                    + struct.pack("<B2I", 0, frame.nbytes // 48, frame.nbytes)
                    + frame.tobytes()))
    return out


def bag(folder: Path, encoding: str, frames: np.ndarray) -> Path:
    return write(folder / "a.bag", array_messages(WANT.events) + images(encoding, frames))


@needs_rosbags
@pytest.mark.parametrize(("encoding", "frames"), [
    ("bayer_rggb8", SEEN), ("bgr8", COLOUR), ("rgb8", COLOUR[..., ::-1]), ("mono8", SEEN)])
def test_bags(tmp_path: Path, encoding: str, frames: np.ndarray) -> None:
    path = bag(tmp_path, encoding, frames)
    got = read_recording(path, colour="rggb")
    np.testing.assert_array_equal(got.frames, SEEN)
    assert "frames.raw" in {n.code for n in got.notes}
    grey = read_recording(path)
    want = SEEN if encoding == "mono8" else [
        mosaic_luma(f, "rggb") if encoding[0] == "b" and encoding[1] == "a" else luma(c)
        for f, c in zip(SEEN, COLOUR, strict=True)]
    np.testing.assert_array_equal(grey.frames, want)
    (note,) = [n.text for n in grey.notes if n.code == "frames.mosaic"] or [""]
    assert ("--colour rggb" in note) == (encoding == "bayer_rggb8")
    source = open_frames(path, colour="rggb")  # to be simulated
    np.testing.assert_array_equal([frame for frame, _ in source.open()], SEEN)
    assert [n.code for n in source.notes].count("frames.raw") == 1


@needs_rosbags
def test_another_mosaic_than_the_images_say(tmp_path: Path) -> None:
    path = bag(tmp_path, "bayer_rggb8", SEEN)
    error = refused(path, colour="grbg")
    assert (error.code, "Pass --colour rggb" in error.fix) == ("EV020", True)
    assert refused(path, colour="red").code == "EV020"


@needs_rosbags
def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bag(tmp_path, "bayer_rggb8", SEEN)
    out = tmp_path / "a.npz"
    assert main(["convert", str(path), str(out), "--colour", "rggb"]) == 0
    np.testing.assert_array_equal(read_recording(out).frames, SEEN)
    assert main(["info", str(path), "--colour", "rggb", "--bayer", "rggb"]) == 2
    assert "Give only one of them" in capsys.readouterr().err


def test_frames_from_elsewhere(tmp_path: Path) -> None:
    write_events(tmp_path / "a.npz", WANT.events, "npz")
    (tmp_path / "f").mkdir()
    for i, frame in enumerate(COLOUR):
        assert cv2.imwrite(str(tmp_path / f"f/{i}.png"), frame)
    (tmp_path / "f/timestamps.txt").write_text(f"{T0 + 1000}\n{T0 + 51_000}\n")
    out = tmp_path / "b.npz"
    assert main(["convert", str(tmp_path / "a.npz"), str(out), "--colour", "rggb",
                 "--frames", str(tmp_path / "f"), "--timestamps-unit", "us"]) == 0
    np.testing.assert_array_equal(read_recording(out).frames, SEEN)


def test_the_mosaic_of_aedat3_becomes_luma_by_the_option_that_its_note_names(
    tmp_path: Path
) -> None:
    data = b"#!AER-DAT3.1\r\n#Source 1: DAVIS240C\r\n#!END-HEADER\r\n"
    data += aedat3_packet(1, 8, struct.pack("<Ii", 3 << 17 | 4 << 2 | 1, 100))
    frame = np.add.outer(np.arange(180) % 2 * 80, np.arange(240) % 2 * 60 + 20).astype("<u2") * 257
    info = 1 | 1 << 1 | 1 << 4  # valid, one channel, a mosaic
    head = struct.pack("<Iiiiiiiii", info, 0, 0, 90, 110, 240, 180, 0, 0)
    (tmp_path / "a.aedat").write_bytes(
        data + aedat3_packet(2, 36 + frame.nbytes, head + frame.tobytes()))
    note, = (n for n in read_recording(tmp_path / "a.aedat").notes if n.code == "frames.raw")
    assert "--bayer RGGB" in note.text
    out = tmp_path / "b.npz"
    assert main(["convert", str(tmp_path / "a.aedat"), str(out), "--bayer", "RGGB"]) == 0
    got = read_recording(out).frames[0]
    np.testing.assert_allclose(got, mosaic_luma((frame / 257).astype(np.float32), "rggb"), atol=.01)

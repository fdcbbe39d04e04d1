"""IJRR text folders and zips."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import SIZE, equal, make, refused, write_ijrr, zipped

from evflow.io import read_events, read_recording, write_events
from evflow.io.source import open_frames


def test_ijrr_rounds_nanosecond_text(tmp_path: Path) -> None:
    (tmp_path / "events.txt").write_text(
        "# t x y p\n13.582595999 1 2 1\n13.582597000 3 4 0\n13.5826010004 3 4 0\n")
    got = read_events(tmp_path, size=SIZE)
    assert got.t.tolist() == [13582596, 13582597, 13582601]
    assert got.p.tolist() == [True, False, False]
    equal(read_events(tmp_path / "events.txt", size=SIZE), got)


def test_ijrr_text_in_microseconds_is_read_when_told(tmp_path: Path) -> None:
    (tmp_path / "events.txt").write_text("".join(f"{7 * i} 1 2 1\n" for i in range(20)))
    got = read_events(tmp_path, size=SIZE, time_unit="us")
    assert got.t.tolist() == list(range(0, 140, 7))
    equal(read_events(tmp_path / "events.txt", size=SIZE, time_unit="us"), got)


@pytest.mark.parametrize("row", ["0.001\t1\t2\t1", "0.001  1 2 1 ", "1e-3 1 2 1"])
def test_ijrr_files_are_read_as_their_folders(row: str, tmp_path: Path) -> None:
    (tmp_path / "events.txt").write_text(f"{row}\n0.002 3 4 0\n")
    got = read_events(tmp_path, size=SIZE)
    assert got.t.tolist() == [1000, 2000]
    equal(read_events(tmp_path / "events.txt", size=SIZE), got)


def test_ijrr_blocks_join_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_ijrr(tmp_path, make())
    whole = read_recording(tmp_path)
    monkeypatch.setattr("evflow.io.decode.text.BLOCK", 101)  # cut at every place of 20
    equal(read_recording(tmp_path).events, whole.events)
    part = read_events(tmp_path, start_s=0.1, stop_s=0.2)
    first = int(whole.events.t[0])
    equal(part, whole.events.slice(first + 100_000, first + 200_000))


@pytest.mark.parametrize(("text", "code", "seen"), [
    ("", "EV001", "no event"),
    ("0.1 1 2 1\n0.2 1 2\n", "EV009", "byte 10 of 18: the line b'0.2 1 2'"),
    ("0.1 1 2 1\n0.2 1 2 1\n0.3", "EV009", "byte 20 of 23"),
    ("0.1 1 2 1 7\n", "EV009", "byte 0"),
    ("0.1 a 2 1\n", "EV009", "byte 0"),
    ("0.1 1 2 1\n" + "x" * 5_000_000, "EV009", "damaged"),
    ("0.1 1.5 2 1\n", "EV003", "undistorted"),
    ("0.1 99999999999 2 1\n", "EV005", "x=99999999999"),
    ("0.1 1 2 0.5\n", "EV006", "p is 0.5"),
    ("0.1 nan 2 1\n", "EV009", "b'0.1 nan 2 1'"),
    ("nan 1 2 1\n", "EV009", "b'nan 1 2 1'"),
    ("1e300 1 2 1\n", "EV003", "t is 1e+300"),
    ("0.2 1 2 1\n0.1 1 2 1\n", "EV004", "goes back"),
    ("0.1 70 2 1\n", "EV005", "x=70"),
    ("".join(f"{i} 1 2 1\n" for i in range(20)), "EV003", "time_unit='us'"),
])
def test_ijrr_with_bad_text(tmp_path: Path, text: str, code: str, seen: str) -> None:
    (tmp_path / "events.txt").write_text(text)
    error = refused(tmp_path, **({"size": SIZE} if text else {}))
    assert error.code == code
    assert seen in str(error)


@pytest.mark.parametrize(("index", "code"), [
    ("0.1 images/none.png\n", "EV016"), ("0.1 ../../secret.png\n", "EV008"),
    ("0.1 /etc/passwd\n", "EV008"), ("0.1\n", "EV009"), ("x images/a.png\n", "EV009"),
    ("0.1 events.txt\n", "EV009"), ("0.1 images/a.png\n0.1 images/b.png\n", "EV004"),
    ("0.1 images/a.png\n0.2 images/a.png\n", "EV009")])
def test_ijrr_with_bad_images(tmp_path: Path, index: str, code: str) -> None:
    write_ijrr(tmp_path, make(20, count=1))
    assert cv2.imwrite(str(tmp_path / "images/small.png"), np.zeros((2, 2), np.uint8))
    (tmp_path / "images.txt").write_text(index)
    assert refused(tmp_path).code == code


@pytest.mark.parametrize("change", [
    lambda text: text.replace("/", "\\"), lambda text: "\ufeff" + text,
    lambda text: text.replace(" ", ","), lambda text: text.replace(" ", ";\t"),
    lambda text: "timestamp, filename\n" + text, lambda text: text.replace("\n", "\r\n"),
    lambda text: re.sub(r"(images.*png)", r'"\1"', text), lambda text: text.replace("images/", "")])
def test_ijrr_index_as_other_tools_write_it(
    tmp_path: Path, change: Callable[[str], str]
) -> None:
    want = make(20, count=2)
    index = write_ijrr(tmp_path, want) / "images.txt"
    index.write_bytes(change(index.read_text()).encode())
    np.testing.assert_array_equal(read_recording(tmp_path).frames, want.frames)


def test_ijrr_images_keep_16_bits_and_colour_is_noted(tmp_path: Path) -> None:
    folder = write_ijrr(tmp_path / "deep", make(20, count=2))
    for i in range(2):
        deep = np.full((48, 64), 1000 + i, np.uint16)
        cv2.imwrite(str(folder / f"images/frame_{i:08d}.png"), deep)
    got = read_recording(folder)
    assert got.frames.dtype == np.uint16
    assert got.frames[:, 0, 0].tolist() == [1000, 1001]
    folder = write_ijrr(tmp_path / "colour", make(20, count=1))
    red = np.zeros((48, 64, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes B, G, R
    cv2.imwrite(str(folder / "images/frame_00000000.png"), red)
    got = read_recording(folder)
    assert got.frames[0, 0, 0] == round(0.299 * 255)
    assert "frames.luma" in [note.code for note in got.notes]


def test_zip_of_two_recordings_is_refused(tmp_path: Path) -> None:
    write_ijrr(tmp_path / "a" / "one", make(20, count=1))
    write_ijrr(tmp_path / "a" / "two", make(20, count=1))
    assert "2 recordings" in str(refused(zipped(tmp_path / "a", "")))


def test_real_slider_depth_text(data_file: Callable[[str], Path], tmp_path: Path) -> None:
    got = read_recording(data_file("data/recordings/ijrr_slider_depth"))
    assert (len(got.events), got.events.size) == (50_000, (240, 180))
    assert (got.events.t[0], got.events.t[-1]) == (3811, 174156)
    assert got.frames.shape == (87, 180, 240)
    assert (got.frame_times <= got.events.t[-1]).sum() == 5
    write_events(tmp_path / "a.h5", got)
    again = read_recording(tmp_path / "a.h5")
    equal(again.events, got.events)
    np.testing.assert_array_equal(again.frames, got.frames)


def test_images_without_an_index_are_told_with_how_to_read_them(tmp_path: Path) -> None:
    write_ijrr(tmp_path, make())
    (tmp_path / "images.txt").rename(tmp_path / "image_timestamps.txt")
    note = read_recording(tmp_path, size=SIZE).notes[-1].text
    assert "6 images in" in note
    folder, times = re.findall(r"--frames (\S+) --timestamps (\S+)", note)[0]
    assert len(list(open_frames(folder, timestamps=times).open())) == 6
    assert read_recording(tmp_path, size=SIZE, no_frames=True).notes == ()

"""Videos: frames and times from the container, the rate or a file; damage is named."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.sources import message, read
from helpers.videos import code_of, drifting

from evflow.io.images.matroska import first_stamp_s
from evflow.io.images.video import Clock
from evflow.io.source import open_frames

SIZE = (32, 24)


def clip(path: Path, count: int = 12, fps: float = 25.0, fourcc: str = "MJPG") -> Path:
    """A video of drifting texture, in colour."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), fps, SIZE)
    if not writer.isOpened():
        pytest.skip(f"this OpenCV cannot write {fourcc} to {path.suffix}")
    for frame in drifting(count, SIZE[::-1]).astype(np.uint8):
        writer.write(np.stack([frame, frame // 2, 255 - frame], -1))
    writer.release()
    return path


@pytest.mark.parametrize(("name", "fourcc"), [
    ("a.avi", "MJPG"), ("a.mp4", "mp4v"), ("a.mkv", "MJPG"), ("a.avi", "XVID")])
def test_videos_of_constant_rate(tmp_path: Path, name: str, fourcc: str) -> None:
    path = clip(tmp_path / name, 12, 30.0, fourcc)
    frames, times, notes = read(path)
    assert frames.dtype == np.uint8
    # Matroska's stamps are whole milliseconds; the rate gives the exact times.
    assert times == [round(i * 1e6 / 30) for i in range(12)]
    assert notes == []
    capture = cv2.VideoCapture(str(path))
    for frame in frames:
        np.testing.assert_array_equal(frame, cv2.cvtColor(capture.read()[1], cv2.COLOR_BGR2GRAY))
    assert read(path, fps=1000)[1] == [1000 * i for i in range(12)]


def test_a_broadcast_rate(tmp_path: Path) -> None:
    times = read(clip(tmp_path / "a.mp4", 31, 30000 / 1001, "mp4v"))[1]
    np.testing.assert_allclose(times, np.arange(31) * 1e6 * 1001 / 30000, atol=2.0)


def box(data: bytes, name: bytes) -> int:
    at = data.rindex(name) - 4
    assert data[at + 4 : at + 8] == name
    return at


def vary(path: Path, repeats: Sequence[tuple[int, int]]) -> None:
    """Give an mp4 whose index is its last box the durations (count, length) in units of its
    first frame's."""
    data = bytearray(path.read_bytes())
    at = box(data, b"stts")
    size, _, _, entries, _, length = struct.unpack_from(">IIIIII", data, at)
    assert entries == 1
    table = b"".join(struct.pack(">II", n, k * length) for n, k in repeats)
    data[at : at + size] = struct.pack(
        ">I4sII", 16 + len(table), b"stts", 0, len(repeats)) + table
    for name in (b"stbl", b"minf", b"mdia", b"trak", b"moov"):
        outer = box(data[:at], name)
        grown = struct.unpack_from(">I", data, outer)[0] + len(table) - 8
        struct.pack_into(">I", data, outer, grown)
    # The edit list ends the film at its old duration: "free" boxes are skipped.
    path.write_bytes(data.replace(b"edts", b"free"))


def test_a_variable_frame_rate_is_followed(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.mp4", 12, 50.0, "mp4v")
    vary(path, [(4, 1), (4, 3), (4, 1)])
    _, times, notes = read(path)
    steps = [20_000] * 4 + [60_000] * 4 + [20_000] * 3
    np.testing.assert_allclose(np.diff(times), steps, atol=1)
    assert "variable frame rate (16.67 to 50 frames/s)" in notes[0].text
    assert np.diff(read(path, fps=50)[1]).tolist() == [20_000] * 11


def begin_late(path: Path, late_ms: int) -> None:
    """Move all stamps of a Matroska film of OpenCV's, and the end that its header tells."""
    data = bytearray(path.read_bytes())
    for block in re.finditer(rb"\xa3[\x40-\x7f].\x81(..)\x80\xff\xd8", bytes(data), re.DOTALL):
        stamp = struct.unpack(">h", block[1])[0] + late_ms
        struct.pack_into(">h", data, block.start(1), stamp)
    at = data.index(b"\x44\x89\x88") + 3  # duration, in ms, and as text beside the track
    (end,) = struct.unpack_from(">d", data, at)
    struct.pack_into(">d", data, at, end + late_ms)
    text = b"00:00:%06.3f" % (end / 1e3)
    path.write_bytes(data.replace(text, b"00:00:%06.3f" % ((end + late_ms) / 1e3)))


@pytest.mark.parametrize("late_ms", [1, 40, 500, 1400])
def test_a_film_that_begins_late_is_no_damaged_one(tmp_path: Path, late_ms: int) -> None:
    path = clip(tmp_path / "a.mkv", 40)
    begin_late(path, late_ms)
    assert first_stamp_s(path) == late_ms / 1e3
    for hints in ({}, {"fps": 25.0}):
        assert read(path, **hints)[1] == [40_000 * i for i in range(40)]
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert "of the 40 frames" in message(lambda: open_frames(path))
    for end in range(4, 80, 5):  # whatever is left of a header: no error of ours
        path.write_bytes(data[:end])
        assert first_stamp_s(path) == 0
    beyond = b"\xec\x01" + b"\xff" * 6 + b"\xfe"  # an element of 2^56 bytes, twice: past any file
    path.write_bytes(data[:4] + b"\x80" + beyond * 200)
    assert first_stamp_s(path) == 0


def test_the_clock_of_coarse_absent_and_backward_stamps() -> None:
    def times(stamps: Sequence[float], fps: float) -> list[int]:
        clock = Clock(Path("x"), fps)
        return [clock.time(i, stamp) for i, stamp in enumerate(stamps)]

    assert times([40, 73, 107, 140], 30.0) == [0, 33333, 66667, 100000]  # whole ms, from 40 ms
    assert times([0, 0, 0], 30.0) == [0, 33333, 66667]  # no stamps at all
    assert times([0, 33, 95, 140], 30.0) == [0, 33333, 95000, 140000]  # a gap
    assert times([0, 1, 1, 2, 2], 2000.0) == [0, 500, 1000, 1500, 2000]  # faster than its tick
    assert code_of(lambda: times([0, 33.5, 20.1], 30.0)) == "EV004"


@pytest.mark.parametrize(("name", "fourcc"), [("a.avi", "MJPG"), ("a.mkv", "MJPG")])
def test_a_cut_off_video_says_how_much_is_left(tmp_path: Path, name: str, fourcc: str) -> None:
    path = clip(tmp_path / name, 40, 25.0, fourcc)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    text = message(lambda: open_frames(path))  # at once, before anything is simulated
    assert text.startswith("EV009")
    left = int(text.split(" of the 40 frames")[0].split()[-1])
    assert 10 < left < 30
    assert "--partial" in text
    frames, times, _ = read(path, partial=True)
    assert len(frames) == left
    assert times == [40_000 * i for i in range(left)]


def test_a_hole_in_the_middle_is_found_too(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.mkv", 40)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 900] = bytes(900)
    path.write_bytes(data)
    assert "of the 40 frames" in message(lambda: list(open_frames(path).open()))


def test_what_is_no_video(tmp_path: Path) -> None:
    empty, text, one = tmp_path / "empty.mp4", tmp_path / "text.mp4", tmp_path / "one.png"
    empty.write_bytes(b"")
    text.write_text("this is no video" * 100)
    cv2.imwrite(str(one), np.zeros((8, 8), np.uint8))
    headless = clip(tmp_path / "a.mp4", 12, 25.0, "mp4v")
    headless.write_bytes(headless.read_bytes()[:2000])
    for code, path in (("EV016", tmp_path / "absent.mp4"), ("EV009", empty), ("EV008", text),
                       ("EV008", one), ("EV008", headless)):
        assert code_of(lambda path=path: open_frames(path)) == code
    assert "folder" in message(lambda: open_frames(tmp_path / "img_%04d.png"))
    none = clip(tmp_path / "none.avi", 0)
    assert code_of(lambda: open_frames(none)) in ("EV008", "EV009")
    single = clip(tmp_path / "single.avi", 1)
    assert len(read(single)[0]) == 1


def test_hints_are_checked(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.avi", 3)
    for bad in ({"fps": 0.0}, {"fps": float("nan")}, {"fps": 2e6}, {"full_scale": -1.0},
                {"colour": "rgbg"}, {"time_unit": "h"}, {"speed": 3},
                {"fps": 30.0, "timestamps": "t.txt"}):
        assert code_of(lambda bad=bad: open_frames(path, **bad)) == "EV020"


def test_times_of_a_video_from_a_file(tmp_path: Path) -> None:
    path, log = clip(tmp_path / "a.avi", 5), tmp_path / "log.txt"
    log.write_text("0.5\n0.53\n0.6\n0.61\n0.7\n")
    assert read(path, timestamps=log)[1] == [500_000, 530_000, 600_000, 610_000, 700_000]
    for lines in ("0.5\n0.53\n0.6\n", "0.5\n0.53\n0.6\n0.61\n0.7\n0.8\n"):
        log.write_text(lines)
        assert code_of(lambda: list(open_frames(path, timestamps=log).open())) == "EV002"


def test_a_cut_without_encoding_is_told_from_damage(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.mp4", 60, 30.0, "mp4v")
    data = bytearray(path.read_bytes())
    scale = struct.unpack_from(">I", data, data.rindex(b"mdhd") + 16)[0]
    struct.pack_into(">Ii", data, data.rindex(b"elst") + 12, 1500, scale // 2)  # .5 s to the end
    path.write_bytes(data)
    said = message(lambda: read(path))
    assert "45 of the 60 frames" in said
    assert said.index("trimmed away by its edit list") < said.index("--partial") < said.index(
        "ffmpeg -i a.mp4") < said.index("damaged: copy it again")
    assert len(read(path, partial=True)[0]) == 45

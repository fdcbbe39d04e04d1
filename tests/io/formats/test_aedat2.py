"""AEDAT2: chips, words beside the events, jAER's headers."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import equal, refused
from helpers.streams import clustered, listed

from evflow.io import read_events, read_recording
from evflow.notes import Note, texts
from evflow.types import Events


def test_dvs128_by_name_and_by_size(tmp_path: Path) -> None:
    """jAER's DVS128 counts x from the right, y from the bottom, and its polarity bit is OFF."""
    source = clustered(200)
    events = Events(source.x % 128, source.y % 128, source.t, source.p, (128, 128))
    data = b"".join(struct.pack(">2I", (127 - y) << 8 | (127 - x) << 1 | (1 - p), t)
                    for x, y, t, p in listed(events))
    sync = struct.pack(">2I", 0x8000, 10**7)
    path = tmp_path / "a.aedat"
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: ch.unizh.ini.jaer.chip.retina.DVS128\r\n"
                     + data + sync)
    equal(read_events(path), events)
    assert read_recording(path).notes == (
        Note("events.unread", "1 sync or special words were not read"),)
    path.write_bytes(b"#!AER-DAT2.0\r\n# Timestamps tick is 1 us\r\n" + data)
    assert "names no chip" in str(refused(path))
    equal(read_events(path, size=(128, 128)), events)


def test_size_does_not_change_the_layout_of_a_named_chip(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat"
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: DAVIS240C\r\n"
                     + struct.pack(">2I", 5 << 22 | 6 << 12 | 0x800, 9))
    assert listed(read_events(path, size=(128, 128))) == [(121, 122, 9, 1)]


V2E = (b"#!AER-DAT2.0\r\n# This is a raw AE data file created by AEDat2Output in v2e (see https://"
       b"github.com/SensorsINI/v2e) as specified at https://inivation.com\r\n")
LABELS = b"# noise events are labeled when the --label_signal_noise option is selected\r\n"


def addressed(header: bytes, events: Events, shifts: tuple[int, int, int], noise: int = 0) -> bytes:
    """As v2e writes: x from the right, y from the bottom, ON = 1; every `noise`-th event marked."""
    width, height = events.size
    to_x, to_y, to_p = shifts
    return header + b"".join(
        struct.pack(">2I", (width - 1 - x) << to_x | (height - 1 - y) << to_y | p << to_p
                    | (0x400 if noise and not i % noise else 0), t)
        for i, (x, y, t, p) in enumerate(listed(events)))


def over(size: tuple[int, int], n: int = 300) -> Events:
    rng = np.random.default_rng(0)
    width, height = size
    return Events(rng.integers(0, width, n), rng.integers(0, height, n),
                  np.sort(rng.integers(0, 10**6, n)), rng.integers(0, 2, n), size)


@pytest.mark.parametrize(("header", "size", "shifts"), [
    (V2E, (640, 480), (1, 11, 0)), (V2E, (346, 260), (12, 22, 11)), (V2E, (240, 180), (12, 22, 11)),
    (b"#!AER-DAT2.0\r\n# AEChip: ch.unizh.ini.jaer.chip.retina.DVS640\r\n", (640, 480), (1, 11, 0)),
    (b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis640\r\n", (640, 480),
     (12, 22, 11)),
    (b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis128\r\n", (128, 128),
     (12, 22, 11))])
def test_the_layout_is_that_of_the_chip_or_v2e(
    tmp_path: Path, header: bytes, size: tuple[int, int], shifts: tuple[int, int, int]
) -> None:
    path, want = tmp_path / "a.aedat", over(size)
    path.write_bytes(addressed(header, want, shifts))
    got = read_recording(path, **({"size": size} if header == V2E else {}))
    equal(got.events, want)
    assert got.notes == ()
    if header == V2E:
        assert "v2e writes 346x260, 240x180, 640x480" in str(refused(path))


def test_events_that_v2e_labels_as_noise_are_kept(tmp_path: Path) -> None:
    """At 640x480 its label is a bit of x."""
    path, want = tmp_path / "a.aedat", over((346, 260))
    path.write_bytes(addressed(V2E + LABELS, want, (12, 22, 11), noise=3))
    got = read_recording(path, size=want.size)
    equal(got.events, want)
    assert texts(got.notes) == ["v2e's labels, by which 100 events are noise, were not read: no "
                                "command uses or keeps them"]
    large = over((640, 480))
    path.write_bytes(addressed(V2E + LABELS, large, (1, 11, 0), noise=3))
    error = refused(path, size=large.size)
    assert (error.code, "--label_signal_noise" in error.fix) == ("EV003", True)


@pytest.mark.parametrize(("size", "shifts", "chip"), [
    ((346, 260), (12, 22, 11), b""), ((128, 128), (1, 8, 0), b"# AEChip: a.DVS999\r\n")])
def test_a_layout_that_is_assumed_is_told(
    tmp_path: Path, size: tuple[int, int], shifts: tuple[int, int, int], chip: bytes
) -> None:
    path, want = tmp_path / "a.aedat", over(size)
    stored = Events(want.x, want.y, want.t, ~want.p, size) if chip else want  # the DVS128's is OFF
    path.write_bytes(addressed(b"#!AER-DAT2.0\r\n" + chip, stored, shifts))
    got = read_recording(path, size=size)
    equal(got.events, want)
    note, = got.notes
    assert note.code == "events.layout"
    assert ("of a DVS128, by the size 128x128: the header names the chip 'DVS999'" if chip else
            "of a DAVIS, by the size 346x260: the header names no chip") in note.text


def test_words_beside_the_events(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat"
    words = [(1 << 31, 5), (1 << 31 | 1 << 10, 6), (0xC00 | 1 << 31, 7), (0x400, 8),
             (10 << 22 | 20 << 12 | 0x800, 9)]
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: DAVIS346B\r\n#End Of ASCII Header\r\n"
                     + b"".join(struct.pack(">2I", *w) for w in words))
    got = read_recording(path)
    assert listed(got.events) == [(345 - 20, 259 - 10, 9, 1)]
    assert got.events.size == (346, 260)
    assert tuple(texts(got.notes)) == (
        "1 frames with missing samples were left out", "1 IMU samples were not read",
        "1 sync or special words were not read")
    assert tuple(texts(read_recording(path, no_frames=True).notes)) == (
        "2 APS samples were not read", "1 IMU samples were not read",
        "1 sync or special words were not read")


def test_time_of_other_words_does_not_move_the_clock(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat"
    words = [(0, 2**32 - 5), (1 << 31 | 0xC00, 77), (0, 2), (1 << 31 | 0xC00, 2**32 - 9), (0, 3)]
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: DAVIS240C\r\n"
                     + b"".join(struct.pack(">2I", *w) for w in words))
    assert read_events(path).t.tolist() == [2**32 - 5, 2**32 + 2, 2**32 + 3]


def test_data_that_begins_like_a_header_line(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat"
    address = int.from_bytes(b"#\x00\x00\x00", "big")
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: DAVIS346B\r\n"
                     + struct.pack(">2I", address, 0x0A0A) + struct.pack(">2I", address, 0x0A0B))
    assert read_events(path).t.tolist() == [0x0A0A, 0x0A0B]


@pytest.mark.parametrize("chip", [b"eu.seebetter.Cochlea", b"DAVIS999"])
def test_unknown_chip_is_named(tmp_path: Path, chip: bytes) -> None:
    path = tmp_path / "a.aedat"
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: " + chip + b"\r\n" + struct.pack(">2I", 0, 1))
    error = refused(path)
    assert error.code == "EV015"
    assert chip.decode().rsplit(".", 1)[-1] in str(error)
    np.testing.assert_array_equal(read_events(path, size=(346, 260)).x, [345])


def aps(
    light: np.ndarray, begin: int, *, exposure: int, rolling: bool = False, right: bool = False
) -> list[tuple[int, int]]:
    """Words of one frame (36, 48): column by column from the first or the last, each pixel at 900
    after its reset and at 900 - light after its exposure; a column takes 10 us."""
    words: list[tuple[int, int, int]] = []
    columns = range(47, -1, -1) if right else range(48)
    for k, x in enumerate(columns):
        for kind in (0, 1):
            start = begin + 10 * k + (exposure if kind else 0)
            words += [(start, 1 << 31 | (35 - y) << 22 | x << 12 | kind << 10
                       | 900 - kind * int(light[y, x]), kind) for y in range(36)]
    words.sort(key=lambda word: (word[0], word[2]) if rolling else (word[2], word[0]))
    return [(address, t) for t, address, _ in words]


def davis(folder: Path, words: list[tuple[int, int]], chip: bytes = b"DAVIS240C") -> Path:
    path = folder / "a.aedat"
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: a.b." + chip + b"\r\n" + np.array(
        words, ">u4").tobytes())
    return path


EVENT, SMALL = 10 << 22 | 5 << 12 | 0x800, (48, 36)


@pytest.mark.parametrize("right", [False, True])
@pytest.mark.parametrize(("exposure", "rolling", "middle"), [
    (10_000, False, (470 + 10_000) // 2),  # from the last reset to the first signal
    (100, True, 235 + 50)])  # the mean column is read at 235 and, 100 later, again
def test_frames_of_a_davis(
    tmp_path: Path, exposure: int, rolling: bool, middle: int, right: bool
) -> None:
    """Two frames among events, whose x is turned where that of samples is not; a pixel that is
    darker than its reset is 0."""
    rng = np.random.default_rng(0)
    light = rng.integers(0, 800, (2, 36, 48))
    light[0, 3, 7] = -5
    words = [(EVENT, 1000)]
    for i, frame in enumerate(light):
        words += [*aps(frame, 2000 + 50_000 * i, exposure=exposure, rolling=rolling, right=right),
                  (EVENT, 40_000 + 50_000 * i)]
    path = davis(tmp_path, words)
    got = read_recording(path, size=SMALL)
    assert listed(got.events) == [(42, 25, t, 1) for t in (1000, 40_000, 90_000)]
    assert got.frame_times.tolist() == [2000 + middle, 52_000 + middle]
    np.testing.assert_allclose(got.frames, np.maximum(light, 0) * 255 / 1023, rtol=1e-6)
    notes = texts(got.notes)
    assert notes[0] == "frame times are mid-exposure"
    assert "1 frame values below their reset are 0" in notes
    assert got.exposure_us == (100 if rolling else 10_000 - 470)
    assert f"exposed for {got.exposure_us / 1e3:g} ms" in notes[-2] + notes[-1]
    assert len(read_recording(path, size=SMALL, stop_s=0.02).frames) == 1
    named = read_recording(path, size=SMALL, frames_topic="aps")
    assert "frames are from aps" in texts(named.notes)
    assert "--late join" in texts(read_recording(path, size=SMALL, late="join").notes)[0]
    assert "has no images" in str(refused(davis(tmp_path, [(EVENT, 0)]), frames_topic="aps"))
    davis(tmp_path, words)
    assert not read_recording(path, size=SMALL, no_frames=True).has_frames


def test_frames_across_the_turn_of_the_clock_and_cut_off(tmp_path: Path) -> None:
    light = np.full((36, 48), 200)
    turn = 2**32
    words = [(EVENT, turn - 3000), *aps(light, turn - 1000, exposure=5000), (EVENT, turn + 9000),
             *aps(light, turn + 20_000, exposure=5000)[:-7]]
    got = read_recording(
        davis(tmp_path, [(address, t % turn) for address, t in words]), size=SMALL)
    assert got.frame_times.tolist() == [turn - 1000 + (470 + 5000) // 2]
    assert got.events.t.tolist() == [turn - 3000, turn + 9000]
    assert texts(got.notes)[1] == "1 frames with missing samples were left out"


@pytest.mark.parametrize("lost", [slice(0, 100), slice(0, 36 * 48), slice(0, 36 * 48 + 100),
                                  slice(5000, 5100), slice(36 * 48 * 2, 36 * 48 * 3)])
def test_signals_are_not_joined_with_resets_of_another_frame(tmp_path: Path, lost: slice) -> None:
    """A recording that begins amid a frame, or lacks a part: some resets, all, or signals too."""
    light = np.random.default_rng(0).integers(0, 800, (3, 36, 48))
    words = [word for i, frame in enumerate(light)
             for word in aps(frame, 2000 + 50_000 * i, exposure=10_000)]
    at = lost.start // (36 * 48 * 2)  # the frame that is not whole
    del words[lost]
    got = read_recording(davis(tmp_path, [(EVENT, 0), *words]), size=SMALL)
    whole = [i for i in range(3) if i != at]
    assert got.frame_times.tolist() == [7235 + 50_000 * i for i in whole]
    np.testing.assert_allclose(got.frames, light[whole] * 255 / 1023, rtol=1e-6)
    assert texts(got.notes)[1] == "1 frames with missing samples were left out"


def test_aedat1_of_a_dvs128(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    path.write_bytes(b"#!AER-DAT1.0\r\n# a remark\r\n" + struct.pack(
        ">HIHI", 20 << 8 | 10 << 1, 5, 21 << 8 | 11 << 1 | 1, 9))
    assert listed(read_events(path)) == [(117, 107, 5, 1), (116, 106, 9, 0)]
    path.write_bytes(b"#!AER-DAT1.0\r\n# AEChip: a.Cochlea\r\n")
    assert refused(path).code == "EV008"


def test_samples_that_make_no_frame_cost_little(tmp_path: Path) -> None:
    """Columns in any order, so that thousands of frames begin; and signals without a reset."""
    rng = np.random.default_rng(0)
    n = 8_000
    address = (1 << 31 | rng.integers(0, 36, n) << 22 | rng.integers(0, 48, n) << 12
               | rng.integers(0, 2, n) << 10)
    words = [(EVENT, 0), *zip(address.tolist(), range(n), strict=True)]
    found = read_recording(davis(tmp_path, words), size=SMALL)
    assert not found.has_frames
    signals = [(word | 1 << 10, t) for word, t in words[1:]]
    found = read_recording(davis(tmp_path, [(EVENT, 0), *signals]), size=SMALL)
    assert not found.has_frames
    assert [note.code for note in found.notes] == ["frames.unused"]

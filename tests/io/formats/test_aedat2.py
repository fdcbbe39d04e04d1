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


def test_words_beside_the_events(tmp_path: Path) -> None:
    path = tmp_path / "a.aedat"
    words = [(1 << 31, 5), (1 << 31 | 1 << 10, 6), (0xC00 | 1 << 31, 7), (0x400, 8),
             (10 << 22 | 20 << 12 | 0x800, 9)]
    path.write_bytes(b"#!AER-DAT2.0\r\n# AEChip: DAVIS346B\r\n#End Of ASCII Header\r\n"
                     + b"".join(struct.pack(">2I", *w) for w in words))
    got = read_recording(path)
    assert listed(got.events) == [(345 - 20, 259 - 10, 9, 1)]
    assert got.events.size == (346, 260)
    assert tuple(texts(got.notes)) == ("2 APS samples were not read", "1 IMU samples were not read",
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

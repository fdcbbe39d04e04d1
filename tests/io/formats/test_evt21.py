"""EVT2.1: words of up to 32 events, the two orders of their halves, and what stands beside them."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from helpers.recordings import equal, refused
from helpers.streams import clustered, evt21, listed

from evflow.io import read_recording
from evflow.notes import Note

HEADERS = {  # name: text, whether upper halves come first, whether that is guessed
    "genx320": (b"% format EVT21;endianness=little;height=180;width=240\n% end\n", False, False),
    "imx636": (b"% format EVT21;height=180;width=240;endianness=legacy\n% end\n", True, False),
    "old": (b"% evt 2.1\n% geometry 240x180\n", False, True),
    "old imx636": (b"% evt 2.1\n% geometry 240x180\n", True, True),
    "no endianness": (b"% format EVT21;height=180;width=240\n% end\n", False, False),
    "odd": (b"% format EVT21;height=180;width=240\n% evt 2.1\n% end\n", True, True)}


@pytest.mark.parametrize("kind", HEADERS)
def test_both_orders_of_halves(tmp_path: Path, kind: str) -> None:
    header, legacy, guessed = HEADERS[kind]
    path = tmp_path / "a.raw"
    path.write_bytes(evt21(clustered(300), header, legacy))
    found = read_recording(path)
    equal(found.events, clustered(300))
    assert [note.code for note in found.notes] == ["events.layout"] * guessed


def test_bits_by_hand(tmp_path: Path) -> None:
    """Time high 3 and low 5: 3 * 64 + 5 us; bits 0, 7 and 31 from x = 64; a mask of none."""
    path = tmp_path / "a.raw"
    word = 64 << 43 | 100 << 32 | 5 << 54
    early = 1 << 60 | 3
    header = b"% format EVT21;endianness=little;height=320;width=320\n% end\n"
    path.write_bytes(header + struct.pack(
        "<6Q", early, 8 << 60 | 3 << 32, word | 1 << 60 | 1 << 31 | 1 << 7 | 1, word,
        0xA << 60, 0xE << 60 | 0x123456789))
    found = read_recording(path)
    assert listed(found.events) == [(x, 100, 197, 1) for x in (64, 71, 95)]
    assert found.events.size == (320, 320)
    assert found.notes[0].text.startswith("2 events before the first time")
    assert found.notes[1] == Note("events.unread", "external triggers (1) are no events: "
                                  "evflow estimate --protocol step --triggers uses them")


def test_size_by_the_name_of_the_sensor(tmp_path: Path) -> None:
    path = tmp_path / "a.raw"
    path.write_bytes(evt21(clustered(50), b"% evt 2.1\n% sensor_name GenX320\n"))
    assert read_recording(path).events.size == (320, 320)
    path.write_bytes(evt21(clustered(50), b"% evt 2.1\n"))
    assert refused(path).code == "EV015"


def test_events_beyond_the_sensor_are_told_with_their_byte(tmp_path: Path) -> None:
    path = tmp_path / "a.raw"
    data = evt21(clustered(50))
    path.write_bytes(data + struct.pack("<2Q", 8 << 60 | 1 << 50, 1 << 60 | 224 << 43 | 1 << 31))
    error = refused(path)
    assert error.code == "EV005"
    assert f"x=255, y=0 is outside 240x180, at byte {len(data) + 8:,}" in str(error)

"""EVT2: words beside the events, and the headers of Prophesee's files."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import equal, refused
from helpers.streams import clustered, evt2, evt3

from evflow.io import read_recording
from evflow.io.decode.prophesee import parse
from evflow.notes import Note
from evflow.types import Events


def test_words_beside_the_events(tmp_path: Path) -> None:
    """Triggers and vendor words are counted or passed over; events without a time are left out."""
    events = clustered(50)
    sound = evt2(events)
    header = sound.index(b"\n", sound.index(b"\n") + 1) + 1
    early = struct.pack("<3I", 1 << 28 | 5 << 11 | 6, 0xA0000100, 7 << 11 | 8)
    other = struct.pack("<2I", 0xE0000001, 0xF1234567)
    path = tmp_path / "a.raw"
    path.write_bytes(sound[:header] + early + sound[header:] + other)
    got = read_recording(path)
    equal(got.events, events)
    assert got.notes[0].text.startswith("2 events before the first time")
    assert got.notes[1] == Note("events.unread", "1 external triggers were not read")
    path.write_bytes(sound[:header] + early)  # and no time word at all
    assert len(read_recording(path).events) == 0


@pytest.mark.parametrize("kind", [2, 7, 9, 0xB, 0xD])
def test_undefined_word_is_told_with_its_byte(tmp_path: Path, kind: int) -> None:
    sound = evt2(clustered(50))
    path = tmp_path / "a.raw"
    path.write_bytes(sound + struct.pack("<I", kind << 28 | 0x123) + bytes(8))
    error = refused(path)
    assert error.code == "EV009"
    assert f"at byte {len(sound):,} of" in str(error)
    assert f"type {kind:#x}" in str(error)


@pytest.mark.parametrize(("text", "encoding", "size"), [
    (b"% evt 2.0\n% geometry 640x480\n", "EVT2", (640, 480)),
    (b"% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n", "EVT3", (1280, 720)),
    (b"% format EVT21;endianness=legacy;height=320;width=320\n", "EVT21", (320, 320)),
    (b"% evt 2.0\r\n% plugin_name hal_plugin_gen31_fx3\r\n", "EVT2", (640, 480)),
    (b"% evt 3.0\n% sensor_name IMX636\n", "EVT3", (1280, 720)),
    (b"% evt 3.0\n% generation 4.2\n", "EVT3", (1280, 720)),
    (b"% evt 3.0\n% geometry wide\n% system_ID 99\n", "EVT3", None),
    (b"% Height 240\n% Width 304\n", "", (304, 240)),
    (b"nothing", "", None)])
def test_headers(text: bytes, encoding: str, size: tuple[int, int] | None) -> None:
    header = parse(text + b"\x70\x50\x00\x80")
    assert (header.encoding, header.size()[0]) == (encoding, size)
    assert header.start == (0 if text == b"nothing" else len(text))


def test_data_that_begins_like_a_header_line(tmp_path: Path) -> None:
    """The first word 0x80000025 begins with `%`; `% % end` closes the header either way."""
    events = Events([3], [4], [0x25 << 6 | 9], [1], (240, 180))
    path = tmp_path / "a.raw"
    for end in (b"", b"% end\n"):
        path.write_bytes(evt2(events, b"% evt 2.0\n% geometry 240x180\n" + end))
        assert path.read_bytes()[29 + len(end)] == ord("%")
        equal(read_recording(path).events, events)


def test_other_encodings_and_sizes(tmp_path: Path) -> None:
    path = tmp_path / "a.raw"
    path.write_bytes(b"% evt 2.1\n\0\0\0\0")
    error = refused(path)
    assert error.code == "EV008"
    assert "EVT2.1" in str(error)
    path.write_bytes(evt2(clustered(50), b"% evt 2.0\n"))
    error = refused(path)
    assert error.code == "EV015"
    assert "events reach x=" in str(error)
    equal(read_recording(path, size=(240, 180)).events, clustered(50))
    path.write_bytes(b"% evt 2.0\n% geometry 99999x1\n")
    assert refused(path).code == "EV020"


@pytest.mark.parametrize(("encode", "word"), [(evt2, 4), (evt3, 2)])
def test_big_endian_words(
    tmp_path: Path, encode: Callable[[Events, bytes], bytes], word: int
) -> None:
    name = encode.__name__.upper().encode()
    events = clustered(100)
    data = np.frombuffer(encode(events, b""), f"<u{word}")
    path = tmp_path / "a.raw"
    path.write_bytes(b"% format " + name + b";height=180;width=240;endianness=big\n% end\n"
                     + data.astype(f">u{word}").tobytes())
    equal(read_recording(path).events, events)

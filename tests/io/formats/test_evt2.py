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
    assert got.notes[1] == Note("events.unread", "external triggers (1) are no events: "
                                "evflow estimate --protocol step --triggers uses them")
    path.write_bytes(sound[:header] + early)  # and no time word at all
    assert len(read_recording(path).events) == 0


@pytest.mark.parametrize(("encode", "bits", "kinds"), [
    (evt2, 32, (2, 7, 9, 0xB, 0xD)), (evt3, 16, (1, 9, 0xB, 0xC, 0xD))])
def test_reserved_words_are_skipped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encode: Callable[..., bytes], bits: int,
    kinds: tuple[int, ...]
) -> None:
    """Anywhere among the words, one by one or a page of padding, over chunk borders."""
    events = clustered(400)
    sound, rng = np.frombuffer(encode(events, b""), f"<u{bits // 8}"), np.random.default_rng(0)
    pad = (0x9999999 << 4 | 9) >> (32 - bits)  # 0x9999, 0x99999999
    one = [kind << (bits - 4) | int(rng.integers(256)) for kind in kinds]
    path = tmp_path / "a.raw"
    for words in ([pad], one, [pad] * 5000):
        monkeypatch.setattr("evflow.io.decode.stream.CHUNK", 1000 if len(words) < 9 else 1 << 18)
        data = np.insert(sound, np.sort(rng.integers(0, len(sound), len(words))), words)
        path.write_bytes(encode(clustered(0)) + data.astype(sound.dtype).tobytes())
        got = read_recording(path)
        equal(got.events, events)
        assert [note.code for note in got.notes] == ["events.unread"]
        assert got.notes[0].text.startswith(f"{len(words):,} words of types that EVT")
    assert f"({pad:#x}, ...)" in got.notes[0].text


@pytest.mark.parametrize(("encode", "bits"), [(evt2, 32), (evt3, 16)])
def test_many_reserved_words_are_damage(
    tmp_path: Path, encode: Callable[..., bytes], bits: int
) -> None:
    sound = encode(clustered(50))
    junk = [(9 + 2 * (i % 2)) << (bits - 4) | i for i in range(60)]
    path = tmp_path / "a.raw"
    path.write_bytes(sound + np.array(junk, f"<u{bits // 8}").tobytes())
    error = refused(path)
    assert error.code == "EV009"
    assert f"at byte {len(sound):,} of" in str(error)
    assert "type 0x9" in str(error)
    equal(read_recording(path, partial=True).events, clustered(50))


@pytest.mark.parametrize(("text", "encoding", "size"), [
    (b"% evt 2.0\n% geometry 640x480\n", "EVT2", (640, 480)),
    (b"% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n", "EVT3", (1280, 720)),
    (b"% format EVT21;endianness=legacy;height=320;width=320\n", "EVT2.1", (320, 320)),
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
    path.write_bytes(b"% format HISTO3D;height=320;width=320\n\0\0\0\0")
    error = refused(path)
    assert error.code == "EV008"
    assert "HISTO3D" in str(error)
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

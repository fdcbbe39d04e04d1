"""AEDAT4: mid-exposure times, damage, streams."""

from __future__ import annotations

import builtins
import struct
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import fuzz_aedat4
from helpers.fuzz_aedat4 import STREAM, XML
from helpers.recordings import T0, damage, equal, make, refused, survives

from evflow.errors import EvflowDataError
from evflow.io import read_events, read_recording, write_events
from evflow.types import Events

HEADER_XML = b'<dv version="2.0"></dv>'
HEADER = (b"\x18\0\0\0IOHE\0\0\0\0\0\0\x0a\0\x14\0\x04\0\x0c\0\x08\0\x0a\0\0\0\0\0\0\0\x0c\0\0\0"
          + bytes(8) + len(HEADER_XML).to_bytes(4, "little") + HEADER_XML)
AEDAT4 = b"#!AER-DAT4.0\r\n" + len(HEADER).to_bytes(4, "little") + HEADER


def fake_aedat(monkeypatch: pytest.MonkeyPatch, packets: list[Any], **streams: Any) -> None:
    """A decoder in the shape of aedat.Decoder, to reach what no recording at hand contains."""

    class Decoder:
        def __init__(self, path: str) -> None: ...

        def id_to_stream(self) -> dict[int, dict]:
            size = {"width": 64, "height": 48}
            kinds = streams or {"a": "events", "b": "frame"}
            return {i: {"type": kind, **size} for i, kind in enumerate(kinds.values())}

        def __iter__(self) -> Any:
            for packet in packets:
                if isinstance(packet, BaseException):
                    raise packet
                yield packet

    monkeypatch.setitem(sys.modules, "aedat", types.SimpleNamespace(Decoder=Decoder))


def packet_of(events: Events) -> dict[str, Any]:
    kind = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
    table = np.zeros(len(events), kind)
    for name in "txyp":
        table[name] = getattr(events, name)
    return {"stream_id": 0, "events": table}


def frame_packet(t: int, pixels: np.ndarray, **times: int) -> dict[str, Any]:
    zero = dict.fromkeys(("begin_t", "end_t", "exposure_begin_t", "exposure_end_t"), 0)
    return {"stream_id": 1, "frame": {"t": t, "pixels": pixels, **zero, **times}}


def test_aedat4_frames_lie_at_mid_exposure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, recording = tmp_path / "a.aedat4", make()
    path.write_bytes(AEDAT4)
    pixels = recording.frames[0]
    fake_aedat(monkeypatch, [
        packet_of(recording.events), frame_packet(T0, pixels),
        frame_packet(T0, pixels, begin_t=T0 + 10, end_t=T0 + 30),
        frame_packet(T0, pixels, begin_t=1, end_t=2, exposure_begin_t=T0 + 40,
                     exposure_end_t=T0 + 80)])
    got = read_recording(path)
    equal(got.events, recording.events)
    assert (got.frame_times - T0).tolist() == [0, 20, 60]
    assert got.exposure_us == 0  # most frames have none
    red = np.zeros((48, 64, 3), np.uint8)
    red[..., 0] = 255
    fake_aedat(monkeypatch, [packet_of(recording.events), frame_packet(T0, red)])
    got = read_recording(path)
    assert got.frames[0, 0, 0] == round(0.299 * 255)
    assert len(got.notes) == 2


def test_aedat4_exposure_is_the_frames_median(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, recording = tmp_path / "a.aedat4", make()
    path.write_bytes(AEDAT4)
    fake_aedat(monkeypatch, [packet_of(recording.events), *(
        frame_packet(T0, recording.frames[0], exposure_begin_t=t, exposure_end_t=t + length)
        for t, length in ((T0, 8000), (T0 + 20_000, 8200), (T0 + 40_000, 12_000)))])
    got = read_recording(path)
    assert got.exposure_us == 8200
    assert any("exposed for 8.2 ms, as the file says" in n.text for n in got.notes)


def test_aedat4_exposures_up_to_zero_count_if_the_frame_is_at_their_middle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, recording = tmp_path / "a.aedat4", make()
    path.write_bytes(AEDAT4)
    for t, begin, end, exposure_us in ((500, -2000, 3001, 5001), (0, -2000, 2001, 4001),
                                       (9000, 0, 5000, 0), (9000, -1, -1, 0), (0, 0, 0, 0)):
        events = packet_of(recording.events)
        events["events"]["t"] -= T0
        fake_aedat(monkeypatch, [events, frame_packet(
            t, recording.frames[0], exposure_begin_t=begin, exposure_end_t=end)])
        got = read_recording(path)
        assert (got.frame_times.tolist(), got.exposure_us) == ([t], exposure_us)


@pytest.mark.parametrize(("old", "new"), [
    (b"</dv>", b"</\xdav>"), (b'"2.0"', b'"2.\xda"'),  # on such bytes the decoder aborts
    (b"</dv>", b"</dw>"), (b"DAT4.0", b"DAT4.9"), (b"\x0c\0\x08\0\x0a", b"\x0c\0\xff\0\x0a")])
def test_aedat4_header_is_checked_before_the_decoder_sees_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: bytes, new: bytes
) -> None:
    fake_aedat(monkeypatch, [packet_of(make().events)])
    path = tmp_path / "a.aedat4"
    path.write_bytes(AEDAT4)
    assert len(read_events(path)) == 2000
    assert old in AEDAT4
    for damaged in (AEDAT4.replace(old, new), AEDAT4[:-3], AEDAT4[:15]):
        path.write_bytes(damaged)
        assert "header" in str(refused(path))


class PanicError(BaseException):
    """What a Rust panic looks like from Python: not an Exception."""


@pytest.mark.parametrize("damage", [RuntimeError("failed to fill whole buffer"), PanicError("x")])
def test_aedat4_damage_matters_only_before_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: BaseException
) -> None:
    path, events = tmp_path / "a.aedat4", make().events
    path.write_bytes(AEDAT4 + b"\0\0\0\0\4\0\0\0abcd" + b"\0\0\0\0\x40\0\0\0cut")
    fake_aedat(monkeypatch, [packet_of(events.slice(T0, T0 + 200_000)), damage])
    error = refused(path)
    assert error.code == "EV009"
    assert f"at byte {len(AEDAT4) + 12:,} of {len(AEDAT4) + 23:,}: " in str(error)
    stop = float(error.fix.split("stop_s=")[1].split()[0])
    assert 0.19 < stop <= 0.2
    equal(read_events(path, stop_s=stop), events.slice(T0, int(events.t[0]) + round(stop * 1e6)))
    fake_aedat(monkeypatch, [KeyboardInterrupt()])
    with pytest.raises(KeyboardInterrupt):
        read_recording(path)


def test_aedat4_frames_that_come_late_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They lie behind events of a later time, and behind the event at which reading stops."""
    monkeypatch.setattr("evflow.io.decode.tables.ROWS", 100)
    path, events = tmp_path / "a.aedat4", make().events
    path.write_bytes(AEDAT4)
    parts = [events.slice(T0 + k * 50_000, T0 + (k + 1) * 50_000) for k in range(6)]
    pixels = make().frames[0]
    fake_aedat(monkeypatch, [*map(packet_of, parts[:4]), frame_packet(T0 + 40_000, pixels),
                             packet_of(parts[4]), frame_packet(T0 + 150_000, pixels),
                             RuntimeError("cut off")])
    got = read_recording(path, stop_s=0.1)
    equal(got.events, events.slice(T0, int(events.t[0]) + 100_000))
    assert (got.frame_times - T0).tolist() == [40_000]
    assert len(read_recording(path, partial=True).frames) == 2


def test_aedat4_without_events_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.aedat4").write_bytes(AEDAT4)
    fake_aedat(monkeypatch, [], a="imus")
    assert refused(tmp_path / "a.aedat4").code == "EV008"


@pytest.mark.parametrize("kind", ["aedat4", "dsec"])
def test_missing_package_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    (tmp_path / "a.aedat4").write_bytes(AEDAT4)
    write_events(tmp_path / "a.dsec", make().events)
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name in ("aedat", "h5py"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    error = refused(tmp_path / f"a.{kind}")
    assert error.code == "EV010"
    assert "evflow-jax[io]" in str(error)


def test_real_davis346_aedat4(data_file: Callable[[str], Path]) -> None:
    pytest.importorskip("aedat")
    got = read_recording(data_file("data/recordings/newton_cradle_davis346.aedat4"))
    assert (len(got.events), got.events.size) == (319_512, (346, 260))
    assert (got.events.t[0], got.events.t[-1]) == (1643243628737093, 1643243629248083)
    assert got.events.p.mean() == pytest.approx(0.5218, abs=5e-5)
    assert got.frames.shape == (13, 260, 346)
    assert got.frame_times[0] == 1643243628757800 + 10_000  # 20 ms exposure
    assert set(np.diff(got.frame_times)) == {40_000}


def test_damaged_aedat4_only_raises_data_errors(
    data_file: Callable[[str], Path], tmp_path: Path
) -> None:
    pytest.importorskip("aedat")
    path = tmp_path / "a.aedat4"
    path.write_bytes(data_file("data/formats/dvxplorer320.aedat4").read_bytes())
    damage(path, 120, lambda: survives(path))


def test_the_decoder_never_meets_what_it_aborts_on(tmp_path: Path) -> None:
    """It skips a frame of unknown kind and reads the next packet in the same step: one that claims
    2 GB."""
    pytest.importorskip("aedat")
    recording = make()
    xml = XML.format(STREAM.format(0, "EVTS") + STREAM.format(1, "FRME"))
    frame = bytearray(fuzz_aedat4.frame_packet(recording.frames[0], T0))
    frame[36 + 56] = 197  # its format, in the table at byte 36
    sound = (fuzz_aedat4.header(xml)
             + fuzz_aedat4.packet(0, fuzz_aedat4.event_packet(recording.events))
             + fuzz_aedat4.packet(1, bytes(frame)))
    path = tmp_path / "a.aedat4"
    path.write_bytes(sound + struct.pack("<ii", 1, 2_000_000_000) + bytes(100))
    with pytest.raises(EvflowDataError, match=rf"EV009.*byte {len(sound):,}"):
        read_recording(path)
    got = read_recording(path, partial=True)
    equal(got.events, recording.events)
    assert any("left something out" in note.text for note in got.notes)

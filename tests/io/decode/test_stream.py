"""Binary event streams (EVT2, EVT3, DAT, AEDAT2): files written by plain loops come back exactly,
over chunk borders, wraparounds and cut tails; damage only raises data errors and names its byte.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import damage, equal, refused
from helpers.streams import (
    ENCODERS,
    SIZE,
    TURN,
    clustered,
    each,
    survives,
    write,
)

from evflow.io import read_events, read_recording
from evflow.io.decode.stream import Clock
from evflow.io.registry import find_format
from evflow.types import Events


@each
@pytest.mark.parametrize("chunk", [8, 24, 1000, 1 << 18])
def test_round_trip_over_chunk_borders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, chunk: int
) -> None:
    path, events = write(tmp_path, kind, clustered()), clustered()
    monkeypatch.setattr("evflow.io.decode.stream.CHUNK", chunk)
    assert kind == find_format(path).NAME
    equal(read_events(path), events)


@each
@pytest.mark.parametrize("chunk", [16, 1 << 18])
def test_wraparound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, chunk: int
) -> None:
    """Three turns of the counter, with silences of up to 0.45 turns."""
    monkeypatch.setattr("evflow.io.decode.stream.CHUNK", chunk)
    turn = TURN[kind]
    bursts = [clustered(60, first, 50) for first in
              (turn - 700, turn - 1 + turn * 4 // 10, turn + turn * 8 // 10, 2 * turn - 300,
               turn * 24 // 10, turn * 28 // 10)]
    events = Events.concatenate(bursts)
    equal(read_events(write(tmp_path, kind, events)), events)


@pytest.mark.parametrize("kind", [kind for kind in ENCODERS if kind != "aedat3"])
def test_cut_tails(tmp_path: Path, kind: str) -> None:
    """A cut at a word reads a prefix; one inside a word is told, with the part that is sound. The
    packets of AEDAT 3 say how long they are."""
    events = clustered(300)
    path = write(tmp_path, kind, events)
    source = path.read_bytes()
    word = {"evt2": 4, "evt3": 2}.get(kind, 8)
    for lost in range(1, 41):
        path.write_bytes(source[:-lost])
        if lost % word == 0:
            got = read_events(path)
            equal(got, Events(*(getattr(events, c)[: len(got)] for c in "xytp"), SIZE))
            assert len(events) - lost * 6 <= len(got) <= len(events)
            continue
        error = refused(path)
        assert error.code == "EV009"
        at = len(source) - lost - (len(source) - lost - len(source) % word) % word
        assert f"at byte {at:,} of {len(source) - lost:,}" in str(error)
        stop = float(re.findall(r"stop_s=([\d.]+)", error.fix)[0])
        first = int(events.t[0])
        equal(read_events(path, stop_s=stop), events.slice(first, first + round(stop * 1e6)))


@each
def test_hints(tmp_path: Path, kind: str) -> None:
    events = clustered(2000)
    path, first = write(tmp_path, kind, events), int(events.t[0])
    equal(read_events(path, start_s=0.002, stop_s=0.01),
          events.slice(first + 2000, first + 10_000))
    equal(read_events(path, start_s=0.002), events.slice(first + 2000, 2**40))
    np.testing.assert_array_equal(read_events(path, polarity="invert").p, ~events.p)
    np.testing.assert_array_equal(read_events(path, time_unit="ns").t, (events.t + 500) // 1000)
    assert refused(path, start_s=100).code == "EV001"
    assert f"0.000 to {events.duration_us / 1e6:.3f} s" in str(refused(path, start_s=100))
    assert refused(path, size=(100, 50)).code == "EV005"
    if kind != "aedat2":  # there it is also the origin of x and y
        assert read_events(path, size=(1000, 900)).size == (1000, 900)


@each
def test_stop_reads_no_further(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr("evflow.io.decode.stream.CHUNK", 64)
    events = clustered(2000)
    path, first = write(tmp_path, kind, events), int(events.t[0])
    data = bytearray(path.read_bytes())
    half = len(data) // 2
    data[half:] = (b"\x11\x11\x11\xd1" * len(data))[: len(data) - half]
    path.write_bytes(bytes(data))
    stop = (int(events.t[300]) - first) / 1e6
    equal(read_events(path, stop_s=stop), events.slice(first, int(events.t[300])))
    assert refused(path).code in ("EV004", "EV005", "EV009")


@each
def test_time_that_goes_back_is_told_with_its_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    early, late = clustered(50, 1000), clustered(50, 5_000_000)
    path = write(tmp_path, kind, late)
    sound, extra = path.read_bytes(), ENCODERS[kind](early, b"")
    if kind == "dat":
        extra = extra[2:]
    path.write_bytes(sound + extra)
    for chunk in (16, 1 << 18):
        monkeypatch.setattr("evflow.io.decode.stream.CHUNK", chunk)
        error = refused(path)
        assert error.code == "EV004"
        byte = int(re.findall(r"at byte ([\d,]+) of", str(error))[0].replace(",", ""))
        assert len(sound) <= byte < len(sound) + 40  # behind the header of a packet
        assert "50 events" in str(error)
        assert "joined" in error.fix


@each
def test_event_outside_the_sensor_is_told_with_its_byte(tmp_path: Path, kind: str) -> None:
    events = clustered(100)
    far = Events([300], [100], [events.t[-1] + 5], [1], (640, 480))
    path = tmp_path / "a"
    sound = ENCODERS[kind](events)
    extra = ENCODERS[kind](far, b"") if kind != "aedat2" else struct.pack(
        ">2I", 100 << 22 | 300 << 12, int(far.t[0]))
    path.write_bytes(sound + (extra[2:] if kind == "dat" else extra))
    error = refused(path)
    assert error.code == "EV005"
    assert f"byte {path.stat().st_size - {'evt2': 4, 'evt3': 2}.get(kind, 8):,}" in str(error)
    assert "--size WxH" in error.fix


@each
def test_header_alone_is_a_silent_camera(tmp_path: Path, kind: str) -> None:
    assert len(read_events(write(tmp_path, kind, clustered(0)))) == 0


@each
def test_damaged_copies_only_raise_data_errors(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind, clustered(500))
    damage(path, 200, lambda: survives(path))


@each
def test_memory_is_bounded_by_the_file(tmp_path: Path, kind: str) -> None:
    """Noise behind a sound header: 12 events of 13 bytes in 2 bytes, one column twice."""
    import tracemalloc
    rng = np.random.default_rng(1)
    path = tmp_path / "a"
    header = ENCODERS[kind](clustered(0))
    path.write_bytes(header + rng.integers(0, 256, 100_000, dtype=np.uint8).tobytes())
    survives(path)
    tracemalloc.start()
    survives(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 126 * path.stat().st_size + (1 << 20)


@pytest.mark.parametrize(("name", "count", "size", "first", "last", "on"), [
    ("evt2_sample.raw", 539_481, (640, 480), 1_317_888, 1_367_888, 0.682),
    ("evt3_sample.raw", 219_596, (1280, 720), 11_718_656, 11_727_457, 0.526),
    ("davis240_aedat2.aedat", 162_771, (240, 180), 294_976_755, 297_049_406, 0.510)])
def test_real_recordings(
    data_file: Callable[[str], Path], name: str, count: int, size: tuple[int, int], first: int,
    last: int, on: float
) -> None:
    got = read_recording(data_file(f"data/formats/{name}"))
    assert (len(got.events), got.events.size) == (count, size)
    assert (got.events.t[0], got.events.t[-1]) == (first, last)
    assert got.events.p.mean() == pytest.approx(on, abs=5e-4)
    assert got.notes


@pytest.mark.parametrize("name", ["evt2_sample.raw", "evt3_sample.raw", "davis240_aedat2.aedat"])
def test_real_recording_does_not_depend_on_chunks(
    data_file: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = data_file(f"data/formats/{name}")
    want = read_events(path)
    monkeypatch.setattr("evflow.io.decode.stream.CHUNK", 10_008)
    equal(read_events(path), want)


def test_clock_continues_and_steps_back() -> None:
    clock = Clock(4)
    assert clock.unwrap(np.array([14, 15, 1, 7], np.uint32)).tolist() == [14, 15, 17, 23]
    assert clock.unwrap(np.array([], np.uint32)).tolist() == []
    assert clock.unwrap(np.array([14, 4, 3], np.uint32)).tolist() == [30, 36, 35]

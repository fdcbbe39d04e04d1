"""Latency of made-up answers to steps, and triggers from files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.fuzz_aedat4 import STREAM, XML, header

from evflow import Events, EvflowDataError
from evflow.estimation.bench.latency import measured_latency
from evflow.io.formats.write_aedat4 import VERSION, _buffer, _header
from evflow.io.triggers import read_triggers

SPANS = [(i * 400_000, i * 400_000 + 300_000) for i in range(5)]  # dark and light in turns
LOGS = np.array([3.0, 4.0, 3.0, 4.0, 3.0])
SIZE = (20, 10)
EDGES = [end + 40_000 for _, end in SPANS[:-1]]


def answers(delays: list[int], jitter: int) -> Events:
    """Every pixel answers each step after its delay, evenly spread by up to jitter to both sides,
    and again 9 ms later; before each step there is one event of the wrong direction."""
    pixel = np.arange(SIZE[0] * SIZE[1])
    late = np.linspace(-jitter, jitter, pixel.size).round().astype(int)
    t, p, which = [], [], []
    for k, (edge, delay) in enumerate(zip(EDGES, delays, strict=True)):
        up, answer = k % 2 == 0, edge + delay + late
        for when, on in ((np.full(pixel.size, edge - 500), not up), (answer, up),
                         (answer + 9000, up)):
            t.append(when)
            p.append(np.full(pixel.size, on))
            which.append(pixel)
    t, p, which = map(np.concatenate, (t, p, which))
    order = np.argsort(t, kind="stable")
    return Events(which[order] % SIZE[0], which[order] // SIZE[0], t[order], p[order], SIZE)


def latency(events: Events, triggers: list[int], kept: np.ndarray | None = None):
    ends = [begin + 20_000 for begin, _ in SPANS]
    return measured_latency(events, triggers, SPANS, ends, np.exp(LOGS), LOGS,
                            np.ones(SIZE[::-1], bool) if kept is None else kept)


def test_kinds_of_steps_are_told_apart() -> None:
    down, up = latency(answers([3000, 7000, 3400, 7000], 1000), EDGES)
    assert (up.change, up.light, up.steps, up.responded) == (1.0, pytest.approx(np.exp(4)), 2, 1.0)
    assert up.seconds == pytest.approx(3.2e-3, abs=5e-5)
    assert up.std_s == pytest.approx(0.2e-3, abs=5e-6)  # of two repetitions .4 ms apart
    assert down.seconds == pytest.approx(7e-3, abs=2e-5)
    assert down.jitter_s == pytest.approx(0.68e-3, abs=2e-5)  # of 2 ms, evenly filled
    assert down.std_s == pytest.approx(0.0, abs=1e-9)


def test_hot_pixels_and_steps_without_a_trigger_do_not_count() -> None:
    kept = np.zeros(SIZE[::-1], bool)
    kept[0, 0] = True
    (up,) = latency(answers([3000] * 4, 1000), EDGES[:1], kept)
    assert up.seconds == pytest.approx(2e-3)  # that pixel's own
    assert (up.steps, up.std_s, up.jitter_s) == (1, None, 0.0)


def test_triggers_elsewhere_are_refused() -> None:
    with pytest.raises(EvflowDataError, match=r"EV012.*none of 1 triggers"):
        latency(answers([3000] * 4, 10), [200_000])


def raw(tmp_path: Path, encoding: str) -> Path:
    """Triggers at 3 * 4096 + 70 and + 4000 us; EVT2's low bits are 6, so are EVT2.1's."""
    times, at = (3 * 4096 + 70, 3 * 4096 + 4000), tmp_path / "a.raw"
    head = f"% format {encoding};height=10;width=20\n% end\n"
    if encoding == "EVT3":
        body = [struct.pack("<3H", 8 << 12 | t >> 12, 6 << 12 | t & 4095, 0xA << 12 | 1)
                for t in times]
    elif encoding == "EVT2":
        body = [struct.pack("<2I", 8 << 28 | t >> 6, 0xA << 28 | (t & 63) << 22 | 1)
                for t in times]
    else:
        head = head.replace(";", ";endianness=little;", 1)
        body = [struct.pack("<2Q", 8 << 60 | (t >> 6) << 32, 0xA << 60 | (t & 63) << 54 | 1 << 32)
                for t in times]
    at.write_bytes(head.encode() + b"".join(body))
    return at


@pytest.mark.parametrize("encoding", ["EVT2", "EVT21", "EVT3"])
def test_trigger_events_of_raw(tmp_path: Path, encoding: str) -> None:
    found = read_triggers(raw(tmp_path, encoding), answers([10] * 4, 1))
    assert found.tolist() == [3 * 4096 + 70, 3 * 4096 + 4000]


def told(stream: int, times: list[int], sources: list[int]) -> bytes:
    """A packet of AEDAT 4 with triggers."""
    count = len(times)
    kind = np.dtype({"names": ["vtable", "source", "t"], "formats": ["<i4", "<i1", "<i8"],
                     "offsets": [0, 4, 8], "itemsize": 16})
    rows = np.zeros(count, kind)
    begin = (4 * count + 7) // 8 * 8  # of the vtable, behind the offsets
    rows["vtable"] = 16 + 16 * np.arange(count)
    rows["t"], rows["source"] = times, sources
    offsets = (begin + 16 + 12 * np.arange(count)).astype("<u4").tobytes().ljust(begin, b"\0")
    vtable = struct.pack("<4H", 8, 16, 8, 4).ljust(16, b"\0")
    packet = _buffer(b"TRIG", [], count, offsets + vtable + rows.tobytes())
    return struct.pack("<2i", stream, len(packet)) + packet


def test_trigger_events_of_aedat4(tmp_path: Path) -> None:
    """Edges of an external signal, not the clock's reset, nor the frames' own."""
    pytest.importorskip("aedat")
    packet = told(1, [10, 340_000, 350_000, 360_000, 740_000], [0, 1, 2, 8, 3])
    path = tmp_path / "a.aedat4"
    whole = VERSION + _header(SIZE, -1).replace(b"FRME", b"TRIG") + packet
    path.write_bytes(whole)
    events = answers([10] * 4, 1)
    assert read_triggers(path, events).tolist() == [340_000, 350_000, 740_000]
    path.write_bytes(whole + packet[:58])  # cut off
    assert len(read_triggers(path, events)) == 3


@pytest.mark.parametrize(("differs", "values", "camera"), [
    ("camera", "left left right right", "capture/EVTS/2"),
    ("capture", "left left right right", "right/EVTS"), ("capture", "a b c d", "c/EVTS")])
def test_triggers_of_one_camera_of_aedat4(
    tmp_path: Path, differs: str, values: str, camera: str
) -> None:
    """By the cameras' names in the header or the modules of DV; that neither tells is said."""
    pytest.importorskip("aedat")
    streams = enumerate(zip(("EVTS", "TRIG") * 2, values.split(), strict=True))
    xml = "".join(STREAM.format(i, kind).replace(f">{differs}<", f">{value}<")
                  for i, (kind, value) in streams)
    path = tmp_path / "a.aedat4"
    path.write_bytes(header(XML.format(xml)) + told(1, [340_000], [1]) + told(3, [740_000], [1]))
    events = answers([10] * 4, 1)
    if camera == "c/EVTS":
        with pytest.raises(EvflowDataError, match=r"EV001.*b/TRIG, d/TRIG.*c/EVTS"):
            read_triggers(path, events, camera)
        return
    assert read_triggers(path, events).tolist() == [340_000]
    assert read_triggers(path, events, camera).tolist() == [740_000]


@pytest.mark.parametrize(("text", "found"), [
    ("# edges\n0.34\n0.74\n", [340_000, 740_000]), ("340,rising\n740,falling\n1140\n", [
        340_000, 740_000, 1_140_000]),
    ("time_us edge\n340000 1\n740000 0\n", [340_000, 740_000])], ids=["s", "ms", "us"])
def test_times_of_a_file(tmp_path: Path, text: str, found: list[int]) -> None:
    path = tmp_path / "edges.txt"
    path.write_text(text)
    assert read_triggers(path, answers([10] * 4, 1)).tolist() == found


@pytest.mark.parametrize(("text", "code"), [
    ("", "EV001"), ("a\nb\n", "EV008"), ("-5\n-3\n", "EV012"), ("nan\n1\n", "EV007")])
def test_files_without_instants(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "edges.txt"
    path.write_text(text)
    with pytest.raises(EvflowDataError, match=code):
        read_triggers(path, answers([10] * 4, 1))


def test_raw_without_triggers(tmp_path: Path) -> None:
    path = tmp_path / "b.raw"
    path.write_bytes(b"% format EVT3;height=10;width=20\n% end\n" + struct.pack("<H", 8 << 12))
    with pytest.raises(EvflowDataError, match=r"EV001.*no trigger events"):
        read_triggers(path, answers([10] * 4, 1))


@pytest.mark.parametrize("unit", ["us", "ns", "s"])
def test_triggers_of_a_minute_beside_a_second_keep_their_unit(tmp_path: Path, unit: str) -> None:
    times = 2_000_000 * np.arange(30)
    at = tmp_path / "triggers.txt"
    at.write_text("\n".join({"us": f"{t}", "ns": f"{1000 * t}", "s": f"{1e-6 * t:.3f}"}[unit]
                            for t in times))
    t = np.arange(0, 1_000_000 if unit != "ns" else 59_000_000, 1000)
    found = read_triggers(at, Events(t % 4, t % 3, t, t % 2, (4, 3)))
    np.testing.assert_array_equal(found, times)

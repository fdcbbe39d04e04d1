"""ROS 1 bags: messages packed field by field come back exactly; damage only raises data errors."""

from __future__ import annotations

import builtins
import itertools
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import SIZE, damage, equal, make, refused
from test_io_stream import evt3, survives

from evflow.io import libcaer_words, read_events, read_recording
from evflow.io.messages import Packet
from evflow.io.stream import Damage
from evflow.types import Events, Recording

ARRAY, PACKET, IMAGE = ("dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket",
                        "sensor_msgs/msg/Image")
needs_rosbags = pytest.mark.skipif(
    __import__("importlib.util").util.find_spec("rosbags") is None,
    reason="the package rosbags is not installed")
Messages = list[tuple[str, str, int, bytes]]  # topic, type, time in ns, bytes


def header(ns: int) -> bytes:
    return struct.pack("<3I", 7, ns // 10**9, ns % 10**9) + struct.pack("<I", 3) + b"cam"


def split(events: Events, n: int = 5) -> list[Events]:
    cuts = np.linspace(events.t[0], events.t[-1] + 1, n + 1).astype(int)
    return [events.slice(int(a), int(b)) for a, b in itertools.pairwise(cuts)]


def rows(events: Events) -> list[tuple[int, int, int, int]]:
    return [(int(x), int(y), int(t), int(p))
            for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True)]


def array_messages(events: Events, topic: str = "/dvs/events") -> Messages:
    out: Messages = []
    for part in split(events):
        data = b"".join(struct.pack("<2H2IB", x, y, t // 10**6, t % 10**6 * 1000, p)
                        for x, y, t, p in rows(part))
        ns = int(part.t[0]) * 1000
        out.append((topic, ARRAY, ns, header(ns) + struct.pack("<2I", SIZE[1], SIZE[0])
                    + struct.pack("<I", len(part)) + data))
    return out


def compressed(events: Events, start: int) -> bytes:
    """Words of libcaer_cmp, times since start: neighbours of a column in one vector."""
    words, left = [], rows(events)
    high = low = column = -1
    while left:
        x, y, t, p = left.pop(0)
        if (t - start) >> 12 != high:
            high = (t - start) >> 12
            words.append(high)
        if (t - start) & 0xFFF != low:
            low = (t - start) & 0xFFF
            words.append(0x1000 | low)
        if x != column:
            column = x
            words.append(0x2000 | x)
        mask, top = 1, y
        while left and left[0][0] == x and left[0][2:] == (t, p) and top < left[0][1] < y + 8:
            top = left.pop(0)[1]
            mask |= 1 << (top - y)
        words += [0x3000 | p << 11 | y] if mask == 1 else [0x4000 | p << 11 | y, 0x5000 | mask]
    return struct.pack(f"<{len(words)}H", *words)


def packet_messages(events: Events, encoding: str) -> Messages:
    out: Messages = []
    payload = evt3(events, b"")
    for i, part in enumerate(split(events)):
        base, ns = int(part.t[0]) * 1000 - 5_000_000, int(part.t[0]) * 1000
        if encoding == "evt3":  # cut anywhere: states carry over
            n = len(payload) // 2 // 5 * 2
            data = payload[i * n : (i + 1) * n if i < 4 else None]
        elif encoding == "mono":
            data = b"".join(struct.pack("<Q", p << 63 | y << 48 | x << 32 | (t * 1000 - base))
                            for x, y, t, p in rows(part))
        elif encoding == "libcaer_cmp":
            data = compressed(part, base // 1000)
        else:
            start = 2**31 - 10_000  # wraps inside the packet
            data = b"".join(struct.pack(
                "<2I", x << 17 | y << 2 | p << 1 | 1, (t - int(part.t[0]) + start) % 2**31)
                for x, y, t, p in rows(part))
            base = ns - start * 1000
        out.append(("/cam/events", PACKET, ns, header(ns) + struct.pack(
            "<2I2QI", SIZE[1], SIZE[0], i, base, len(encoding)) + encoding.encode() + b"\0"
            + struct.pack("<I", len(data)) + data))
    return out


def image_messages(recording: Recording, topic: str = "/dvs/image_raw") -> Messages:
    out: Messages = []
    for frame, t in zip(recording.frames, recording.frame_times, strict=True):
        padded = np.zeros((48, 70), np.uint8)  # rows may be longer than the image
        padded[:, :64] = frame
        out.append((topic, IMAGE, int(t) * 1000, header(int(t) * 1000) + struct.pack(
            "<3I", 48, 64, 5) + b"mono8" + struct.pack("<B2I", 0, 70, 48 * 70)
            + padded.tobytes()))
    return out


def write(path: Path, messages: Messages, lz4: bool = False) -> Path:
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    path.unlink(missing_ok=True)
    writer = rosbag1.Writer(path)
    if lz4:
        writer.set_compression(writer.CompressionFormat.LZ4)
    with writer:
        topics = {topic: writer.add_connection(topic, kind, msgdef="uint8 x\n", md5sum="0" * 32)
                  for topic, kind in sorted({m[:2] for m in messages})}
        for topic, _, ns, data in sorted(messages, key=lambda m: m[2]):
            writer.write(topics[topic], ns, data)
    return path


def holds(path: Path, want: Recording) -> None:
    """The bag holds this recording, and gives a part of it."""
    got = read_recording(path)
    equal(got.events, want.events)
    np.testing.assert_array_equal(got.frames, want.frames)
    np.testing.assert_array_equal(got.frame_times, want.frame_times)
    assert "/dvs/image_raw" in got.notes[0]
    first = int(want.events.t[0])
    part = read_recording(path, start_s=0.1, stop_s=0.2)
    equal(part.events, want.events.slice(first + 100_000, first + 200_000))
    assert len(part.frames) == 2


def as_sent(events: Events, encoding: str) -> Events:
    """On the clock of the encoding: that of EVT3 begins within its 24 bits."""
    t = events.t
    if encoding == "evt3":
        t = t % 2**24
        t = t + 2**24 * np.cumsum(np.diff(t, prepend=t[0]) < 0)
    return Events(events.x, events.y, t, events.p, SIZE)


@needs_rosbags
@pytest.mark.parametrize("lz4", [False, True])
def test_event_arrays_and_images(tmp_path: Path, lz4: bool) -> None:
    want = make()
    messages = array_messages(want.events) + image_messages(want)
    messages += image_messages(want, "/other/image_raw")
    path = write(tmp_path / "a.bag", messages, lz4)
    holds(path, want)
    np.testing.assert_array_equal(read_events(path, polarity="invert").p, ~want.events.p)


@needs_rosbags
@pytest.mark.parametrize("encoding", ["evt3", "mono", "libcaer", "libcaer_cmp"])
def test_event_packets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str
) -> None:
    want = make().events
    path = write(tmp_path / "a.bag", packet_messages(want, encoding)
                 + image_messages(make(), "/cam/image_raw"))
    for chunk in (500, 1 << 18):
        monkeypatch.setattr("evflow.io.stream.CHUNK", chunk)
        got = read_recording(path)
        equal(got.events, as_sent(want, encoding))
        assert got.has_frames == encoding.startswith("libcaer")


def test_words_of_libcaer_cmp_change_a_state() -> None:
    """Column, time and base hold from word to word, column and base from message to message."""
    words = [0x2005, 0x3803, 0x0002, 0x1007, 0x4010, 0x5003, 0x5080, 0x1009, 0x300C, 0x4820]
    decoder = libcaer_words.Decoder()
    x, y, t, p = decoder.decode(Packet(0, "", None, 10**9, struct.pack("<10H", *words)))
    late = 10**9 + 1000 * (2 << 12 | 7)
    assert x.tolist() == [5] * 5
    assert y.tolist() == [3, 16, 17, 31, 12]
    assert t.tolist() == [10**9, late, late, late, late + 2000]
    assert p.tolist() == [True, False, False, False, False]
    assert [len(c) for c in decoder.decode(Packet(1, "", None, 0, b""))] == [0] * 4
    x, y, t, p = decoder.decode(Packet(2, "", None, 7000, struct.pack("<H", 0x5001)))
    assert (x.tolist(), y.tolist(), t.tolist(), p.tolist()) == ([5], [32], [7000], [True])
    with pytest.raises(Damage, match="0x6001"):
        decoder.decode(Packet(3, "", None, 0, struct.pack("<H", 0x6001)))


@needs_rosbags
def test_several_topics_and_none(tmp_path: Path) -> None:
    want = make()
    path = write(tmp_path / "a.bag", array_messages(want.events, "/left/events")
                 + array_messages(make(50).events, "/right/events"))
    got = read_recording(path)
    equal(got.events, want.events)
    assert got.notes == ("topic /right/events was not read",)
    error = refused(write(path, image_messages(want)))
    assert error.code == "EV008"
    assert "/dvs/image_raw (sensor_msgs/msg/Image)" in str(error)


@needs_rosbags
@pytest.mark.parametrize(("old", "new", "code", "seen"), [
    (struct.pack("<2I", 48, 64), struct.pack("<2I", 10, 64), "EV005", "outside 64x10"),
    (struct.pack("<2I", 48, 64), struct.pack("<2I", 0, 0), "EV015", "events reach"),
    (b"cam", b"cam" + struct.pack("<4I", 48, 64, 10**9, 0), "EV009", "it claims 13,0"),
    (struct.pack("<I", 3) + b"cam", b"\xff\xff\xff\xffcam", "EV009", "it claims 4,294,967,")])
def test_messages_that_cannot_be_right(
    tmp_path: Path, old: bytes, new: bytes, code: str, seen: str
) -> None:
    messages = [(topic, kind, ns, data.replace(old, new, 1))
                for topic, kind, ns, data in array_messages(make().events)]
    error = refused(write(tmp_path / "a.bag", messages))
    assert error.code == code
    assert seen in str(error)


@needs_rosbags
def test_unknown_encoding_and_change_of_size(tmp_path: Path) -> None:
    messages = [(topic, kind, ns, data.replace(b"mono", b"evt4"))
                for topic, kind, ns, data in packet_messages(make().events, "mono")]
    error = refused(write(tmp_path / "a.bag", messages))
    assert (error.code, "evt4" in str(error)) == ("EV008", True)
    messages = array_messages(make().events)
    topic, kind, ns, data = messages[2]
    messages[2] = topic, kind, ns, data.replace(struct.pack("<2I", 48, 64),
                                                struct.pack("<2I", 50, 64))
    error = refused(write(tmp_path / "a.bag", messages))
    assert "message 2: encoding and size change" in str(error)
    assert "stop_s=" in error.fix


@needs_rosbags
def test_damaged_copies_only_raise_data_errors(tmp_path: Path) -> None:
    want = make(300, 2)
    path = write(tmp_path / "a.bag", array_messages(want.events) + image_messages(want), True)
    damage(path, 200, lambda: survives(path))


def test_missing_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    error = refused(tmp_path / "a.bag")
    assert error.code == "EV010"
    assert "evflow-jax[ros]" in str(error)


@needs_rosbags
def test_real_event_camera_msgs(data_file: Callable[[str], Path]) -> None:
    got = read_events(data_file("data/formats/event_camera_msgs_evt3.bag"))
    assert (len(got), got.size) == (343_474, (640, 480))
    assert (got.t[0], got.t[-1]) == (7_139_845, 9_218_023)
    other = read_events(data_file("data/recordings/gen3_vga_person/events.npz"))
    np.testing.assert_array_equal(got.x, other.x)  # the same recording, unpacked by another decoder
    np.testing.assert_array_equal(got.y, other.y)
    np.testing.assert_array_equal(got.p, other.p)
    np.testing.assert_array_equal(got.t - got.t[0], other.t - other.t[0])

"""Recordings as ROS 1 bags, message by message."""

from __future__ import annotations

import itertools
import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import SIZE, equal
from helpers.streams import evt3

from evflow.io import read_recording
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
    assert got.notes[0].code == "frames.clock"
    assert "/dvs/image_raw" in got.notes[0].text
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

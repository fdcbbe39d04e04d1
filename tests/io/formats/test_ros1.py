"""ROS 1 bags: messages packed field by field come back exactly; damage only raises data errors."""

from __future__ import annotations

import builtins
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.bags import (
    PACKET,
    array_messages,
    as_sent,
    header,
    holds,
    image_messages,
    needs_rosbags,
    packet_messages,
    write,
)
from helpers.recordings import SIZE, T0, damage, equal, make, refused
from helpers.streams import survives

from evflow.errors import EvflowDataError
from evflow.io import read_events, read_recording
from evflow.io.decode.stream import Damage
from evflow.io.formats.ros import libcaer_words
from evflow.io.formats.ros.messages import Packet
from evflow.io.triggers import read_triggers
from evflow.notes import Note, texts
from evflow.types import Events, Recording


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
        monkeypatch.setattr("evflow.io.decode.stream.CHUNK", chunk)
        got = read_recording(path)
        equal(got.events, as_sent(want, encoding))
        assert got.has_frames == encoding.startswith("libcaer")


@needs_rosbags
def test_a_unit_of_the_events_alone(tmp_path: Path) -> None:
    """Those of EVT3 are in us; header times are in ns, unless all times share a wrong unit."""
    want = make()
    path = write(tmp_path / "a.bag", packet_messages(want.events, "evt3")
                 + image_messages(want, "/cam/image_raw"))
    got = read_recording(path, time_unit="us", frames_topic="/cam/image_raw")
    equal(got.events, as_sent(want.events, "evt3"))
    np.testing.assert_array_equal(got.frame_times, want.frame_times)
    assert "frame times of /cam/image_raw were read in ns." in texts(got.notes)
    early = Recording(
        Events(*(getattr(want.events, n) - (T0 if n == "t" else 0) for n in "xyt"), want.events.p,
               SIZE), want.frames, want.frame_times - T0)
    path = write(tmp_path / "b.bag", array_messages(early.events) + image_messages(early))
    got = read_recording(path, time_unit="us")
    np.testing.assert_array_equal(got.frame_times, early.frame_times * 1000)
    np.testing.assert_array_equal(got.events.t, early.events.t * 1000)


@needs_rosbags
def test_reserved_words_in_packets_are_skipped(tmp_path: Path) -> None:
    want = make().events
    first, *rest = packet_messages(want, "evt3")
    head, data = first[3].split(b"evt3\0", 1)
    padded = struct.pack("<I", struct.unpack("<I", data[:4])[0] + 6) + b"\x99" * 6 + data[4:]
    messages = [(*first[:3], head + b"evt3\0" + padded), *rest]
    got = read_recording(write(tmp_path / "a.bag", messages))
    equal(got.events, as_sent(want, "evt3"))
    assert got.notes[0].text.startswith("3 words of types that EVT3 reserves (0x9999")


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
    assert got.notes == (Note("sensor.camera", "events of /left/events were read; not read: "
                              "/right/events; --events-topic NAME reads another"),)
    error = refused(write(path, image_messages(want)))
    assert error.code == "EV008"
    assert "/dvs/image_raw (sensor_msgs/msg/Image)" in str(error)


@needs_rosbags
def test_topics_without_events_that_can_be_read_come_last(tmp_path: Path) -> None:
    want = make()
    array, mono = array_messages(want.events), packet_messages(want.events, "mono")
    ns, four, seven = array[0][2], struct.pack("<I", 4), struct.pack("<I", 7)
    first = [("/a/events", array[0][1], ns, header(ns) + struct.pack("<3I", 48, 64, 0)), *(
        ("/b/trigger", PACKET, m[2], m[3].replace(four + b"mono", seven + b"trigger"))
        for m in mono)]
    path = write(tmp_path / "a.bag", first + array)
    got = read_recording(path)
    equal(got.events, want.events)
    assert "not read: /a/events, /b/trigger" in got.notes[0].text
    assert not len(read_recording(path, events_topic="/a/events").events)
    error = refused(path, events_topic="/b/trigger")
    assert error.code == "EV008"
    assert "--events-topic NAME): /a/events, /dvs/events" in error.fix


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


@needs_rosbags
@pytest.mark.parametrize(("encoding", "words"), [("evt3", True), ("evt3", False), ("mono", False)])
def test_triggers_beside_the_events(tmp_path: Path, encoding: str, words: bool) -> None:
    events = make().events
    edge = int(as_sent(events, "evt3").t[-1]) + 4100  # on the sensor's clock
    ns = int(events.t[-1]) * 1000 + 4_100_000
    messages = packet_messages(events, encoding)
    if words:
        data = struct.pack("<3H", 0x8000 | (edge >> 12) & 0xFFF, 0x6000 | edge & 0xFFF, 0xA001)
        messages.append(("/cam/events", PACKET, ns, header(ns) + struct.pack(
            "<2I2QI", SIZE[1], SIZE[0], 9, 0, 4) + b"evt3" + b"\0" + struct.pack("<I", 6) + data))
    path = write(tmp_path / "a.bag", messages)
    if words:
        assert read_triggers(path, events, "/cam/events").tolist() == [edge]
    else:
        with pytest.raises(EvflowDataError, match="holds no trigger events"):
            read_triggers(path, events)

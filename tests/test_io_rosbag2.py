"""ROS 2 bags: messages as another serialiser writes them come back exactly; damage only raises
data errors."""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import SIZE, damage, equal, make, refused
from test_io_rosbag import as_sent, holds, packet_messages, split
from test_io_stream import survives

from evflow.io import read_events, read_recording
from evflow.io.messages import Message
from evflow.types import Events, Recording

typesys = pytest.importorskip("rosbags.typesys")
rosbag2 = pytest.importorskip("rosbags.rosbag2")

DEFINITIONS = {
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray":
        "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
    "event_camera_msgs/msg/EventPacket":
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
        "string encoding\nbool is_bigendian\nuint8[] events\n"}
ARRAY, PACKET, IMAGE = (
    "dvs_msgs/msg/EventArray", "event_camera_msgs/msg/EventPacket", "sensor_msgs/msg/Image")
SUFFIX = {"SQLITE3": ".db3", "MCAP": ".mcap"}


@dataclasses.dataclass
class Store:
    """Messages made and serialised by `rosbags`."""

    types: Any

    @classmethod
    def new(cls) -> Store:
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for name, text in DEFINITIONS.items():
            types.register(typesys.get_types_from_msg(text, name))
        return cls(types)

    def make(self, kind: str, *fields: Any) -> Any:
        return self.types.types[kind](*fields)

    def time(self, ns: int) -> Any:
        return self.make("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)

    def header(self, ns: int) -> Any:
        return self.make("std_msgs/msg/Header", self.time(ns), "camera")

    def array(self, events: Events, ns: int) -> tuple[str, int, Any]:
        rows = [self.make("dvs_msgs/msg/Event", int(x), int(y), self.time(1000 * int(t)), bool(p))
                for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True)]
        return ARRAY, ns, self.make(ARRAY, self.header(ns), SIZE[1], SIZE[0], rows)

    def arrays(self, events: Events) -> list[tuple[str, int, Any]]:
        return [self.array(part, 1000 * int(part.t[0])) for part in split(events)]

    def packets(self, events: Events, encoding: str) -> list[tuple[str, int, Any]]:
        """The payloads of ROS 1 behind fields of ROS 2."""
        found = []
        for _, _, ns, raw in packet_messages(events, encoding):
            old = Message(raw, 0).events(PACKET)
            data = np.frombuffer(old.data, np.uint8)
            found.append((PACKET, ns, self.make(
                PACKET, self.header(ns), SIZE[1], SIZE[0], 7, old.base, encoding, False, data)))
        return found

    def images(self, recording: Recording) -> list[tuple[str, int, Any]]:
        """Rows may be longer than the image."""
        found = []
        for frame, us in zip(recording.frames, recording.frame_times, strict=True):
            padded = np.zeros((48, 70), np.uint8)
            padded[:, :64] = frame
            ns = 1000 * int(us)
            found.append((IMAGE, ns, self.make(
                IMAGE, self.header(ns), 48, 64, "mono8", 0, 70, padded.ravel())))
        return found

    def write(
        self, path: Path, topics: dict[str, list[tuple[str, int, Any]]], storage: str = "SQLITE3",
        compression: str | None = None,
    ) -> Path:
        plugin = rosbag2.StoragePlugin[storage]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if compression:
            writer.set_compression(rosbag2.CompressionMode[compression],
                                   rosbag2.CompressionFormat.ZSTD)
        with writer:
            for topic, messages in topics.items():
                if messages:
                    to = writer.add_connection(topic, messages[0][0], typestore=self.types)
                for kind, ns, message in messages:
                    writer.write(to, ns, self.types.serialize_cdr(message, kind))
        return path


@pytest.mark.parametrize(("storage", "compression"), [
    ("SQLITE3", None), ("SQLITE3", "MESSAGE"), ("SQLITE3", "FILE"), ("MCAP", None),
    ("MCAP", "STORAGE")])
def test_event_arrays_and_images(tmp_path: Path, storage: str, compression: str | None) -> None:
    want, store = make(), Store.new()
    path = store.write(tmp_path / "bag", {
        "/dvs/events": store.arrays(want.events), "/dvs/image_raw": store.images(want)},
        storage, compression)
    holds(path, want)


@pytest.mark.parametrize("storage", SUFFIX)
def test_a_file_alone_is_a_bag(tmp_path: Path, storage: str) -> None:
    want, store = make().events, Store.new()
    folder = store.write(tmp_path / "bag", {"/cam/events": store.packets(want, "mono")}, storage)
    file, = folder.glob(f"*{SUFFIX[storage]}")
    equal(read_events(file), want)


@pytest.mark.parametrize("encoding", ["evt3", "mono", "libcaer", "libcaer_cmp"])
def test_event_packets(tmp_path: Path, encoding: str) -> None:
    want, store = make().events, Store.new()
    path = store.write(tmp_path / "bag", {
        "/cam/events": store.packets(want, encoding), "/cam/image_raw": store.images(make())},
        "MCAP")
    got = read_recording(path)
    equal(got.events, as_sent(want, encoding))
    assert got.has_frames == encoding.startswith("libcaer")


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_events_are_packed_as_in_ros_1(count: int) -> None:
    """An event takes 13 bytes, or 16 behind another."""
    store, some = Store.new(), make().events
    part = Events(some.x[:count], some.y[:count], some.t[:count], some.p[:count], SIZE)
    kind, _, message = store.array(part, 5)
    raw = bytes(store.types.serialize_cdr(message, kind))
    packet = Message(raw, 0, aligned=True).events(kind)
    assert packet.data == b"".join(
        struct.pack("<2H2IB", x, y, t // 10**6, t % 10**6 * 1000, p)
        for x, y, t, p in zip(part.x.tolist(), part.y.tolist(), part.t.tolist(), part.p.tolist(),
                              strict=True))


def test_what_is_no_message_of_ros_2_is_said(tmp_path: Path) -> None:
    store, want = Store.new(), make()
    only = store.write(tmp_path / "images", {"/dvs/image_raw": store.images(want)})
    assert refused(only).code == "EV008"
    big = store.write(tmp_path / "big", {"/dvs/events": store.arrays(want.events)})
    file, = big.glob("*.db3")
    kind, _, message = store.arrays(want.events)[2]
    begin = bytes(store.types.serialize_cdr(message, kind))[:12]
    assert file.read_bytes().count(begin) == 1
    file.write_bytes(file.read_bytes().replace(begin, b"\0\0" + begin[2:]))
    error = refused(big)
    assert error.code == "EV009"
    assert "message 2: it begins with 0000" in str(error)


def test_a_database_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    """SQLite reads rows from what is left, in whatever order."""
    store, want = Store.new(), make()
    folder = store.write(tmp_path / "bag", {"/dvs/events": store.arrays(want.events)})
    file, = folder.glob("*.db3")
    whole = file.read_bytes()
    file.write_bytes(whole[:-4096])
    error = refused(file)
    assert error.code == "EV009"
    assert f"has {len(whole) - 4096:,} of {len(whole):,} bytes" in str(error)


@pytest.mark.parametrize("storage", SUFFIX)
def test_damaged_copies_only_raise_data_errors(tmp_path: Path, storage: str) -> None:
    store, want = Store.new(), make(300, 2)
    folder = store.write(tmp_path / "bag", {
        "/dvs/events": store.arrays(want.events), "/dvs/image_raw": store.images(want)}, storage)
    file, = folder.glob(f"*{SUFFIX[storage]}")
    damage(file, 100, lambda: survives(folder))
    damage(folder / "metadata.yaml", 100, lambda: survives(folder))

"""Recordings as ROS 2 bags, message by message."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.bags import packet_messages, split
from helpers.recordings import SIZE

from evflow.io.formats.ros.messages import Message
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

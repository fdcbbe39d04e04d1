"""ROS 1 bags through the package `rosbags`: one topic of events, and the images beside it.

dvs_msgs/EventArray (uzh-rpg/rpg_dvs_ros; prophesee_event_msgs has the same bytes): 13-byte events
on ROS time. event_camera_msgs/EventPacket: `evt3` (the sensor's clock), `mono` (64-bit words: ns
since time_base, x, y, polarity) and `libcaer` (32-bit words x, y, polarity; us, wrapping at 31
bits, on time_base). sensor_msgs/Image of the same name space become frames, at their header's
time, where the events are on ROS time. Of several topics the first with events is read, and the
others are named in a note.
"""

from __future__ import annotations

import bz2
import io
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io import evt3, stream
from evflow.io.frames import FrameStack
from evflow.io.hints import Hints
from evflow.io.limits import RATIO, check_expansion
from evflow.io.messages import EVENT_TYPES, IMAGE, Message, Packet
from evflow.io.stream import Chunk, Clock, Damage, gather
from evflow.types import Recording

NAME = "rosbag"
EXTENSIONS: tuple[str, ...] = (".bag",)

CHUNK = 1 << 26  # bytes that a chunk may have; rosbag's own have 768 kB

EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
CAER = np.dtype([("data", "<u4"), ("t", "<u4")])


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith(b"#ROSBAG V")


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (no events, unknown encoding), EV009 (damaged), EV010 (no `rosbags`) and what
    `stream.gather` and `Recording` raise."""
    with _Bag(path) as bag:
        topics = bag.topics(EVENT_TYPES)
        if not topics:
            raise EvflowDataError(
                "EV008", f"{path} holds no topic of events, but {sorted(bag.all())[:8]}.",
                f"Known messages: {', '.join(EVENT_TYPES)}.")
        topic, kind = topics[0]
        notes = tuple(f"topic {other} was not read" for other, _ in topics[1:])
        first = bag.first(topic, kind)
        chunks, native = _decoder(path, first, bag.packets(topic, kind))
        events, span = gather(path, chunks, hints, first.size, native)
        image_topic = bag.image_beside(topic)
        if image_topic is None:
            return Recording.of_events(events, notes)
        if first.encoding == "evt3" or first.encoding == "mono":
            return Recording.of_events(events, (
                *notes, f"images of {image_topic} were not read: events are on another clock"))
        return bag.with_images(image_topic, events, span, hints, notes)


def _decoder(
    path: Path, first: Packet, packets: Iterable[Packet]
) -> tuple[Iterator[Chunk], str]:
    """Chunks of the encoding of the first packet, and the unit of their times."""
    if first.encoding == "evt3":
        return evt3.Decoder("payload byte").chunks(_words(packets)), "us"
    known = {"": _event_array, "mono": _mono, "libcaer": _libcaer}
    if first.encoding not in known:
        raise EvflowDataError(
            "EV008", f"{path}: events are encoded as {first.encoding[:20]!r}.",
            "Known encodings: evt3, mono, libcaer; convert the bag with event_camera_tools.")
    return _counted(known[first.encoding](packets)), "ns"


def _counted(parts: Iterator[tuple[np.ndarray, ...]]) -> Iterator[Chunk]:
    n = 0
    for x, y, t, p in parts:
        yield Chunk(x, y, t, p, lambda i, n=n: n + i, "event")  # type: ignore[misc]
        n += len(t)


def _words(packets: Iterable[Packet]) -> Iterator[tuple[int, np.ndarray]]:
    """EVT3 words of many packets at once: a packet alone holds some thousand. Their place is that
    in the joined payload."""
    waiting, done = bytearray(), 0
    for packet in packets:
        packet.whole(2)
        waiting += packet.data
        while len(waiting) >= stream.CHUNK:
            yield done, np.frombuffer(bytes(waiting[: stream.CHUNK]), "<u2")
            done += stream.CHUNK
            del waiting[: stream.CHUNK]
    yield done, np.frombuffer(bytes(waiting), "<u2")


def _event_array(packets: Iterable[Packet]) -> Iterator[tuple[np.ndarray, ...]]:
    for packet in packets:
        table = packet.whole(EVENT.itemsize).view(EVENT)
        if (table["ns"] >= 10**9).any():
            raise Damage(packet.index, "a time has more than 999,999,999 ns", "message")
        yield (table["x"], table["y"], table["s"].astype(np.int64) * 10**9 + table["ns"],
               table["p"])


def _mono(packets: Iterable[Packet]) -> Iterator[tuple[np.ndarray, ...]]:
    for packet in packets:
        word = packet.whole(8).view("<u8")
        yield (((word >> 32) & 0xFFFF).astype(np.uint16), ((word >> 48) & 0x7FFF).astype(np.uint16),
               packet.base_ns() + (word & 0xFFFFFFFF).astype(np.int64), word >> 63 != 0)


def _libcaer(packets: Iterable[Packet]) -> Iterator[tuple[np.ndarray, ...]]:
    for packet in packets:
        table = packet.whole(CAER.itemsize).view(CAER)
        data = table["data"]
        us = Clock(31).unwrap(table["t"] & 0x7FFFFFFF)
        yield (data >> 17, (data >> 2) & 0x7FFF, packet.base_ns() + us * 1000, data & 2 != 0)


class _Bag:
    """A bag, read message by message; whatever `rosbags` raises becomes EV009."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            from rosbags.rosbag1 import Reader
        except ImportError as e:
            raise EvflowDataError(
                "EV010", f"reading {path} needs the package 'rosbags'.",
                'pip install "evflow-jax[ros]"') from e
        bounded: Any = _Bounded(path)  # what `Reader` uses of a path
        self.reader = Reader(bounded)

    def __enter__(self) -> _Bag:
        try:
            self.reader.open()
            for place, chunk in self.reader.chunks.items():  # bombs are unpacked no further
                unpack = _bounded(chunk.decompressor)
                self.reader.chunks[place] = chunk._replace(decompressor=unpack)
        except Exception as e:
            raise self._damaged(e) from e
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    def _damaged(self, e: Exception) -> EvflowDataError:
        return EvflowDataError(
            "EV009", f"{self.path} is cut off or damaged ({e or type(e).__name__}).",
            "Copy it again; if its recording was interrupted, run `rosbag reindex` on it.")

    def all(self) -> list[str]:
        return [f"{c.topic} ({c.msgtype})" for c in self.reader.connections]

    def topics(self, kinds: Iterable[str]) -> list[tuple[str, str]]:
        """(topic, message type) of these types, by name, those with messages first."""
        found = {(c.topic, c.msgtype): c.msgcount for c in self.reader.connections
                 if c.msgtype in kinds}
        return sorted(found, key=lambda pair: (found[pair] == 0, *pair))

    def image_beside(self, topic: str) -> str | None:
        """The topic of images in the name space of `topic`, else the only one."""
        images = [name for name, _ in self.topics((IMAGE,))]
        beside = [name for name in images if name.rsplit("/", 1)[0] == topic.rsplit("/", 1)[0]]
        return beside[0] if beside else images[0] if len(images) == 1 else None

    def messages(self, topic: str) -> Iterator[Message]:
        wanted = [c for c in self.reader.connections if c.topic == topic]
        source = self.reader.messages(connections=wanted)
        index = read = 0
        while True:
            try:
                _, _, raw = next(source)
            except StopIteration:
                return
            except MemoryError:
                raise
            except Exception as e:  # ReaderError, and what bz2, lz4 and struct raise
                raise self._damaged(e) from e
            read += len(raw)
            check_expansion(read, os.path.getsize(self.path), f"the index of {self.path}")
            yield Message(bytes(raw), index)
            index += 1

    def packets(self, topic: str, kind: str) -> Iterator[Packet]:
        """The messages of events, all of one encoding and size."""
        first: tuple[str, Size | None] | None = None
        for message in self.messages(topic):
            packet = message.events(kind)
            first = first or (packet.encoding, packet.size)
            if (packet.encoding, packet.size) != first:
                raise Damage(message.index, f"encoding and size change from {first} to "
                             f"{(packet.encoding, packet.size)}", "message")
            yield packet

    def first(self, topic: str, kind: str) -> Packet:
        """The first packet of a topic; EV001 (none), EV009."""
        try:
            packet = next(self.packets(topic, kind), None)
        except Damage as e:
            raise self._wrong(topic, e) from e
        if packet is None:
            raise EvflowDataError("EV001", f"{self.path}: topic {topic} holds no message.")
        return packet

    def _wrong(self, topic: str, e: Damage) -> EvflowDataError:
        return EvflowDataError(
            "EV009", f"{self.path}, topic {topic}, message {e.byte:,}: {e.seen}.", "Copy it again.")

    def with_images(
        self, topic: str, events: Any, span: tuple[int, int], hints: Hints, notes: tuple[str, ...]
    ) -> Recording:
        times, images = [], FrameStack(self.path)
        try:
            for message in self.messages(topic):
                stamp = hints.instant(message.stamp_ns(), "ns")
                if span[0] <= stamp < span[1]:
                    times.append(stamp)
                    images.append(message.image())
        except Damage as e:
            raise self._wrong(topic, e) from e
        return images.beside(
            events, np.array(times, np.int64),
            (*notes, f"frame times are the header times of {topic}"))


def _bounded(unpack: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """The same for a chunk that expands within `limits`; ValueError for others."""
    from lz4.frame import LZ4FrameDecompressor, decompress

    makers: dict[Any, Any] = {bz2.decompress: bz2.BZ2Decompressor, decompress: LZ4FrameDecompressor}
    if unpack not in makers:  # not compressed
        return unpack

    def bounded(data: bytes) -> bytes:
        decoder = makers[unpack]()
        out: bytes = decoder.decompress(data, max_length=CHUNK + RATIO * len(data))
        if not decoder.eof:
            raise ValueError(f"a chunk of {len(data):,} bytes that is cut off, or expands to more "
                             f"than {len(out):,}")
        return out

    return bounded


class _Bounded:
    """A path whose open file never takes memory for more bytes than it has left."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def exists(self) -> bool:
        return self.path.exists()

    def open(self, mode: str) -> io.BufferedReader:
        return _BoundedFile(io.FileIO(self.path, "r"))


class _BoundedFile(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        left = max(os.fstat(self.fileno()).st_size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))

"""Recordings out of bags of ROS 1 and ROS 2: one topic of events, and the images beside it.

sensor_msgs/Image and CompressedImage become frames, at their header's time, where the events are on
ROS time; of several topics of images `streams.choose` takes one. Of several topics the first with
events is read, and the others are named in a note.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.files.limits import check_expansion
from evflow.io.decode.stream import Damage, gather
from evflow.io.formats.ros.messages import (
    COMPRESSED,
    EVENT_TYPES,
    IMAGES,
    Message,
    Packet,
)
from evflow.io.formats.ros.packets import OTHER_CLOCK, decoded
from evflow.io.hints import Hints
from evflow.io.images import encodings
from evflow.io.images.pictures import claimed_size
from evflow.io.images.recorded import FrameStack
from evflow.io.images.streams import ImageStream, choose, events_alone
from evflow.notes import Note
from evflow.types import Recording


def read_bag(bag: Bag, hints: Hints) -> Recording:
    """Raises EV008 (no events, unknown encoding), EV009 (damaged) and what `stream.gather` and
    `Recording` raise."""
    topics = bag.topics(EVENT_TYPES)
    if not topics:
        raise EvflowDataError(
            "EV008", f"{bag.path} holds no topic of events, but {sorted(bag.all())[:8]}.",
            f"Known messages: {', '.join(EVENT_TYPES)}.")
    topic, kind = topics[0]
    notes = tuple(Note("events.unread", f"topic {other} was not read") for other, _ in topics[1:])
    first = bag.first(topic, kind)
    found = decoded(bag.path, first, bag.packets(topic, kind))
    events, span, told = gather(bag.path, found.chunks, hints, first.size, found.native)
    notes += (*found.notes(), *told)
    with events_alone():
        images = bag.image_streams(hints)
        own_clock = first.encoding in OTHER_CLOCK
        if images and own_clock and hints.frames_topic is None:
            return Recording.of_events(events, (*notes, Note(
                "frames.unused", f"images of {', '.join(s.name for s in images)} were not read: "
                "events are on another clock; --frames-topic NAME takes them as they are")))
        chosen = choose(images, hints, events.size, topic)
        notes += chosen.notes
        if chosen.stream is None:
            return Recording.of_events(events, notes)
        stack = bag.stack(chosen.stream.name, events.size, hints, None if own_clock else span)
        clock = Note("frames.clock", f"frame times are the header times of {chosen.stream.name}")
        return stack.beside(events, hints, (clock, *notes))


class Bag:
    """A bag, read message by message; whatever its reader raises becomes EV009.

    open_reader: gives an open reader, as those of `rosbags` are; aligned: messages are those of
    ROS 2; mend: the command that repairs a bag."""

    def __init__(
        self, path: Path, open_reader: Callable[[Path], Any], *, aligned: bool, mend: str
    ) -> None:
        self.path, self.aligned, self.mend = path, aligned, mend
        files = path.iterdir() if path.is_dir() else (path,)
        self.stored = sum(file.stat().st_size for file in files)
        try:
            self.reader = open_reader(path)
        except (EvflowDataError, MemoryError):
            raise
        except Exception as e:
            raise self._failed(e) from e

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    def _failed(self, e: Exception) -> EvflowDataError:
        """What the reader's exception says of the bag, or of the packages that are there."""
        if isinstance(e, ImportError):
            return EvflowDataError("EV010", f"reading {self.path} needs the package 'rosbags'.",
                                   'pip install "evflow-jax[ros]"')
        return EvflowDataError(
            "EV009", f"{self.path} is cut off or damaged ({e or type(e).__name__}).",
            f"Copy it again; if its recording was interrupted, run `{self.mend}` on it.")

    def all(self) -> list[str]:
        return [f"{c.topic} ({c.msgtype})" for c in self.reader.connections]

    def topics(self, kinds: Iterable[str]) -> list[tuple[str, str]]:
        """(topic, message type) of these types, by name, those with messages first."""
        found = {(c.topic, c.msgtype): c.msgcount for c in self.reader.connections
                 if c.msgtype in kinds}
        return sorted(found, key=lambda pair: (found[pair] == 0, *pair))

    def image_streams(self, hints: Hints) -> list[ImageStream]:
        """The topics of images that have messages, by name; none where none are wanted."""
        found = [] if hints.no_frames else self.reader.connections
        kinds = {c.topic: c.msgtype for c in found if c.msgtype in IMAGES and c.msgcount}
        return [self._image_stream(*pair) for pair in sorted(kinds.items())]

    def _image_stream(self, topic: str, kind: str) -> ImageStream:
        try:
            message = next(self.messages(topic))
            message.stamp_ns()
            if kind == COMPRESSED:
                size = claimed_size(message.compressed())
                return ImageStream(topic, size, "" if size else "compressed as is not known")
            size, encoding = message.picture()
        except Damage as e:
            return ImageStream(topic, unusable=f"damaged: {e.seen}")
        why = encodings.unreadable(encoding)
        return ImageStream(topic, size, why, () if why else encodings.notes(encoding))

    def messages(self, topic: str) -> Iterator[Message]:
        wanted = [c for c in self.reader.connections if c.topic == topic]
        source = self.reader.messages(connections=wanted)
        index = read = 0
        while True:
            try:
                _, _, raw = next(source)
            except StopIteration:
                return
            except (EvflowDataError, MemoryError):
                raise
            except Exception as e:  # ReaderError, and what bz2, lz4 and struct raise
                raise self._failed(e) from e
            read += len(raw)
            check_expansion(read, self.stored, f"the index of {self.path}")
            yield Message(bytes(raw), index, self.aligned)
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

    def stack(
        self, topic: str, size: Size, hints: Hints, span: tuple[int, int] | None
    ) -> FrameStack:
        """The images of a topic whose times lie in [start, stop) us."""
        found = FrameStack(topic, size)
        kind = next(c.msgtype for c in self.reader.connections if c.topic == topic)
        try:
            for message in self.messages(topic):
                stamp = hints.instant(message.stamp_ns(), "ns")
                if span is None or span[0] <= stamp < span[1]:
                    found.append(message.image(kind), stamp)
        except Damage as e:
            raise self._wrong(topic, e) from e
        return found

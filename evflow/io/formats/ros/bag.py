"""Recordings from ROS 1 and ROS 2 bags: one topic of events, and the images beside it.

sensor_msgs/Image and CompressedImage become frames at their header time (or at the time of
recording, if no header has one), provided that the events are on ROS time; with several image
topics `streams.choose` picks one. With several event topics the first one whose first messages have
events is read, or the one requested, and a note names the others. If no event message contains the
sensor's size, it is that of the only images that can be their frames.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

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
from evflow.io.formats.ros.packets import OTHER_CLOCK, decoded, readable, triggers
from evflow.io.hints import Hints
from evflow.io.images import encodings
from evflow.io.images.event_clock import beside_events
from evflow.io.images.exposures import Stamps
from evflow.io.images.pictures import claimed_size
from evflow.io.images.recorded import FrameStack
from evflow.io.images.streams import ImageStream, choose, events_alone
from evflow.io.images.times import FrameTimes
from evflow.notes import Note
from evflow.types import Events, Recording

LOOKED = 16  # messages examined for encoding and size


def read_bag(bag: Bag, hints: Hints) -> Recording:
    """Raises EV008 (no events, unknown encoding), EV009 (damaged) and what `stream.gather` and
    `Recording` raise."""
    topics = bag.event_topics(hints.events_topic)
    if not topics:
        raise EvflowDataError(
            "EV008", f"{bag.path} holds no topic of events, but {sorted(bag.all())[:8]}.",
            f"Known messages: {', '.join(EVENT_TYPES)}.", where=bag.path)
    topic, notes = hints.camera(list(topics))
    kind = topics[topic]
    first, guessed = bag.sized(bag.first(topic, kind), topic, hints)
    notes += guessed
    found = decoded(bag.path, first, bag.packets(topic, kind), [t for t in topics if t != topic])
    events, span, more = gather(bag.path, found.chunks, hints, first.size, found.native)
    notes += (*found.notes(), *more)
    with events_alone():
        images = bag.image_streams(hints)
        own_clock = first.encoding in OTHER_CLOCK
        if images and own_clock and hints.frames_topic is None:
            return Recording.of_events(events, (*notes, Note(
                "frames.unused", f"images of {', '.join(s.name for s in images)} were not read: "
                "events are on another clock; --frames-topic NAME uses them anyway")))
        chosen = choose(images, hints, events.size, topic)
        notes += chosen.notes
        if chosen.stream is None:
            return Recording.of_events(events, notes)
        stack, more = bag.stack(chosen.stream.name, events, hints, None if own_clock else span)
        return stack.beside(events, hints, (bag.clock(chosen.stream.name), *notes, *more))


def triggers_of(bag: Bag, topic: str | None) -> np.ndarray:
    """Times (N,) int64 us of the trigger words beside the events of a topic, by default the first.
    Raises as `read_bag`."""
    topics = bag.event_topics(topic)
    if not topics:
        return np.zeros(0, np.int64)
    chosen = Hints(events_topic=topic).camera(list(topics))[0]
    return triggers(bag.first(chosen, topics[chosen]), bag.packets(chosen, topics[chosen]))


class Bag:
    """A bag, read message by message; whatever its reader raises becomes EV009.

    open_reader: returns an open reader like those of `rosbags`; aligned: messages are those of
    ROS 2; mend: how to read one whose recording was interrupted."""

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
        """What the reader's exception says about the bag, or about a missing package."""
        if isinstance(e, ImportError):
            return EvflowDataError("EV010", f"reading {self.path} needs the package 'rosbags'.",
                                   'pip install "evflow-jax[ros]"', where=self.path)
        return EvflowDataError(
            "EV009", f"{self.path} is truncated or damaged ({e or type(e).__name__}).",
            f"Copy it again; if its recording was interrupted, {self.mend}.",
            where=self.path)

    def all(self) -> list[str]:
        return [f"{c.topic} ({c.msgtype})" for c in self.reader.connections]

    def event_topics(self, asked: str | None) -> dict[str, str]:
        """{topic: message type} of events, by name; unless one is asked for, those first whose
        first messages have events that can be read."""
        found = {(c.topic, c.msgtype): c.msgcount for c in self.reader.connections
                 if c.msgtype in EVENT_TYPES}
        order = sorted(found, key=lambda pair: (found[pair] == 0, *pair))
        if asked is None and len(order) > 1:
            order.sort(key=lambda pair: found[pair] == 0 or not self._has_events(*pair))
        return dict(order)

    def _has_events(self, topic: str, kind: str) -> bool:
        """Whether the first messages of a topic have events that can be read, or are damaged."""
        try:
            some = list(itertools.islice(self.packets(topic, kind), LOOKED))
        except (Damage, EvflowDataError):
            return True  # reading it says what is wrong
        return any(packet.data and readable(packet.encoding) for packet in some)

    def image_streams(self, hints: Hints) -> list[ImageStream]:
        """Image topics that have messages, by name; none if no frames are wanted."""
        found = [] if hints.no_frames else self.reader.connections
        kinds = {c.topic: c.msgtype for c in found if c.msgtype in IMAGES and c.msgcount}
        return [self._image_stream(*pair, hints.colour) for pair in sorted(kinds.items())]

    def _image_stream(self, topic: str, kind: str, seen: str) -> ImageStream:
        try:
            message = next(self.messages(topic))
            message.stamp_ns()
            if kind == COMPRESSED:
                encoding, data = message.compressed()
                size = claimed_size(data)
                return ImageStream(topic, size, "" if size else "an unknown compression",
                                   encodings.notes(encoding, seen))
            size, encoding = message.picture()
        except Damage as e:
            return ImageStream(topic, unusable=f"damaged: {e.seen}")
        why = encodings.unreadable(encoding)
        return ImageStream(topic, size, why, () if why else encodings.notes(encoding, seen))

    def messages(self, topic: str) -> Iterator[Message]:
        wanted = [c for c in self.reader.connections if c.topic == topic]
        source = self.reader.messages(connections=wanted)
        index = read = 0
        while True:
            try:
                _, recorded_ns, raw = next(source)
            except StopIteration:
                return
            except (EvflowDataError, MemoryError):
                raise
            except Exception as e:  # ReaderError, and what bz2, lz4 and struct raise
                raise self._failed(e) from e
            read += len(raw)
            check_expansion(read, self.stored, f"the index of {self.path}")
            yield Message(bytes(raw), index, self.aligned, recorded_ns)
            index += 1

    def packets(self, topic: str, kind: str) -> Iterator[Packet]:
        """The event messages, which must agree in encoding and size (if given); empty messages are
        skipped, because some drivers send them before they know either."""
        encoding = size = None
        for message in self.messages(topic):
            packet = message.events(kind)
            if not packet.data:
                yield packet
                continue
            encoding = packet.encoding if encoding is None else encoding
            size = size or packet.size
            if packet.encoding != encoding or packet.size not in (None, size):
                raise Damage(message.index, f"encoding and size change from {(encoding, size)} to "
                             f"{(packet.encoding, packet.size)}", "message")
            yield packet

    def first(self, topic: str, kind: str) -> Packet:
        """The first packet of a topic that holds events, with the size that it or a later one
        contains; EV001 (no message), EV009."""
        found: list[Packet] = []
        try:
            found += itertools.islice(self.packets(topic, kind), LOOKED)
        except Damage as e:
            if not any(packet.data for packet in found):
                raise self._wrong(topic, e) from e
        if not found:
            raise EvflowDataError("EV001", f"{self.path}: topic {topic} holds no message.",
                                  where=self.path)
        full = [packet for packet in found if packet.data] or found
        return dataclasses.replace(full[0], size=next((p.size for p in full if p.size), None))

    def sized(self, first: Packet, topic: str, hints: Hints) -> tuple[Packet, tuple[Note, ...]]:
        """The packet; if it has no size, with that of the only images that can be its topic's
        frames and a note that says so."""
        if first.size or hints.size:
            return first, ()
        streams = self.image_streams(dataclasses.replace(hints, no_frames=False))
        fits = {s.size: s.name for s in streams
                if s.size and choose(streams, Hints(), s.size, topic).stream is not None}
        if len(fits) != 1:
            return first, ()
        (size, name), = fits.items()
        return dataclasses.replace(first, size=size), (Note(
            "sensor.size", f"assumed the size of the images of "
            f"{name}, {size[0]}x{size[1]}: event messages have no size"),)

    def _wrong(self, topic: str, e: Damage) -> EvflowDataError:
        return EvflowDataError(
            "EV009", f"{self.path}, topic {topic}, message {e.byte:,}: {e.seen}.", "Copy it again.",
            where=self.path)

    def stack(
        self, topic: str, events: Events, hints: Hints, span: tuple[int, int] | None
    ) -> tuple[FrameStack, tuple[Note, ...]]:
        """The images of a topic whose times lie in [start, stop) us, and notes on their unit."""
        found = FrameStack(topic, events.size, hints.colour)
        kind = next(c.msgtype for c in self.reader.connections if c.topic == topic)
        stamped = self.stamped(topic)
        try:
            times = self._times(topic, hints, events, stamped)
            for index, message in enumerate(self.messages(topic)):
                ns = _stamp(message, stamped)
                stamp = hints.instant(ns, "ns") if times is None else int(times.us[index])
                if span is None or span[0] <= stamp < span[1]:
                    found.append(message.image(kind, hints.colour), stamp)
        except Damage as e:
            raise self._wrong(topic, e) from e
        return found, times.notes if times else ()

    def _times(
        self, topic: str, hints: Hints, events: Events, stamped: bool
    ) -> FrameTimes | None:
        """The times of all images of a topic where a unit is asked for, which may be that of the
        events alone; None if none is."""
        if hints.time_unit == "auto":
            return None
        ns = np.array([_stamp(message, stamped) for message in self.messages(topic)])
        return beside_events(Stamps(ns), topic, "ns", hints, events)

    def stamped(self, topic: str) -> bool:
        """Whether headers of a topic have times (the first alone may be 0, in simulations)."""
        return any(message.stamp_ns() for message in itertools.islice(self.messages(topic), 2))

    def clock(self, topic: str) -> Note:
        """The note on what the frame times of a topic are."""
        return Note("frames.clock", f"frame times are the header times of {topic}"
                    if self.stamped(topic) else f"frame times are those at which {topic} was "
                    "recorded: its headers have none")


def _stamp(message: Message, stamped: bool) -> int:
    """The time of an image in ns, after which its pixels are read."""
    ns = message.stamp_ns()
    return ns if stamped else message.recorded_ns

"""Events from the packets of ROS messages.

dvs_msgs/EventArray (uzh-rpg/rpg_dvs_ros; prophesee_event_msgs has the same bytes): 13-byte events
on ROS time. event_camera_msgs/EventPacket: `evt3` (the sensor's clock), `mono` (64-bit words: ns
since time_base, x, y, polarity), `libcaer` (32-bit words x, y, polarity; us, wrapping at 31 bits,
on time_base) and `libcaer_cmp` (see `libcaer_words`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode import stream
from evflow.io.decode.stream import Chunk, Clock, Damage
from evflow.io.formats import evt3
from evflow.io.formats.ros import libcaer_words
from evflow.io.formats.ros.messages import EVENT, Packet
from evflow.notes import Note

CAER = np.dtype([("data", "<u4"), ("t", "<u4")])
LEAST = 1 << 11  # events of a chunk, if there are as many
OTHER_CLOCK = ("evt3", "mono")  # encodings whose times are on another clock than other topics


class Decoded(NamedTuple):
    """chunks of events, the unit of their times, and notes on what was left out, at the end."""

    chunks: Iterator[Chunk]
    native: str
    notes: Callable[[], tuple[Note, ...]] = tuple


def readable(encoding: str) -> bool:
    """Whether events are read from packets of an encoding."""
    return encoding == "evt3" or encoding in _decoders()


def decoded(
    path: Path, first: Packet, packets: Iterable[Packet], others: Sequence[str] = ()
) -> Decoded:
    """Decode the packets, all in the encoding of the first. others: further topics, for EV008."""
    if first.encoding == "evt3":
        evt = evt3.Decoder("payload byte")
        return Decoded(evt.chunks(_words(packets)), "us", evt.notes)
    if not readable(first.encoding):
        also = f" Other topics (--events-topic NAME): {', '.join(others)}." if others else ""
        raise EvflowDataError(
            "EV008", f"{path}: events are encoded as {first.encoding[:20]!r}.",
            f"Known encodings: evt3, {', '.join(filter(None, _decoders()))}; convert the bag with "
            f"event_camera_tools; 'trigger' holds no events.{also}", where=path)
    return Decoded(_counted(_decoders()[first.encoding](packets)), "ns")


def _decoders() -> dict[str, Callable[[Iterable[Packet]], Iterator[tuple[np.ndarray, ...]]]]:
    return {"": _event_array, "mono": _mono, "libcaer": _libcaer, "libcaer_cmp": _libcaer_cmp}


def triggers(first: Packet, packets: Iterable[Packet]) -> np.ndarray:
    """Times (N,) int64 us of the trigger words; none in encodings that have no such words."""
    return (evt3.trigger_times(_words(packets)) if first.encoding == "evt3"
            else np.zeros(0, np.int64))


def _counted(parts: Iterable[tuple[np.ndarray, ...]]) -> Iterator[Chunk]:
    """Merge the events of several messages into chunks: a single message may hold only two."""
    done = count = 0
    waiting: list[tuple[np.ndarray, ...]] = []
    try:
        for part in parts:
            waiting.append(part)
            count += len(part[2])
            if count >= LEAST:
                yield _chunk(waiting, done)
                done, count, waiting = done + count, 0, []
    except Damage:
        if count:
            yield _chunk(waiting, done)
        raise
    if count:
        yield _chunk(waiting, done)


def _chunk(parts: list[tuple[np.ndarray, ...]], done: int) -> Chunk:
    x, y, t, p = parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))
    return Chunk(x, y, t, p, lambda i: done + i, "event")


def _words(packets: Iterable[Packet]) -> Iterator[tuple[int, np.ndarray]]:
    """EVT3 words of many packets at once, since a packet holds only some thousand; positions count
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


def _libcaer_cmp(packets: Iterable[Packet]) -> Iterator[tuple[np.ndarray, ...]]:
    return map(libcaer_words.Decoder().decode, packets)

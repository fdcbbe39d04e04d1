"""The encoding `libcaer_cmp` of event_camera_msgs/EventPacket (ros-event-camera/libcaer_driver):
16-bit words, their type in bits 15-12, that change a state or emit events.

0, 1: high and low 12 bits of time in us since time_base. 2: column x [10:0]. 3: an event at row y
[10:0], polarity [11]. 4: vector base, row and polarity the same. 5: events at rows base + i where
bit i of 8 is set; the base advances by 8. Each message begins at time 0.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.io.decode.stream import Damage, hold
from evflow.io.formats.ros.messages import Packet

HIGH, LOW, COLUMN, SINGLE, BASE, VECTOR = range(6)
ROWS = 8  # per vector
PLACE, ON = 0x7FF, 0x800


@dataclasses.dataclass
class Decoder:
    """The state between messages: column, row of the vector base, its polarity."""

    x: int = 0
    base: int = 0
    on: bool = False

    def decode(self, packet: Packet) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """x, y, t [ns], p (N,) of a message. Raises `Damage`."""
        words = packet.whole(2).view("<u2").astype(np.int64)
        kind, value = words >> 12, words & 0xFFF
        if (kind > VECTOR).any():
            raise Damage(packet.index, f"a word of libcaer_cmp is {words[kind > VECTOR][0]:#06x}",
                         "message")
        if not len(words):
            return (np.empty(0, np.int64),) * 4
        time = (_latest(kind == HIGH, value, 0) << 12) | _latest(kind == LOW, value, 0)
        x = _latest(kind == COLUMN, value & PLACE, self.x)
        base, on = self._bases(kind, value)
        vectors = np.flatnonzero(kind == VECTOR)
        which, bit = np.nonzero((value[vectors, None] >> np.arange(ROWS)) & 1)
        singles, of_vector = np.flatnonzero(kind == SINGLE), vectors[which]
        at = np.concatenate([singles, of_vector])
        y = np.concatenate([value[singles] & PLACE, base[of_vector] + bit])
        p = np.concatenate([value[singles] & ON != 0, on[of_vector]])
        order = np.argsort(at, kind="stable")
        at = at[order]
        self.x = int(x[-1])
        return x[at], y[order], packet.base_ns() + 1000 * time[at], p[order]

    def _bases(self, kind: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row of bit 0 and polarity of each vector word (undefined at other words)."""
        is_base = kind == BASE
        advanced = ROWS * np.cumsum(kind == VECTOR)
        base = _latest(is_base, (value & PLACE) - advanced, self.base) + advanced
        on = _latest(is_base, value & ON, ON * self.on) != 0
        self.base, self.on = int(base[-1]), bool(on[-1])
        return base - ROWS, on


def _latest(sets: np.ndarray, values: np.ndarray, before: int) -> np.ndarray:
    """For each word, the value of the last word for which `sets` holds; `before` if none."""
    marks = np.flatnonzero(sets)
    return hold(before, values[marks], marks, len(values))

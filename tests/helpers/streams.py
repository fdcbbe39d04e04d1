"""Recordings as the bytes of camera streams: EVT 2 and 3, DAT, AEDAT 2; encoders of their own."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import equal

from evflow.errors import EvflowDataError
from evflow.io import read_events
from evflow.types import Events

SIZE = (240, 180)
TURN = {"evt2": 2**34, "evt2.1": 2**34, "evt3": 2**24, "dat": 2**32, "aedat2": 2**32,
        "aedat3": 2**31}


def clustered(n: int = 400, first: int = 1000, pause: int = 300, seed: int = 0) -> Events:
    """Bursts of one row and instant, x ascending, as a sensor reads its rows out."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[int, int, int, int]] = []
    t = first
    while len(rows) < n:
        y, p = int(rng.integers(180)), int(rng.integers(2))
        start, width = int(rng.integers(200)), int(rng.integers(1, 40))
        xs = [x for x in range(start, min(start + width, 240)) if rng.random() < 0.4] or [start]
        rows += [(x, y, t, p) for x in xs]
        t += int(rng.integers(pause))
    x, y, t, p = np.array(rows[:n], int).reshape(-1, 4).T
    return Events(x, y, t, p, SIZE)


def listed(events: Events) -> list[tuple[int, int, int, int]]:
    return [(int(x), int(y), int(t), int(p))
            for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True)]


def evt2(events: Events, header: bytes = b"% evt 2.0\n% geometry 240x180\n") -> bytes:
    out, last = [], None
    for x, y, t, p in listed(events):
        if (t >> 6) != last:
            last = t >> 6
            out.append(0x80000000 | (last & 0xFFFFFFF))
        out.append(p << 28 | (t & 63) << 22 | x << 11 | y)
    return header + struct.pack(f"<{len(out)}I", *out)


def evt21(
    events: Events, header: bytes = b"% evt 2.1\n% format EVT21;height=180;width=240\n% end\n",
    legacy: bool = False,
) -> bytes:
    """A word for events of one row, time and polarity in ascending x within 32 pixels."""
    out: list[int] = []
    rows, i, last = listed(events), 0, None
    while i < len(rows):
        x, y, t, p = rows[i]
        if (t >> 6) != last:
            last = t >> 6
            out.append(8 << 60 | (last & 0xFFFFFFF) << 32)
        mask, base, reach = 0, x & ~31, x - 1
        while i < len(rows) and rows[i][1:] == (y, t, p) and reach < rows[i][0] < base + 32:
            reach = rows[i][0]
            mask |= 1 << (reach - base)
            i += 1
        out.append(p << 60 | (t & 63) << 54 | base << 43 | y << 32 | mask)
    if legacy:
        out = [word << 32 & 2**64 - 1 | word >> 32 for word in out]
    return header + struct.pack(f"<{len(out)}Q", *out)


def evt3(events: Events, header: bytes = b"% format EVT3;height=180;width=240\n% end\n") -> bytes:
    out: list[int] = []
    last_high = last_low = last_y = None
    rows, i = listed(events), 0
    while i < len(rows):
        x, y, t, p = rows[i]
        if (t >> 12) != last_high:
            last_high, last_low = t >> 12, None
            out.append(0x8000 | (last_high & 0xFFF))
        if (t & 0xFFF) != last_low:
            last_low = t & 0xFFF
            out.append(0x6000 | last_low)
        if y != last_y:
            last_y = y
            out.append(y)
        run = [x]
        while i + len(run) < len(rows) and rows[i + len(run)][1:] == (y, t, p) \
                and rows[i + len(run)][0] > run[-1]:
            run.append(rows[i + len(run)][0])
        i += len(run)
        if len(run) == 1:
            out.append(0x2000 | p << 11 | x)
            continue
        out.append(0x3000 | p << 11 | x)
        while run:  # masks of 12 or 8 in turn; empty ones where there is a gap
            wide = 12 if len(run) % 2 else 8
            mask = sum(1 << (v - x) for v in run if v < x + wide)
            out.append((0x4000 if wide == 12 else 0x5000) | mask)
            x += wide
            run = [v for v in run if v >= x]
    return header + struct.pack(f"<{len(out)}H", *out)


def dat(events: Events, header: bytes = b"% Version 2\n% Height 180\n% Width 240\n") -> bytes:
    return header + b"\x0c\x08" + b"".join(
        struct.pack("<2I", t & 0xFFFFFFFF, p << 28 | y << 14 | x) for x, y, t, p in listed(events))


def aedat2(events: Events, header: bytes = b"#!AER-DAT2.0\r\n# AEChip: a.b.DAVIS240C\r\n") -> bytes:
    return header + b"".join(
        struct.pack(">2I", (179 - y) << 22 | (239 - x) << 12 | p << 11, t & 0xFFFFFFFF)
        for x, y, t, p in listed(events))


def aedat3_packet(
    kind: int, size: int, body: bytes, *, overflow: int = 0, source: int = 1,
    capacity: int | None = None, number: int | None = None,
) -> bytes:
    number = len(body) // size if number is None else number
    return struct.pack("<hhiiiiii", kind, source, size, 4, overflow,
                       number if capacity is None else capacity, number, number) + body


def aedat3(
    events: Events, header: bytes = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS240C\r\n"
    b"#Start-Time: 2016-08-17 17:30:50 (TZ+0200)\r\n#!END-HEADER\r\n", most: int = 100,
) -> bytes:
    """Packets of at most so many events; a new one where the high bits of time change."""
    out, rows, i = header, listed(events), 0
    while i < len(rows):
        high, body = rows[i][2] >> 31, b""
        while i < len(rows) and rows[i][2] >> 31 == high and len(body) < 8 * most:
            x, y, t, p = rows[i]
            body += struct.pack("<Ii", x << 17 | y << 2 | p << 1 | 1, t & (1 << 31) - 1)
            i += 1
        out += aedat3_packet(1, 8, body, overflow=high)
    return out


ENCODERS = {"evt2": evt2, "evt2.1": evt21, "evt3": evt3, "dat": dat, "aedat2": aedat2,
            "aedat3": aedat3}
each = pytest.mark.parametrize("kind", ENCODERS)


def write(folder: Path, kind: str, events: Events) -> Path:
    suffix = "aedat" if kind.startswith("aedat") else "dat" if kind == "dat" else "raw"
    path = folder / f"a.{suffix}"
    path.write_bytes(ENCODERS[kind](events))
    return path


def survives(path: Path, **hints: Any) -> bool:
    """True if it was read as events that pass every check, False if refused."""
    try:
        got = read_events(path, **hints)
    except EvflowDataError:
        return False
    equal(got, Events(got.x, got.y, got.t, got.p, got.size))
    return True

"""ECF, the lossless compression of Prophesee's HDF5 files (HDF5 filter 0x8ECF), undone with NumPy.

A block, little-endian: u32, the number of events << 2 | form; u64, the start time; then runs of
equal times: bytes step << 4 | count. A count of 15 means that the count follows as u16. A step of
15 is no run: its count is the next nibble of a long step, lowest first. Then, depending on the
form:
2: y, x and polarity as 24 bits, y << 12 | x << 1 | p, four events in three u32.
1: runs of y, and x and polarity as 12 bits, x << 1 | p, four events in three u16.
0: runs of y, x with neighbours, runs of polarity.
Runs of y are u16, y << 5 | count; a count of 31 means that it follows as u16. x << 5 | mask is an
event at x, and one at x + 1, ..., x + 5 for each bit of the mask from its highest on. Runs of
polarity are bytes, p << 7 | count; a count of 127 means that it follows as u16.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

FILTER = 0x8ECF
MOST = 65535  # events per block
MASKS = np.concatenate([np.ones((32, 1), np.int64),
                        (np.arange(32)[:, None] >> np.arange(4, -1, -1)) & 1], 1)
PLACES = np.nonzero(MASKS)[1]  # positions of the events of each mask, concatenated
PLACES_FROM = np.cumsum(MASKS.sum(1)) - MASKS.sum(1)


class Block(NamedTuple):
    """Events (n,): x, y uint16, t int64, p bool."""

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray


def decode(data: bytes) -> Block:
    """The events of a block; ValueError if it is damaged."""
    if len(data) < 4:
        raise ValueError(f"a block of {len(data)} bytes")
    info = int.from_bytes(data[:4], "little")
    n, form = info >> 2, info & 3
    if n > MOST or form == 3:
        raise ValueError(f"a block of {n:,} events in form {form}")
    if n == 0:
        return Block(*(np.zeros(0, kind) for kind in ("u2", "u2", "i8", "?")))
    t, at = _times(data, n)
    if form == 2:
        packed = _threes(data, at, n, 4)
        return Block((packed >> 1 & 0x7FF).astype(np.uint16),
                     (packed >> 12 & 0x7FF).astype(np.uint16), t, packed & 1 != 0)
    y, at = _runs(data, at, n, "<u2", 5)
    if form == 1:
        packed = _threes(data, at, n, 2)
        return Block((packed >> 1).astype(np.uint16), y.astype(np.uint16), t, packed & 1 != 0)
    x, at = _masked(data, at, n)
    p, _ = _runs(data, at, n, "u1", 7)
    return Block(x, y.astype(np.uint16), t, p != 0)


def _times(data: bytes, n: int) -> tuple[np.ndarray, int]:
    """Times (n,) int64, and the offset after them."""
    origin = int.from_bytes(data[4:12], "little", signed=True)
    units = _units(data, 12, "u1")
    codes, index, count = _codes(units[: 2 * n], 4, 0xF0)
    done = count[codes >> 4 != 15][:-1].sum() >= n  # the last one may be incomplete
    if not done and len(units) > 2 * n:  # long steps: a run may take 19 bytes
        codes, index, count = _codes(units, 4, 0xF0)
    step = (codes >> 4).astype(np.int64)
    long = step == 15
    count = np.where(long, 0, count)
    last = _last(count, n)
    order = np.arange(len(codes))
    nibble = order - np.maximum.accumulate(np.where(long, -1, order)) - 1
    if nibble[: last + 1].max() > 15:
        raise ValueError("a step of more than 64 bits")
    step = np.where(long, (codes & 15).astype(np.int64) << (4 * (nibble & 15)), step)
    t = origin + np.cumsum(step[: last + 1])
    return np.repeat(t, count[: last + 1]), 12 + int(index[last + 1])


def _runs(data: bytes, at: int, n: int, kind: str, bits: int) -> tuple[np.ndarray, int]:
    """Values (n,) of runs whose count is the low bits of a unit, and the offset after them."""
    size = np.dtype(kind).itemsize
    codes, index, count = _codes(_units(data, at, kind)[:n], bits)
    last = _last(count, n)
    return (np.repeat(codes[: last + 1] >> bits, count[: last + 1]),
            at + size * int(index[last + 1]))


def _units(data: bytes, at: int, kind: str) -> np.ndarray:
    """The rest of the block from an offset on."""
    count = (len(data) - at) // np.dtype(kind).itemsize
    if count <= 0:
        raise ValueError(f"it ends at byte {len(data):,}, before all of its events")
    return np.frombuffer(data, kind, count, at)


def _codes(
    units: np.ndarray, bits: int, never: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Codes among units of which some are counts (u16): the codes (m,), their indices and the index
    after the last (m + 1,), and the counts (m,). never: codes with all of these bits set have no
    count after them."""
    full = (1 << bits) - 1
    extra = 2 // units.dtype.itemsize
    escapes = (units & full) == full
    if never:
        escapes &= (units & never) != never
    at = _apart(np.flatnonzero(escapes), 1 + extra)
    is_code = np.ones(len(units) + extra, bool)
    for i in range(1, extra + 1):
        is_code[at + i] = False
    index = np.flatnonzero(is_code[: len(units)])
    codes = units[index]
    count = (codes & full).astype(np.int64)
    padded = np.append(units, np.zeros(extra, units.dtype)).astype(np.int64)
    counts = padded[at + 1] if extra == 1 else padded[at + 1] | padded[at + 2] << 8
    count[np.searchsorted(index, at)] = counts
    return codes, np.append(index, len(units)), count


def _apart(at: np.ndarray, least: int) -> np.ndarray:
    """The ascending positions (m,) that are at least `least` after the previous one kept, since a
    count may look like another code."""
    near = np.flatnonzero(np.diff(at) < least) + 1
    if not len(near):
        return at
    keep = np.ones(len(at), bool)
    places, before, held = at.tolist(), -1, 0
    for i in near.tolist():
        held = held if i - 1 == before else places[i - 1]
        keep[i] = places[i] - held >= least
        before, held = i, places[i] if keep[i] else held
    return at[keep]


def _last(count: np.ndarray, n: int, exact: bool = True) -> int:
    """The index of the code that completes n events."""
    ends = np.cumsum(count)
    last = int(np.searchsorted(ends, n))
    if last == len(count) or (exact and ends[last] != n):
        raise ValueError(f"runs of {ends[-1] if len(ends) else 0:,} where there are {n:,} events")
    return last


def _masked(data: bytes, at: int, n: int) -> tuple[np.ndarray, int]:
    """x (n,) of units with a mask of neighbours, and the offset after them."""
    units = _units(data, at, "<u2")[:n]
    mask = (units & 31).astype(np.int64)
    count = 1 + np.bitwise_count(mask).astype(np.int64)
    last = _last(count, n, exact=False)
    of = np.repeat(np.arange(last + 1), count[: last + 1])
    ends = np.cumsum(count[: last + 1])
    first = PLACES_FROM[mask[: last + 1]] - (ends - count[: last + 1])
    place = PLACES[np.arange(len(of)) + first[of]]
    return ((units[of] >> 5) + place)[:n].astype(np.uint16), at + 2 * (last + 1)


def _threes(data: bytes, at: int, n: int, size: int) -> np.ndarray:
    """Values (n,) of 6 * size bits, four in three units of `size` bytes."""
    groups = -(-n // 4)
    if len(data) < at + 3 * size * groups:
        raise ValueError(f"it ends before its {n:,} events")
    unit = np.frombuffer(data, f"<u{size}", 3 * groups, at).astype(np.uint32).reshape(-1, 3)
    part = 2 * size  # bits that one value leaves unused in its unit
    a, b, c = unit.T
    values = (a >> part, a & (1 << part) - 1 | b >> 2 * part << part,
              b & (1 << 2 * part) - 1 | c >> 3 * part << 2 * part, c & (1 << 3 * part) - 1)
    return np.stack(values, 1).ravel()[:n]

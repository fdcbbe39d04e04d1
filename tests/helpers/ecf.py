"""ECF as Prophesee's filter writes it, one event after another: an encoder for tests."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from helpers.streams import listed

from evflow.io.decode.ecf import FILTER
from evflow.types import Events

COMPOUND = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"],
                     "offsets": [0, 2, 4, 8], "itemsize": 16})


def runs(values: list[int]) -> Iterator[tuple[int, int]]:
    """(value, how often) of each run."""
    return ((value, len(list(same))) for value, same in itertools.groupby(values))


def times(ts: list[int]) -> bytes:
    out, now = struct.pack("<q", ts[0]), ts[0]
    for t, count in runs(ts):
        step, now = t - now, t
        if step >= 15:
            while step:
                out += bytes([0xF0 | step & 15])
                step >>= 4
        head = step << 4
        out += bytes([head | count]) if count < 15 else struct.pack("<BH", head | 15, count)
    return out


def rows(ys: list[int]) -> bytes:
    return b"".join(struct.pack("<H", y << 5 | count) if count < 31 else
                    struct.pack("<2H", y << 5 | 31, count) for y, count in runs(ys))


def signs(ps: list[int]) -> bytes:
    return b"".join(struct.pack("<B", p << 7 | count) if count < 127 else
                    struct.pack("<BH", p << 7 | 127, count) for p, count in runs(ps))


def masked(xs: list[int]) -> bytes:
    out, i = b"", 0
    while i < len(xs):
        x, mask = xs[i], 0
        i += 1
        for j in range(5):
            if i < len(xs) and xs[i] == x + j + 1:
                mask |= 16 >> j
                i += 1
        out += struct.pack("<H", x << 5 | mask)
    return out


def threes(values: list[int], size: int) -> bytes:
    """Four values of 6 * size bits in three units."""
    part, out = 2 * size, b""
    for i in range(0, len(values), 4):
        v = (values + [0] * 3)[i : i + 4]
        low, middle, high = ((1 << part * k) - 1 for k in (1, 2, 3))
        units = (v[0] << part | v[1] & low, v[1] >> part << 2 * part | v[2] & middle,
                 v[2] >> 2 * part << 3 * part | v[3] & high)
        out += struct.pack(f"<3{'I' if size == 4 else 'H'}", *units)
    return out


def encode(events: list[tuple[int, int, int, int]], form: int) -> bytes:
    """(x, y, t, p) in one of the three forms."""
    xs, ys, ts, ps = (list(column) for column in zip(*events, strict=True))
    out = struct.pack("<I", len(events) << 2 | form) + times(ts)
    if form == 2:
        return out + threes([y << 12 | x << 1 | p for x, y, p in zip(xs, ys, ps, strict=True)], 4)
    if form == 1:
        return out + rows(ys) + threes([x << 1 | p for x, p in zip(xs, ps, strict=True)], 2)
    return out + rows(ys) + masked(xs) + signs(ps)


def write(path: Path, events: Events, forms: tuple[int | None, ...] = (0, 1, 2),
          block: int = 64, **attributes: Any) -> Path:
    """Metavision's HDF5, the form of each block in turn (None: not compressed); no form at all:
    without the filter."""
    table = np.array(listed(events), [("x", "i8"), ("y", "i8"), ("t", "i8"), ("p", "i8")])
    plain = np.zeros(-(-len(table) // block) * block, COMPOUND)
    for name in "xytp":
        plain[name][: len(table)] = table[name]
    plain["t"][len(table):] = table["t"][-1] if len(table) else 0
    with h5py.File(path, "w", libver=("v110", "v110")) as f:
        f.attrs.update(attributes)
        made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        made.set_chunk((block,))
        if forms:
            made.set_filter(FILTER, h5py.h5z.FLAG_OPTIONAL)
        data = h5py.h5d.create(
            f.create_group("CD").id, b"events", h5py.h5t.py_create(COMPOUND, logical=True),
            h5py.h5s.create_simple((len(table),), (h5py.h5s.UNLIMITED,)), made)
        if not forms:
            h5py.Dataset(data)[:] = plain[: len(table)]
            return path
        for k, first in enumerate(range(0, len(table), block)):
            part, form = plain[first : first + block], forms[k % len(forms)]
            raw = part.tobytes() if form is None else encode(
                [(int(e["x"]), int(e["y"]), int(e["t"]), int(e["p"])) for e in part], form)
            data.write_direct_chunk((first,), raw, filter_mask=form is None)
    return path

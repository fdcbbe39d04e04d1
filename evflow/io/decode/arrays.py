"""Events in an array or data set: four named columns, a structured array, or N x 4 numbers without
names, whose order is inferred from the values.

In all of them, integer times are us and times with fractions are seconds, unless a name or
attribute gives the unit.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode import columns, tables, written
from evflow.io.decode.stream import Chunk, Gathered, gather
from evflow.io.decode.units import without_decimals, written_unit
from evflow.io.hints import Hints
from evflow.notes import Note

JUDGED = 1 << 12  # rows from which the order of columns is inferred

Rows = Callable[[slice], tuple[Any, Any, Any, Any]]


class Table(NamedTuple):
    """n events; rows(slice) gives their x, y, t, p. name: for messages; unit: of t, "auto" if
    unknown; stored: rows per HDF5 chunk; notes: what was assumed."""

    name: str
    n: int
    rows: Rows
    unit: str = "auto"
    stored: int = 1
    notes: tuple[Note, ...] = ()

    def gather(
        self, path: Path, hints: Hints, size: Size | None, offset_us: int = 0
    ) -> Gathered:
        """The events that `hints` ask for, and all notes; raises as `stream.gather`."""
        chunks, native = in_unit(
            path, tables.blocks(self.n, self.rows, self.stored), self.unit, hints)
        found = gather(path, chunks, hints, size, native, offset_us)
        return found._replace(notes=(*self.notes, *found.notes))


def named(name: str, columns_of: dict[str, Any], n: int, unit: str = "auto") -> Table:
    """The table of columns {"t": (n,), "x": ...}."""
    t, x, y, p = (columns_of[c] for c in "txyp")
    stored = max(map(tables.stored_rows, columns_of.values())) if hasattr(t, "chunks") else 1
    return Table(name, n, lambda part: (x[part], y[part], t[part], p[part]), unit, stored)


def structured(name: str, data: Any) -> Table | None:
    """The table of an array (N,) with fields; None if they do not name all four."""
    fields = data.dtype.fields or {}
    simple = [f for f, (kind, *_) in fields.items() if kind.kind in "biufmM" and kind.shape == ()]
    chosen = columns.by_name(simple)
    if len(data.shape) != 1 or not chosen:
        return None

    def rows(part: slice) -> tuple[Any, Any, Any, Any]:
        block = data[part]
        return tuple(np.ascontiguousarray(block[chosen[c]]) for c in "xytp")  # type: ignore[return-value]

    return Table(name, len(data), rows, written_unit(chosen["t"]), _stored(data))


def matrix(name: str, data: Any) -> Table | None:
    """The table of numbers (N, 4) or (4, N); None if they cannot be events."""
    shape = data.shape
    if len(shape) != 2 or data.dtype.kind not in "biuf" or 4 not in shape:
        return None
    across = shape[1] != 4
    n = shape[across]

    def block(part: slice) -> np.ndarray:
        return np.asarray(data[:, part] if across else np.ascontiguousarray(data[part].T))

    order = columns.order_of(block(slice(0, JUDGED)).T.astype(np.float64)) if n else "txyp"
    if not order:
        return None

    def rows(part: slice) -> tuple[Any, Any, Any, Any]:
        found = block(part)
        return tuple(found[order.index(c)] for c in "xytp")  # type: ignore[return-value]

    return Table(name, n, rows, "auto", 1 if across else _stored(data), (columns.inferred(order),))


def _stored(data: Any) -> int:
    return tables.stored_rows(data) if hasattr(data, "chunks") else 1


def in_unit(
    path: Path, chunks: Iterator[Chunk], unit: str, hints: Hints
) -> tuple[Iterator[Chunk], str]:
    """The chunks and the unit of their times, which one in `hints` overrides; EV003 if fractions
    follow integer times."""
    given = hints.time_unit != "auto"
    if unit != "auto":
        return (chunks, unit) if given else (in_us(chunks, unit), "us")
    first = list(itertools.islice(chunks, 1))
    chunks = itertools.chain(first, chunks)
    if not first or first[0].t.dtype.kind != "f":
        return chunks, "us"
    t = first[0].t
    if not columns.whole(t) or without_decimals(t):
        return chunks, "s"
    return chunks if given else in_us(all_whole(path, chunks), "us"), "us"


def all_whole(path: Path, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
    """Chunks whose times were assumed to be microseconds; EV003 at the first fraction."""
    for chunk in chunks:
        if not columns.whole(chunk.t):
            raise EvflowDataError(
                "EV003", f"{path}: the first times are integers, later ones are not.",
                "Microseconds or seconds? Pass time_unit='us' or 's' (--time-unit).", where=path)
        yield chunk


def in_us(chunks: Iterable[Chunk], unit: str) -> Iterator[Chunk]:
    """Convert chunks whose times are in that unit, integer or not, to us."""
    as_given = Hints(time_unit=unit)
    for chunk in chunks:
        written.seen(chunk.t, unit, unit)
        yield chunk._replace(t=as_given.microseconds(chunk.t, unit))

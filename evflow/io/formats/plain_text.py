"""Text of four columns, as any tool writes it: comma separated files, what NumPy and pandas save,
the `x,y,p,t` of Prophesee's converter. IJRR's events.txt is read by it too.

The order is that of a header (a comment or the first line: `t x y p`, `timestamp,x,y,polarity`,
`row,col,p,t`), else that of the first lines: the polarity is the last or the third column, the time
at the other end. Times are in the unit that the header tells ("t[us]", "timestamp_ns"); else they
are seconds where they have fractions, and microseconds where they are whole and in Prophesee's
order; other whole ones are refused.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode import text
from evflow.io.decode.stream import Chunk, collect
from evflow.io.decode.units import written_unit
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "text"
EXTENSIONS: tuple[str, ...] = (".csv", ".txt", ".tsv", ".dat", ".log")

PROPHESEE = "xypt"
NAMES = {  # of columns, without their units
    **dict.fromkeys(("t", "ts", "time", "times", "timestamp", "timestamps"), "t"),
    **dict.fromkeys(("x", "xs", "col", "column", "u"), "x"),
    **dict.fromkeys(("y", "ys", "row", "v"), "y"),
    **dict.fromkeys(("p", "ps", "pol", "polarity", "polarities"), "p")}
BRACKETS, SUFFIX = re.compile(r"[\[(].*?[\])]"), re.compile(r"_[a-zµμ]+$")  # units
POLARITIES = {-1.0, 0.0, 1.0}
TELLING = 10  # rows: by so many, fractions in the coordinates are those of undistorted events


class Layout(NamedTuple):
    """order: of the columns, "txyp" or another, "itxyp" after an index; unit: of the times, "auto"
    where no header tells it; begin: the byte at which the header ends."""

    order: str
    unit: str
    begin: int


def sniff(path: Path, head: bytes) -> bool:
    try:
        return layout(head) is not None
    except EvflowDataError:  # `read` says what is unclear
        return True


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV003 (times without a unit), EV008 (a header that is not understood), EV015 (text
    does not tell the size) and what `stream.gather` raises."""
    with open(path, "rb") as f:
        chunks, native = events(path, f, hints)
        return collect(path, chunks, hints, None, native=native)


def events(path: Path, f: IO[bytes], hints: Hints) -> tuple[Iterator[Chunk], str]:
    """Chunks of the events of a text open at its beginning, and the unit of their times. Where
    nothing tells the order it is `t x y p`. Raises as `read`."""
    order, unit, begin = layout(f.read(text.HEAD)) or Layout("txyp", "auto", 0)
    f.seek(begin)
    chunks = text.events(f, (len(order),), begin, order)
    if hints.time_unit != "auto":
        return chunks, hints.time_unit
    if unit != "auto":
        return _in_us(chunks, unit), "us"
    if order == PROPHESEE:
        first = list(itertools.islice(chunks, 1))
        chunks = itertools.chain(first, chunks)
        if not first or _whole(first[0].t):
            return _in_us(_all_whole(path, chunks), "us"), "us"
    return text.in_seconds(path, chunks), "s"


def layout(head: bytes) -> Layout | None:
    """What a file that begins so holds; None where it is no text of events. EV008 where a header
    names some of the columns, but not which is which."""
    rows: list[list[float]] = []
    names: list[str] = []
    told, unit, byte, begin = "", "auto", 0, 0
    whole = head if len(head) < text.HEAD else head[: head.rfind(b"\n") + 1]
    for line in whole.splitlines(keepends=True):
        content = text.plain(line, byte)
        byte += len(line)
        fields = content.partition(b"#")[0].split()
        if fields and not rows and not any(map(text.is_float, fields)):
            told = _decoded(content)  # the first line, which must name what there is
        elif fields:
            if not all(map(text.is_number, fields)) or (rows and len(fields) != len(rows[0])):
                break  # damage, of which `text.events` tells where it is
            rows.append(list(map(float, fields)))
            continue
        elif rows or not content.strip():
            continue
        begin = byte
        if found := _names(_decoded(content)):
            names, unit = found, written_unit(_decoded(content))
    if told and not names and sum(map(bool, _columns(told))) >= 2:
        raise EvflowDataError(
            "EV008", f"its header is {told[:80]!r}: which columns are t, x, y and p?",
            "Name four columns t, x, y, p (timestamp, polarity, row, col are known too).")
    if names and rows and len(rows[0]) == 5 and _counts([row[0] for row in rows]):
        names = ["i", *names]  # the index that pandas writes
    if names:
        fits = not rows or len(rows[0]) == len(names)
        return Layout("".join(names), unit, begin) if fits else None
    order = _order(rows) if rows and not told else ""
    return Layout(order, "auto", begin) if order else None


def _decoded(line: bytes) -> str:
    """A header as text: whatever its encoding, micro is one."""
    try:
        return line.decode("utf-8").strip().lstrip("#").strip()
    except UnicodeDecodeError:
        return line.decode("latin-1").strip().lstrip("#").strip()


def _columns(line: str) -> list[str]:
    """For each word of a header what it stands for, "" where that is not known."""
    fields = BRACKETS.sub(" ", line.lower()).split()
    return [NAMES.get(SUFFIX.sub("", field.strip("\"'")), "") for field in fields]


def _names(line: str) -> list[str]:
    """Which column is which, of a header that names all four and nothing else; else nothing."""
    found = _columns(line)
    return found if sorted(found) == sorted("txyp") else []


def _counts(column: list[float]) -> bool:
    return all(b - a == 1 for a, b in itertools.pairwise(column))


def _order(rows: list[list[float]]) -> str:
    """Of rows without a header; empty where they cannot be events."""
    if len(rows[0]) != 4:
        return ""
    columns = dict(enumerate(np.array(rows).T))
    for order in ("txyp", PROPHESEE):
        t, x, y, p = (columns[order.index(name)] for name in "txyp")
        signs = set(p.tolist())
        if not signs <= POLARITIES or min(x.min(), y.min()) < 0 or set(t.tolist()) <= {0.0, 1.0}:
            continue
        rising, both = bool((np.diff(t) >= 0).all()), len(signs) > 1
        pixels = _whole(x) and _whole(y)
        if (pixels and (rising or both)) or (rising and both and len(rows) >= TELLING):
            return order
    return ""


def _whole(values: np.ndarray) -> bool:
    return bool((values % 1 == 0).all())


def _all_whole(path: Path, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
    """Chunks of times that were taken for microseconds; EV003 at the first fraction."""
    for chunk in chunks:
        if not _whole(chunk.t):
            raise EvflowDataError(
                "EV003", f"{path}: the first times are whole, later ones are not.",
                "Microseconds or seconds? Pass time_unit='us' or 's' (--time-unit).")
        yield chunk


def _in_us(chunks: Iterable[Chunk], unit: str) -> Iterator[Chunk]:
    """Chunks whose times are in that unit, with fractions or without."""
    told = Hints(time_unit=unit)
    for chunk in chunks:
        yield chunk._replace(t=told.microseconds(chunk.t, unit))

"""Text of four columns that no other format here claims: comma separated files, what NumPy and
pandas save, the `x,y,p,t` of Prophesee's converter.

The order is that of a header (a comment or the first line: `t x y p`, `timestamp,x,y,polarity`,
`x,y,p,t`), else that of the first lines: the polarity is the last or the third column, the time
the other end. Times are seconds where they have fractions; whole ones are microseconds where the
header says so ("[us]", "t_us") or the order is Prophesee's, else refused without a unit.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from evflow.io import text
from evflow.io.hints import Hints
from evflow.io.stream import Chunk, collect
from evflow.io.times import written_unit
from evflow.types import Recording

NAME = "text"
EXTENSIONS: tuple[str, ...] = (".csv", ".txt", ".tsv", ".dat", ".log")

HEAD = 4096
NAMES = {  # of columns, without their units
    **dict.fromkeys(("t", "ts", "time", "times", "timestamp", "timestamps"), "t"),
    "x": "x", "y": "y", **dict.fromkeys(("p", "pol", "polarity", "polarities"), "p")}
BRACKETS, SUFFIX = re.compile(r"[\[(].*?[\])]"), re.compile(r"_(ns|us|ms|s|sec)$")  # units
POLARITIES = {-1.0, 0.0, 1.0}


class Layout(NamedTuple):
    """order: of the columns, "txyp" or another; unit: of the times, "auto" where nothing tells;
    begin: the byte of the first line of numbers."""

    order: str
    unit: str
    begin: int


def sniff(path: Path, head: bytes) -> bool:
    return layout(head) is not None


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV003 (whole times without a unit), EV015 (text does not tell the size) and what
    `stream.gather` raises."""
    with open(path, "rb") as f:
        found = layout(f.read(HEAD))
        assert found is not None  # or another format would be reading
        f.seek(found.begin)
        chunks = _ordered(text.events(f, (4,), found.begin), found.order)
        if hints.time_unit == "auto" and found.unit != "auto":
            return collect(path, _in_us(chunks, found.unit), hints, None)
        return collect(path, text.in_seconds(path, chunks, hints), hints, None, native="s")


def layout(head: bytes) -> Layout | None:
    """What a file that begins so holds; None where it is no text of four columns."""
    rows: list[list[float]] = []
    names: list[str] = []
    words, byte, begin = "", 0, 0
    whole = head if len(head) < HEAD else head[: head.rfind(b"\n") + 1]
    for line in whole.splitlines(keepends=True):
        content = text.plain(line, byte)
        fields, comment = content.partition(b"#")[0].split(), content.lstrip().startswith(b"#")
        numbers = list(map(float, fields)) if all(map(text.is_number, fields)) else []
        if numbers and len(numbers) != 4:
            return None
        if numbers:
            rows.append(numbers)
        elif (fields or comment) and not rows:
            told = content.decode("latin-1").strip().lstrip("#")
            words, names = f"{words} {told}", _names(told) or names
            begin = byte + len(line)
        elif fields:
            return None
        byte += len(line)
    order = "".join(names) or _order(rows)
    if not order:
        return None
    usual = "us" if order == "xypt" and all(row[3] % 1 == 0 for row in rows) else "auto"
    unit = written_unit(words)
    return Layout(order, usual if unit == "auto" else unit, begin)


def _in_us(chunks: Iterator[Chunk], unit: str) -> Iterator[Chunk]:
    """Chunks whose times are in that unit, with fractions or without."""
    told = Hints(time_unit=unit)
    for chunk in chunks:
        yield chunk._replace(t=told.microseconds(chunk.t, unit))


def _names(line: str) -> list[str]:
    """Which column is which, of a header that names all four; else nothing."""
    fields = BRACKETS.sub("", line.lower()).split()
    found = [NAMES.get(SUFFIX.sub("", field.strip("\"'")), "") for field in fields]
    return found if sorted(found) == sorted("txyp") else []


def _order(rows: list[list[float]]) -> str:
    """Of rows without a header; empty where they cannot be events."""
    if not rows:
        return ""
    columns = list(zip(*rows, strict=True))
    for order, time, polarity in (("txyp", 0, 3), ("xypt", 3, 2)):
        rising = all(a <= b for a, b in itertools.pairwise(columns[time]))
        if rising and set(columns[polarity]) <= POLARITIES:
            return order
    return ""


def _ordered(chunks: Iterator[Chunk], order: str) -> Iterator[Chunk]:
    """Chunks read as t, x, y, p, their columns named as they are."""
    for chunk in chunks:
        column = dict(zip(order, (chunk.t, chunk.x, chunk.y, chunk.p), strict=True))
        yield chunk._replace(x=column["x"], y=column["y"], t=column["t"], p=column["p"])

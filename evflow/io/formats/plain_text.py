"""Text of four columns, as many tools write it: CSV, what NumPy and pandas save, the `x,y,p,t` of
Prophesee's converter. IJRR's events.txt is read by it too.

The column order comes from a header (a comment or the first line: `t x y p`,
`timestamp,x,y,polarity`, `row,col,p,t`, faery's `t,x@640,y@480,on`; columns with other names are
ignored), else from the values of the first lines (`decode.columns`). The size comes from the header
(OpenEB's `%geometry:1280,720`), if it has one. The unit of times comes from the header ("t[us]",
"timestamp_ns"); otherwise times with fractions are seconds, and integers are microseconds if the
file is from a tool that writes those (Prophesee's order or geometry, faery's header). Other
integers are refused.
"""

from __future__ import annotations

import codecs
import functools
import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode import columns, text
from evflow.io.decode.arrays import in_unit
from evflow.io.decode.stream import Chunk, collect
from evflow.io.decode.units import written_unit
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "text"
EXTENSIONS: tuple[str, ...] = (".csv", ".txt", ".tsv", ".dat", ".log")

COMMAS = str.maketrans(",;", "  ")
COMMA = re.compile(  # within a number: quoted, or if another separator stands between numbers
    rb'"-?\d{1,3}(?:,\d{3})+(?:\.\d+)?"|'
    rb"(?=.*\d,\d)-?[\d.]+(?:,\d+)*(?:[;\t ]+-?[\d.]+(?:,\d+)*)+$")
OTHERS = (b"#!AER-DAT", b"#ROSBAG")  # data behind lines that look like comments
MOST = 12  # columns of a header
TOOL = re.compile(r"^geometry:|@\d", re.MULTILINE)  # by headers of OpenEB and faery: us


class Layout(NamedTuple):
    """order: of the columns, "txyp" or another, "-" for one that is not read; unit: of the times,
    "auto" if no header gives it, "whole": us if they are integers; begin: the byte at which the
    header ends; size: (width, height), if the header gives it; notes: what was assumed."""

    order: str
    unit: str
    begin: int
    size: Size | None = None
    notes: tuple[Note, ...] = ()


def sniff(path: Path, head: bytes) -> bool:
    try:
        return layout(head) is not None
    except EvflowDataError:  # `read` explains what is unclear
        return True


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV003 (times without a unit), EV008 (unclear header), EV015 (unknown size) and what
    `stream.gather` raises."""
    with open(path, "rb") as f:
        chunks, native, found = events(path, f, hints)
        return collect(path, chunks, hints, found.size,
                       lambda: (*found.notes, *_unended(path, f, found.order)), native)


def _unended(path: Path, f: IO[bytes], order: str) -> tuple[Note, ...]:
    """A note if the last line has no line end; a polarity cannot lack digits."""
    f.seek(-1, os.SEEK_END)
    if order[-1] in "p-" or f.read(1) in b"\r\n":
        return ()
    return (Note("events.unended", f"{path} does not end with a line break: if it was truncated "
                 f"there, the {order[-1]} of its last event may lack digits"),)


def events(path: Path, f: IO[bytes], hints: Hints) -> tuple[Iterator[Chunk], str, Layout]:
    """Chunks of the events of a text opened at its beginning, the unit of their times, and the
    layout. The default order is `t x y p`. Raises as `read`."""
    found = layout(f.read(text.HEAD)) or Layout("txyp", "auto", 0)
    f.seek(found.begin)
    chunks = text.events(f, (len(found.order),), found.begin, found.order)
    if hints.time_unit != "auto":
        return chunks, hints.time_unit, found
    if found.unit == "auto":
        return text.in_seconds(path, chunks), "s", found
    chunks, native = in_unit(path, chunks, "auto" if found.unit == "whole" else found.unit, hints)
    return text.in_seconds(path, chunks) if native == "s" else chunks, native, found


@functools.lru_cache(maxsize=2)  # used to recognise a file, then to read it
def layout(head: bytes) -> Layout | None:
    """The layout of a file with this beginning; None if it is no text of events. EV008 if a header
    names some of the columns but does not identify all."""
    rows: list[list[float]] = []
    headers: list[str] = []
    heading, comments, odd, byte, begin = "", "", b"", 0, 0
    if text.is_binary(head) or head.startswith(OTHERS):
        return None
    if b"\r" in head.strip() and b"\n" not in head:
        return None  # `unread_text` explains
    whole = head if len(head) < text.HEAD else head[: head.rfind(b"\n") + 1]
    for line in whole.splitlines(keepends=True):
        words, comment = "" if rows else _decoded(line), line.lstrip().startswith((b"#", b"%"))
        fields = text.plain(line, byte).partition(b"#")[0].split()
        byte += len(line)
        if not comment and (found := COMMA.match(line.strip())):
            raise _commas(found[0])
        header = not (rows or heading) and not any(
            map(text.is_float, _fields(words.replace('"', " "))))
        if not rows and (comment or header):
            heading = words if words and not comment else heading  # it must name what there is
            headers += [words] if _order(words) else []
            begin, comments = byte, f"{comments}\n{words}"
        elif fields:
            if not all(map(text.is_number, fields)) or (rows and len(fields) != len(rows[0])):
                odd = b"" if _are_data(fields, headers) else line
                break  # damage, which `text.events` locates
            rows.append(list(map(float, fields)))
    if heading and not headers and sum(map(bool, map(columns.meaning, _fields(heading)))) >= 2:
        raise EvflowDataError(
            "EV008", f"its header is {heading[:80]!r}: which columns are t, x, y and p?",
            "Name four columns t, x, y, p (timestamp, polarity, row, col are known too).")
    if headers and odd and not rows:
        raise EvflowDataError(
            "EV008", f"after its header {headers[-1][:80]!r} comes {odd.strip()[:60]!r}.",
            "Lines must be numbers: t in seconds or integer microseconds, polarity 0 and 1, -1 and "
            "1, or a word (true, false, on, off, pos, neg).")
    default = Layout("", "whole" if TOOL.search(comments) else "auto", begin,
                     columns.written_size(comments))
    return _laid_out(headers, rows, bool(heading), default)


def _are_data(fields: list[bytes], headers: list[str]) -> bool:
    """Whether the fields that the last header names are numbers (NaN included)."""
    order = _order(headers[-1]) if headers else ""
    return all(text.is_float(field) for field, name in zip(fields, order, strict=False)
               if name != "-")


def _commas(seen: bytes) -> EvflowDataError:
    return EvflowDataError(
        "EV008", f"its numbers contain commas: {seen[:40].decode('ascii', 'replace')}.",
        "Write them without thousands separators." if seen.startswith(b'"') else
        "Convert decimal commas to points with sed 's/,/./g'; remove thousands separators with "
        "sed 's/,//g'.")


def _laid_out(
    headers: list[str], rows: list[list[float]], heading: bool, default: Layout
) -> Layout | None:
    """The layout by the last header that fits the rows, else by the rows; heading: a line
    of its own, not a comment, names the columns; default: what the header says about the rest."""
    for words in reversed(headers):
        order = _order(words)
        if rows and len(rows[0]) == len(order) + 1 and _counts([row[0] for row in rows]):
            order = f"-{order}"  # the index that pandas writes
        if rows and len(rows[0]) != len(order):
            continue
        named = columns.by_name(_fields(words)).values()
        left = [name for name in _fields(words) if name not in named]
        notes = (Note("events.unread", f"columns {', '.join(left)} were not read"),) if left else ()
        unit = written_unit(words)
        return default._replace(order=order, notes=notes, unit=unit if unit != "auto" else
                                _unit(order, default))
    order = columns.order_of(np.array(rows)) if rows and len(rows[0]) == 4 and not heading else ""
    if order and default.unit == "whole" and len(rows) < columns.TELLING and (
            {row[2] for row in rows} <= columns.POLARITIES):
        order = columns.PROPHESEE  # few values say little, but the tool uses this order
    if not order:
        return None
    notes = () if order in columns.KNOWN else (columns.inferred(order),)
    return default._replace(order=order, notes=notes, unit=_unit(order, default))


def _unit(order: str, default: Layout) -> str:
    """The unit of times for which none is given."""
    return "whole" if order == columns.PROPHESEE else default.unit


def _decoded(line: bytes) -> str:
    """A header line as text; the micro sign is understood in any encoding."""
    line = line.removeprefix(codecs.BOM_UTF8)
    try:
        words = line.decode("utf-8")
    except UnicodeDecodeError:
        words = line.decode("latin-1")
    return words.strip().lstrip("#%").strip()


def _fields(words: str) -> list[str]:
    """The words of a header, without their units in brackets."""
    return columns.BRACKETS.sub(" ", words.translate(COMMAS)).split()


def _order(words: str) -> str:
    """Which column is which, if a header names all four ("-" for others); else "". A comment counts
    as a header only if it names nothing else."""
    fields = _fields(words)
    chosen = columns.by_name(fields)
    if not chosen or len(fields) > MOST or len(set(fields)) < len(fields):
        return ""
    heading = {name: column for column, name in chosen.items()}
    return "".join(heading.get(name, "-") for name in fields)


def _counts(column: list[float]) -> bool:
    return all(b - a == 1 for a, b in itertools.pairwise(column))

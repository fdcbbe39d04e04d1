"""Text with one event per line, in blocks of whole lines: numbers between blanks or commas, `#`
comments.

A line that is not such becomes `Damage` at its byte. Memory: one block and its table of float64.
"""

from __future__ import annotations

import codecs
import io
import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from evflow.io.decode.stream import Chunk, Damage
from evflow.io.decode.units import check_text_seconds

BLANKS = bytes.maketrans(b",;\"", b"   ")  # what else stands between numbers
HEAD = 1 << 14  # bytes by which a file is recognised, and the order of its columns told
BLOCK = 1 << 21  # bytes parsed at a time, 75,000 lines
BINARY = 512  # bytes that tell text from other data, which has zeros among them
MAX_LINE = 1000  # a longer one is not text
WORD = re.compile(rb"\b(?:true|false|on|off|pos|neg|positive|negative)\b", re.IGNORECASE)
ON = (b"true", b"on", b"pos", b"positive")


def events(
    f: IO[bytes], widths: tuple[int, ...], byte: int = 0, order: str = "txyp"
) -> Iterator[Chunk]:
    """Chunks of lines of one of these numbers of columns, whose first are those of `order`, "-" for
    one that is not looked at; f is at `byte`. What stands before a line that is none comes out
    before Damage is raised."""
    line = 0
    read = tuple(i for i, name in enumerate(order) if name != "-") if "-" in order else None
    order = order.replace("-", "")
    for start, block in _blocks(f, byte):
        table, widths, damage = _parse(start, plain(block, start), widths, read)
        t, x, y, p = (table[:, order.index(name)] for name in "txyp")
        yield Chunk(x, y, t, p, lambda i, line=line: line + i, "event")  # type: ignore[misc]
        if damage:
            raise damage
        line += len(table)


def in_seconds(path: Path, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
    """The chunks; EV003 where the times of the first are no seconds, by `check_text_seconds`."""
    seen = False
    for chunk in chunks:
        if not seen and len(chunk.t):
            reach = [max(float(np.nanmax(a, initial=0.0)), 0.0) + 1 for a in (chunk.x, chunk.y)]
            check_text_seconds(chunk.t, path, reach[0] * reach[1])
        seen = seen or len(chunk.t) > 0
        yield chunk


def plain(block: bytes, byte: int) -> bytes:
    """Lines of as many bytes with blanks between their numbers: no commas, no byte order mark at
    byte 0, and words for a polarity (True, OFF, pos ...) in any case as 1 and 0."""
    if byte == 0 and block.startswith(codecs.BOM_UTF8):
        block = b"   " + block[len(codecs.BOM_UTF8):]
    if WORD.search(block, 0, MAX_LINE):  # where one line has one, all have
        for word in set(WORD.findall(block)):
            digit = b"1" if word.lower() in ON else b"0"
            block = re.sub(rb"\b%b\b" % word, digit.ljust(len(word)), block)
    return block.translate(BLANKS)


def _blocks(f: IO[bytes], byte: int) -> Iterator[tuple[int, bytes]]:
    """(its first byte, a block of whole lines); the last line may lack its end."""
    rest = b""
    while data := f.read(BLOCK):
        rest += data
        end = rest.rfind(b"\n") + 1
        if end:
            yield byte, rest[:end]
            byte, rest = byte + end, rest[end:]
        if len(rest) > MAX_LINE:
            raise Damage(byte, f"a line of more than {MAX_LINE} bytes is not text")
    if rest:
        yield byte, rest


def _parse(
    byte: int, block: bytes, widths: tuple[int, ...], read: tuple[int, ...] | None
) -> tuple[np.ndarray, tuple[int, ...], Damage | None]:
    """(rows, columns) float64, the one width that later blocks must have, and what is wrong with
    the line after those rows, if there is one. read: the columns to read; None: all."""
    table = _table(block, widths, read)
    damage = None
    if table is None:
        sound, damage = _before_damage(byte, block, widths, read)
        table = _table(sound, widths, read)
    if table is None:  # what no line by itself shows
        table, damage = np.zeros((0, len(read or range(widths[0])))), Damage(
            byte, "what stands here is not plain text")
    settled = read is None and (len(table) or damage)
    return table, (table.shape[1],) if settled else widths, damage


def _table(
    block: bytes, widths: tuple[int, ...], read: tuple[int, ...] | None
) -> np.ndarray | None:
    """The numbers of a block of lines; None where they are none, or not as many a line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a block of comments holds no data
            table = np.loadtxt(io.StringIO(block.decode("ascii", "replace")), ndmin=2, usecols=read)
    except ValueError:
        return None
    if table.size == 0:
        return np.zeros((0, len(read or range(widths[0]))))
    sound = table.shape[1] in (widths if read is None else (len(read),))
    return table if sound and np.isfinite(table).all() else None


def _before_damage(
    byte: int, block: bytes, widths: tuple[int, ...], read: tuple[int, ...] | None
) -> tuple[bytes, Damage]:
    """The lines before the first that is none, and what that one is."""
    at = 0
    for content in block.split(b"\n"):
        fields = content.partition(b"#")[0].split()
        if fields and len(fields) in widths and all(
                is_number(fields[i]) for i in read or range(len(fields))):
            widths = (len(fields),)
        elif fields:
            return block[:at], Damage(byte + at, f"the line {content[:60]!r} is not `t x y p` "
                                      f"({' or '.join(map(str, widths))} numbers)")
        at += len(content) + 1
    return block, Damage(byte + at, "what stands before is not plain text")


def is_binary(head: bytes) -> bool:
    """Is what begins so no text?"""
    return b"\0" in head[:BINARY]


def is_number(field: bytes) -> bool:
    """Is it a finite number?"""
    return is_float(field) and bool(np.isfinite(float(field)))


def is_float(field: bytes | str) -> bool:
    """Is it a number, NaN and infinity among them? 1_000 is none in a table."""
    try:
        float(field)
    except ValueError:
        return False
    return b"_" not in field if isinstance(field, bytes) else "_" not in field

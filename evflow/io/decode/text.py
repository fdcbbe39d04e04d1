"""Text with one event per line, in blocks of whole lines: numbers separated by blanks or commas,
`#` comments.

Any other line becomes `Damage` at its byte. Memory: one block and its float64 table.
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

BLANKS = bytes.maketrans(b",;\"", b"   ")  # other separators become blanks
HEAD = 1 << 14  # bytes used to recognise a file and its column order
BLOCK = 1 << 21  # bytes parsed at a time, 75,000 lines
BINARY = 512  # bytes used to distinguish text from binary data, which contain zeros
MAX_LINE = 1000  # a longer line is not text
WORD = re.compile(rb"\b(?:true|false|on|off|pos|neg|positive|negative)\b", re.IGNORECASE)
ON = (b"true", b"on", b"pos", b"positive")


def events(
    f: IO[bytes], widths: tuple[int, ...], byte: int = 0, order: str = "txyp"
) -> Iterator[Chunk]:
    """Chunks of lines with one of these numbers of columns, the first of which are those of `order`
    ("-" for one that is ignored); f is at `byte`. Events before an invalid line are yielded before
    Damage is raised."""
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
    """The chunks; EV003 if the first times are not seconds (`check_text_seconds`)."""
    seen = False
    for chunk in chunks:
        if not seen and len(chunk.t):
            check_text_seconds(chunk.t, path, chunk.area())
        seen = seen or len(chunk.t) > 0
        yield chunk


def plain(block: bytes, byte: int) -> bytes:
    """Lines of the same length in bytes, with blanks between numbers: without commas, byte order
    mark and polarity words."""
    if byte == 0 and block.startswith(codecs.BOM_UTF8):
        block = b"   " + block[len(codecs.BOM_UTF8):]
    return without_words(block).translate(BLANKS)


def without_words(block: bytes) -> bytes:
    """Lines of the same length in bytes, with polarity words (True, OFF, pos ... in any case)
    replaced by 1 and 0."""
    if WORD.search(block, 0, MAX_LINE):  # if one line has a word, all have
        for word in set(WORD.findall(block)):
            digit = b"1" if word.lower() in ON else b"0"
            block = re.sub(rb"\b%b\b" % word, digit.ljust(len(word)), block)
    return block


def _blocks(f: IO[bytes], byte: int) -> Iterator[tuple[int, bytes]]:
    """(offset, block of whole lines); the last line may lack its line end."""
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
    """(rows, columns) float64, the number of columns that later blocks must have, and the Damage of
    the line after those rows, if any. read: the columns to read; None: all."""
    table = _table(block, widths, read)
    damage = None
    if table is None:
        sound, damage = _before_damage(byte, block, widths, read)
        table = _table(sound, widths, read)
    if table is None:  # although each line alone looks right
        table, damage = np.zeros((0, len(read or range(widths[0])))), Damage(
            byte, "this is not plain text")
    settled = read is None and (len(table) or damage)
    return table, (table.shape[1],) if settled else widths, damage


def _table(
    block: bytes, widths: tuple[int, ...], read: tuple[int, ...] | None
) -> np.ndarray | None:
    """The numbers of a block of lines; None if they are not numbers, or not equally many a line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # for a block of comments only
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
    """The valid lines at the start, and the Damage describing the first invalid one."""
    at = 0
    for content in block.split(b"\n"):
        fields = content.partition(b"#")[0].split()
        if fields and len(fields) in widths and all(
                is_number(fields[i]) for i in read or range(len(fields))):
            widths = (len(fields),)
        elif fields:
            header = not any(map(is_float, fields)) and len(fields) in widths
            return block[:at], Damage(byte + at, f"the line {content[:60]!r} is not `t x y p` "
                                      f"({' or '.join(map(str, widths))} numbers)" + (
                                          ", but a header: were files joined? Remove that line"
                                          if header else ""))
        at += len(content) + 1
    return block, Damage(byte + at, "what comes before this is not plain text")


def is_binary(head: bytes) -> bool:
    """Whether data with this beginning are not text."""
    return b"\0" in head[:BINARY]


def is_number(field: bytes) -> bool:
    """Whether the field is a finite number."""
    return is_float(field) and bool(np.isfinite(float(field)))


def is_float(field: bytes | str) -> bool:
    """Whether the field is a number, including NaN and infinity (1_000 is not)."""
    try:
        float(field)
    except ValueError:
        return False
    return b"_" not in field if isinstance(field, bytes) else "_" not in field

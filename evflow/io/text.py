"""Text with one event per line, in blocks of whole lines: numbers between blanks or commas, `#`
comments.

A line that is not such becomes `Damage` at its byte. Memory: one block and its table of float64.
"""

from __future__ import annotations

import codecs
import io
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.hints import Hints
from evflow.io.stream import Chunk, Damage

BLANKS = bytes.maketrans(b",;", b"  ")  # what else stands between numbers
BLOCK = 1 << 21  # bytes parsed at a time, 75,000 lines
MAX_LINE = 1000  # a longer one is not text


def events(f: IO[bytes], widths: tuple[int, ...], byte: int = 0) -> Iterator[Chunk]:
    """Chunks of lines `t x y p ...` of one of these numbers of columns; f is at `byte`."""
    line = 0
    for start, block in _blocks(f, byte):
        table, widths = _parse(start, plain(block, start), widths)
        t, x, y, p = table[:, :4].T
        yield Chunk(x, y, t, p, lambda i, line=line: line + i, "event")  # type: ignore[misc]
        line += len(table)


def in_seconds(path: Path, chunks: Iterable[Chunk], hints: Hints) -> Iterator[Chunk]:
    """The chunks; EV003 where the times of the first are whole numbers, which seconds are not."""
    seen = False
    for chunk in chunks:
        whole = not seen and len(chunk.t) >= 10 and bool((chunk.t % 1 == 0).all())
        if whole and hints.time_unit == "auto":
            raise EvflowDataError(
                "EV003", f"{path}: all times are whole numbers ({chunk.t[0]:.0f}, ...), not "
                "seconds.", "Microseconds? Pass time_unit='us' (--time-unit us).")
        seen = seen or len(chunk.t) > 0
        yield chunk


def plain(block: bytes, byte: int) -> bytes:
    """Lines with blanks between their numbers; a byte order mark at byte 0 becomes blanks too."""
    if byte == 0 and block.startswith(codecs.BOM_UTF8):
        block = b"   " + block[len(codecs.BOM_UTF8):]
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


def _parse(byte: int, block: bytes, widths: tuple[int, ...]) -> tuple[np.ndarray, tuple[int, ...]]:
    """(rows, columns) float64, and the one width that later blocks must have."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a block of comments holds no data
            table = np.loadtxt(io.StringIO(block.decode("ascii")), ndmin=2)
        if table.size == 0:
            return np.zeros((0, widths[0])), widths
        if table.shape[1] in widths and np.isfinite(table).all():
            return table, (table.shape[1],)
    except ValueError:
        pass
    for content in block.split(b"\n"):
        fields = content.partition(b"#")[0].split()
        if fields and widths and len(fields) in widths and all(map(is_number, fields)):
            widths = (len(fields),)
        elif fields:
            raise Damage(byte, f"the line {content[:60]!r} is not `t x y p` "
                         f"({' or '.join(map(str, widths))} numbers)")
        byte += len(content) + 1
    raise Damage(byte, "what stands before is not plain text")


def is_number(field: bytes) -> bool:
    """Is it a finite number?"""
    try:
        return bool(np.isfinite(float(field)))
    except ValueError:
        return False

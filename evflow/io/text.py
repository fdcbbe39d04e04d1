"""Text with one event per line, in blocks of whole lines: numbers between blanks, `#` comments.

A line that is not such becomes `Damage` at its byte. Memory: one block and its table of float64.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from typing import IO

import numpy as np

from evflow.io.stream import Chunk, Damage

BLOCK = 1 << 21  # bytes parsed at a time, 75,000 lines
MAX_LINE = 1000  # a longer one is not text


def events(f: IO[bytes], widths: tuple[int, ...], byte: int = 0) -> Iterator[Chunk]:
    """Chunks of lines `t x y p ...` of one of these numbers of columns; f is at `byte`."""
    line = 0
    for start, block in _blocks(f, byte):
        table, widths = _parse(start, block, widths)
        t, x, y, p = table[:, :4].T
        yield Chunk(x, y, t, p, lambda i, line=line: line + i, "event")  # type: ignore[misc]
        line += len(table)


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

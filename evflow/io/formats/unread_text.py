"""Text that cannot be read as events: what it is instead, and what to do with it."""

from __future__ import annotations

import codecs
from typing import NamedTuple

from evflow.io.decode import text

MOST = 200  # lines examined


class Known(NamedTuple):
    """What a file is, and what to do."""

    what: str
    fix: str


def known(head: bytes) -> Known | None:
    """What text with this beginning is; None if it is not text."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return Known("text in UTF-16, as Windows' PowerShell writes it",
                     "Convert it: iconv -f UTF-16 -t UTF-8 IN > OUT.txt.")
    if b"\0" in head:
        return None
    if b"\r" in head.strip() and b"\n" not in head:
        return Known("text whose lines end with a carriage return alone",
                     "Convert it: tr '\\r' '\\n' < IN > OUT.txt.")
    if head.lstrip()[:1] in (b"{", b"["):
        return Known("JSON", "Write lines `t x y p` with that header instead.")
    return _numbers(head)


def _numbers(head: bytes) -> Known | None:
    """For lines of equally many numbers that cannot be events."""
    rows: list[list[float]] = []
    for line in text.plain(head, 0).split(b"\n")[:MOST]:
        fields = line.partition(b"#")[0].split()
        if fields and not line.startswith(b"%") and all(map(text.is_number, fields)):
            rows.append(list(map(float, fields)))
    if len(rows) < 2 or len({len(row) for row in rows[:-1]}) > 1:
        return None
    columns = list(zip(*rows[:-1], strict=True))
    few = [f"number {i} holds {', '.join(f'{v:g}' for v in sorted(set(column)))}"
           for i, column in enumerate(columns, 1) if len(set(column)) <= 3]
    return Known(
        f"text of {len(columns)} columns of numbers, which by their values are not t, x, y and p"
        + (f" ({'; '.join(few)})" if few else ""),
        "Events need a polarity, a fourth column: 0 and 1, or -1 and 1." if len(columns) < 4 else
        "Name the columns in a first line (t x y p, others may stand beside them); polarity is 0 "
        "and 1, or -1 and 1.")

"""Text as the simulator v2e writes it (v2ecore/output/ae_text_output.py): `#` lines that name v2e,
then a line `t[s] x y p` per event, and with --label_signal_noise a fifth number, 1 = signal,
0 = noise, which is not read. Such lines are read without a header too.
"""

from __future__ import annotations

import re
from pathlib import Path

from evflow.io.decode import text
from evflow.io.decode.stream import collect
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "v2e-text"
EXTENSIONS: tuple[str, ...] = (".txt",)

ROW = re.compile(rb"[\d.eE+-]+ \d+ \d+ -?[01]( [01])?\r?")


def sniff(path: Path, head: bytes) -> bool:
    lines = head.split(b"\n")
    named = any(line.startswith(b"#") and b"v2e" in line for line in lines)
    data = [line for line in lines if line.strip() and not line.startswith(b"#")]
    row = ROW.fullmatch(data[0]) if data else None
    return (head.startswith(b"#") and named and (row is not None or len(data) < 2)) or (
        row is not None and row[1] is not None)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV015 (unknown size) and what `stream.gather` raises."""
    with open(path, "rb") as f:
        return collect(path, text.events(f, (4, 5)), hints, None, native="s")

"""Text of E2VID (rpg_e2vid): the first line `width height`, then a line `t[s] x y p` per event, in
a .txt file or in a zip by itself. Written with all six decimals, so that no microsecond is lost.
"""

from __future__ import annotations

import contextlib
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.archives import unzipped
from evflow.files.whole import need_members, need_size
from evflow.io.decode import text
from evflow.io.decode.stream import collect
from evflow.io.hints import Hints
from evflow.io.writer import SECONDS_US, EventWriter, blocks
from evflow.types import Events, Recording

NAME = "e2vid"
EXTENSIONS: tuple[str, ...] = (".zip", ".txt")

FIRST = re.compile(rb"[ \t]*(\d{1,5})[ \t]+(\d{1,5})[ \t]*\r?\n")
LINES = 1 << 14  # lines formatted at a time
EVENT = re.compile(rb"$|[\d.eE+-]+[ \t]+\d+[ \t]+\d+[ \t]+-?[01][ \t]*\r?(\n|$)")


def sniff(path: Path, head: bytes) -> bool:
    if _is_text(head):
        return True
    if not head.startswith(b"PK\x03\x04"):
        return False
    try:
        with _opened(path) as f:
            return _is_text(f.readline(100) + f.readline(100))
    except EvflowDataError as e:
        return e.code == "EV009"  # `read` explains the damage


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (several files in the zip), EV009 (damaged) and what `stream.gather` raises."""
    with _opened(path) as f:
        line = f.readline(100)
        first = FIRST.match(line)
        if first is None:
            raise EvflowDataError(
                "EV009", f"{path} begins with {line[:40]!r}; expected `width height`.",
                "Copy or write it again.", where=path)
        return collect(path, text.events(f, (4,), len(line)), hints,
                       (int(first[1]), int(first[2])), native="s")


def _is_text(head: bytes) -> bool:
    first = FIRST.match(head)
    return first is not None and EVENT.match(
        text.without_words(head), first.end()) is not None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    """The text file, or the only .txt in the zip."""
    with open(path, "rb") as f:
        if f.read(2) != b"PK":
            f.seek(0)
            yield f
            return
    with unzipped(path) as archive:
        names = [n for n in archive.namelist()
                 if n.lower().endswith(".txt") and not n.startswith("__MACOSX")]
        if len(names) != 1:
            raise EvflowDataError(
                "EV008", f"{path} holds {len(names)} texts: {sorted(names)[:5]}.",
                "Pass a zip with one text file of events.", where=path)
        with archive.open(names[0]) as inner:
            yield inner


class E2vidWriter(EventWriter):
    """Events only: E2VID reads the zip through pandas, which wants a single file in it. If the
    output ends in .txt, the text itself is written."""

    NAME = NAME
    DEPTHS = ()
    TIMES_US = (0, SECONDS_US)

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        if self.path.suffix.lower() == ".txt":
            self._file: IO[bytes] = stack.enter_context(open(temporary, "wb"))  # noqa: SIM115
        else:
            archive = stack.enter_context(zipfile.ZipFile(
                temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1))
            name = f"{self.path.stem}.txt"
            self._file = stack.enter_context(archive.open(name, "w", force_zip64=True))
        self._bytes = self._file.write(b"%d %d\n" % self.size)

    def _write(self, events: Events) -> None:
        for part in blocks(events, LINES):
            seconds, us = np.divmod(part.t, 1_000_000)
            rows = np.stack([seconds, us, part.x, part.y, part.p], 1)
            self._bytes += self._file.write(
                b"%d.%06d %d %d %d\n" * len(rows) % tuple(rows.ravel().tolist()))

    def _verify(self, temporary: Path) -> None:
        if self.path.suffix.lower() == ".txt":
            need_size(temporary, self._bytes)
        else:
            need_members(temporary, {f"{self.path.stem}.txt": self._bytes})

"""ROS 2 bags, see bag.py: a folder with metadata.yaml, or a single one of its files.

Only the file names are read from the metadata: everything else is in the files themselves, which
may be compressed as a whole, message by message or not at all, as their first bytes show.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path, PurePath
from typing import IO, NamedTuple

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.compressed import ZSTD, decoder_of, unpack
from evflow.files.limits import FREE, RATIO
from evflow.files.regular import is_there
from evflow.io.formats.ros import database, mcap
from evflow.io.formats.ros.bag import Bag, read_bag, triggers_of
from evflow.io.formats.ros.database import Database
from evflow.io.formats.ros.mcap import Mcap
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

NAME = "rosbag2"
DATABASE, MCAP = ".db3", ".mcap"
EXTENSIONS: tuple[str, ...] = (MCAP, DATABASE)

METADATA, LIST = "metadata.yaml", "relative_file_paths:"
MOST_METADATA = 1 << 24  # bytes; a recording of a thousand files has 300 kB
LARGEST_MESSAGE = 1 << 26  # bytes above which it must not expand more than recordings do
BLOCK = 1 << 20


def sniff(path: Path, head: bytes) -> bool:
    if path.is_dir():
        metadata = path / METADATA
        return metadata.is_file() and b"rosbag2_bagfile_information" in _begin(metadata, 4096)
    return head.startswith(mcap.MAGIC) or (
        head.startswith(database.MAGIC) and path.suffix == DATABASE)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV010 (no `rosbags`, for compressed bags) and what `read_bag` raises."""
    with _bag(path, partial=hints.partial) as bag:
        found = read_bag(bag, hints)
        notes = tuple(Note("events.partial", "only the part before the damage was read "
                           f"(--partial): {text}") for text in bag.reader.damage)
        return dataclasses.replace(found, notes=(*notes, *found.notes)) if notes else found


def triggers(path: Path, topic: str | None) -> np.ndarray:
    """Times (N,) int64 us of external signals beside the events of a topic; raises as `read`."""
    with _bag(path, partial=True) as bag:
        return triggers_of(bag, topic)


def _bag(path: Path, *, partial: bool) -> Bag:
    return Bag(path, lambda path: Reader(path, partial=partial), aligned=True,
               mend=_mend(path, partial=partial))


def _mend(path: Path, *, partial: bool) -> str:
    """How to read what is left of a bag that was cut off: `ros2 bag reindex` writes the metadata
    anew, but mends no file."""
    files = path.iterdir() if path.is_dir() else [path]
    if any(MCAP in file.suffixes for file in files):
        recovered = f"read what `mcap recover FILE{MCAP} -o NEW{MCAP}` writes"
        return recovered if partial else f"pass --partial, or {recovered}"
    return f'read what `sqlite3 FILE{DATABASE} ".clone NEW{DATABASE}"` writes'


class Connection(NamedTuple):
    """A topic, its message type and count, in the form that `Bag` expects."""

    topic: str
    msgtype: str
    msgcount: int


class Reader:
    """All files of a bag in sequence. damage: what is wrong with those that were not read to their
    end."""

    def __init__(self, path: Path, *, partial: bool = False) -> None:
        with contextlib.ExitStack() as stack:
            files = _files(path) if path.is_dir() else [path]
            self.storages = [_storage(file, stack, partial=partial) for file in files]
            self._open = stack.pop_all()
        self.damage = [f"{file.name}, {storage.damage}" for file, storage in zip(
            files, self.storages, strict=True) if storage.damage]
        counts = sum((storage.counts for storage in self.storages[1:]),
                     self.storages[0].counts.copy())
        topics = {topic for storage in self.storages for topic in storage.counts}
        self.connections = [Connection(*topic, counts[topic]) for topic in sorted(topics)]

    def close(self) -> None:
        self._open.close()

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection | None, int, bytes]]:
        """(None, time of recording in ns, message), in the form that `Bag` expects."""
        topics = {connection.topic for connection in connections}
        for storage in self.storages:
            for time, raw in storage.messages(topics):
                if raw.startswith(ZSTD):  # messages of ROS 2 begin with 0
                    raw = unpack(raw, "zstd", LARGEST_MESSAGE + RATIO * len(raw))
                yield None, time, raw


def _files(folder: Path) -> list[Path]:
    """The files listed in the metadata, which rosbag2 writes one per line; EV009 if one is missing
    or none is listed."""
    text = _begin(folder / METADATA, MOST_METADATA).decode("utf-8", "replace")
    listed = text.partition(LIST)[2]
    names, lines = list[str](), iter(listed.splitlines())
    rest = next(lines, "").strip()
    if rest.startswith("["):  # all on one line
        names = [name.strip(" '\"") for name in rest.strip("[]").split(",")]
    else:
        for line in map(str.strip, lines):
            if not line.startswith("- "):
                break
            names.append(line[2:].strip(" '\""))
    files = [folder / PurePath(name).name for name in names]
    missing = [file.name for file in files if not is_there(file)]
    if missing or not names or not all(names):
        seen = f"what is missing: {', '.join(missing[:5])}" if missing else "no files"
        raise EvflowDataError(
            "EV009", f"{folder / METADATA} lists {seen}.", "Copy the bag again; or pass one of its "
            "files alone, or run `ros2 bag reindex` on the folder, which lists those that are "
            "there.", where=folder)
    return files


def _storage(path: Path, stack: contextlib.ExitStack, *, partial: bool) -> Database | Mcap:
    """The open file, first decompressed to a temporary one if necessary. partial: as of `Mcap`."""
    head = _begin(path, 16)
    if head.startswith(ZSTD):
        path = _unpacked(path, stack)
        head = _begin(path, 16)
    if not head.startswith((mcap.MAGIC, database.MAGIC)):
        raise ValueError(f"{path.name} is neither an MCAP file nor a database")
    storage = Mcap(path, partial=partial) if head.startswith(mcap.MAGIC) else Database(path)
    stack.callback(storage.close)
    return storage


def _unpacked(path: Path, stack: contextlib.ExitStack) -> Path:
    """A temporary file with the decompressed content; EV019 if the disk is full."""
    out = tempfile.NamedTemporaryFile(prefix="evflow-", suffix=path.stem)  # noqa: SIM115
    stack.enter_context(out)
    left = FREE + RATIO * path.stat().st_size
    try:
        with path.open("rb") as packed:
            for part in _parts(packed):
                left -= len(part)
                if left < 0:
                    raise ValueError(f"{path.name} expands too far")
                out.write(part)
        out.flush()
    except OSError as e:
        if e.errno != errno.ENOSPC:
            raise
        raise EvflowDataError(
            "EV019", f"{tempfile.gettempdir()}, where {path} is unpacked, is full.",
            "Set TMPDIR to a folder with more space, or unpack it: zstd -d.", where=path) from e
    return Path(out.name)


def _parts(packed: IO[bytes]) -> Iterator[bytes]:
    """The content of a file of zstd frames, in blocks; EOFError if it is truncated."""
    decoder, waiting = decoder_of("zstd"), b""
    while block := waiting or packed.read(BLOCK):
        if decoder.eof:
            decoder = decoder_of("zstd")
        yield decoder.decompress(block, max_length=BLOCK)
        while not (decoder.eof or decoder.needs_input):
            yield decoder.decompress(b"", max_length=BLOCK)
        waiting = decoder.unused_data if decoder.eof else b""
    if not decoder.eof:
        raise EOFError("it is cut off")


def _begin(path: Path, size: int) -> bytes:
    with path.open("rb") as file:
        return file.read(size)

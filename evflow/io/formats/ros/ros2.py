"""ROS 2 bags, see bag.py: a folder with its metadata.yaml, or one of its files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from evflow.files.bounded import BoundedPath
from evflow.files.limits import RATIO
from evflow.io.formats.ros.bag import Bag, read_bag
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "rosbag2"
DATABASE = ".db3"
EXTENSIONS: tuple[str, ...] = (".mcap", DATABASE)

METADATA = "metadata.yaml"
LARGEST_CHUNK = 1 << 26  # bytes, beyond which it must not expand more than recordings do
LARGEST_PAGE = 65536  # which two bytes of a header can't say


def sniff(path: Path, head: bytes) -> bool:
    if path.is_dir():
        metadata = path / METADATA
        return metadata.is_file() and b"rosbag2_bagfile_information" in metadata.read_bytes()[:4096]
    return head.startswith(b"\x89MCAP0\r\n") or (
        head.startswith(b"SQLite format 3\0") and path.suffix == DATABASE)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV010 (no `rosbags`) and what `read_bag` raises."""
    with Bag(path, _open, aligned=True, mend="ros2 bag reindex") as bag:
        return read_bag(bag, hints)


def _open(path: Path) -> Any:
    from rosbags.rosbag2 import Reader

    for file in path.glob("*") if path.is_dir() else (path,):
        if file.suffix == DATABASE:
            _whole(file)
    reader = Reader(BoundedPath(path))
    reader.open()
    try:
        _check_chunks(reader.storage)
    except ValueError:
        reader.close()
        raise
    return reader


def _check_chunks(storage: Any) -> None:
    """ValueError where a chunk claims to expand beyond what recordings do."""
    for part in getattr(storage, "storages", (storage,)):
        for chunk in getattr(part, "chunks", ()):
            if chunk.uncompressed_size > LARGEST_CHUNK + RATIO * chunk.compressed_size:
                raise ValueError(f"a chunk of {chunk.compressed_size:,} bytes claims "
                                 f"{chunk.uncompressed_size:,}")


def _whole(path: Path) -> None:
    """ValueError where a database ends before its last page, of which SQLite says nothing: rows
    are missing, or stand in for others. Its header: www.sqlite.org/fileformat.html, 1.3."""
    with path.open("rb") as file:
        head = file.read(100)
    page, changed, pages, valid = (int.from_bytes(head[a:b], "big") for a, b in (
        (16, 18), (24, 28), (28, 32), (92, 96)))
    claimed = pages * (LARGEST_PAGE if page == 1 else page)
    if changed == valid and path.stat().st_size < claimed:
        raise ValueError(f"{path.name} has {path.stat().st_size:,} of {claimed:,} bytes")

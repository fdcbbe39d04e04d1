"""ROS 2 bags, see `evflow.io.bag`: a folder with its metadata.yaml, or one of its files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from evflow.io.bag import Bag, read_bag
from evflow.io.hints import Hints
from evflow.io.limits import check_expansion
from evflow.types import Recording

NAME = "rosbag2"
EXTENSIONS: tuple[str, ...] = (".mcap", ".db3")

METADATA = "metadata.yaml"


def sniff(path: Path, head: bytes) -> bool:
    if path.is_dir():
        metadata = path / METADATA
        return metadata.is_file() and b"rosbag2_bagfile_information" in metadata.read_bytes()[:4096]
    return head.startswith(b"\x89MCAP0\r\n") or (
        head.startswith(b"SQLite format 3\0") and path.suffix == ".db3")


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV010 (no `rosbags`) and what `read_bag` raises."""
    with Bag(path, _open, aligned=True, mend="ros2 bag reindex") as bag:
        return read_bag(bag, hints)


def _open(path: Path) -> Any:
    from rosbags.rosbag2 import Reader

    reader = Reader(path)
    reader.open()
    storage: Any = reader.storage
    for part in getattr(storage, "storages", (storage,)):
        for chunk in getattr(part, "chunks", ()):
            check_expansion(chunk.uncompressed_size, chunk.compressed_size, f"a chunk of {path}")
    return reader

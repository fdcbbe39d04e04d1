"""ROS 1 bags, see bag.py."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from evflow.files import compressed
from evflow.files.bounded import BoundedPath
from evflow.files.limits import RATIO
from evflow.io.formats.ros.bag import Bag, read_bag, triggers_of
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "rosbag"
EXTENSIONS: tuple[str, ...] = (".bag",)

CHUNK = 1 << 26  # bytes that a chunk may have; rosbag's own have 768 kB


def sniff(path: Path, head: bytes) -> bool:
    return head.startswith(b"#ROSBAG V")


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV010 (no `rosbags`) and what `read_bag` raises."""
    with _bag(path) as bag:
        return read_bag(bag, hints)


def triggers(path: Path, topic: str | None) -> np.ndarray:
    """Times (N,) int64 us of external signals beside the events of a topic; raises as `read`."""
    with _bag(path) as bag:
        return triggers_of(bag, topic)


def _bag(path: Path) -> Bag:
    return Bag(path, _open, aligned=False, mend="run `rosbag reindex` on it")


def _open(path: Path) -> Any:
    from rosbags.rosbag1 import Reader

    reader = Reader(BoundedPath(path))
    reader.open()
    for place, chunk in reader.chunks.items():  # bounds the expansion of every chunk
        reader.chunks[place] = chunk._replace(decompressor=_bounded(chunk.decompressor))
    return reader


def _bounded(unpack: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """The same function for chunks that expand within `limits`; ValueError for others."""
    from lz4.frame import decompress

    kinds: dict[Any, str] = {bz2.decompress: "bz2", decompress: "lz4"}
    if unpack not in kinds:  # not compressed
        return unpack
    return lambda data: compressed.unpack(data, kinds[unpack], CHUNK + RATIO * len(data))

"""The safetensors format, read without trusting it: u64 header size, the header, float32 data.

Whatever the header claims is compared with the file before an array is made; the digest covers
names, shapes and numbers, so that any changed byte is noticed.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.json_text import parse_json

MOST_HEADER = 1 << 24  # bytes; ours have 25,000
MOST_SIDE = 1 << 31  # of an empty array, whose other sides are otherwise unbounded
DEEPEST = 16  # names within names
CARD = "__metadata__"
Arrays = dict[str, np.ndarray]


def read_header(data: bytes) -> tuple[dict[str, Any], int]:
    """The header, and the offset of the data; ValueError if it is damaged."""
    size = int.from_bytes(data[:8], "little")
    if len(data) < 8 or size > min(len(data) - 8, MOST_HEADER):
        raise ValueError(f"its header claims {size:,} of {len(data):,} bytes")
    header = parse_json(data[8 : 8 + size], object_pairs_hook=_once)
    if not isinstance(header, dict):
        raise ValueError("its header is not an object")
    return header, 8 + size


def parse(data: bytes) -> Arrays:
    """The arrays by name, as views of `data`. Raises ValueError (damaged), and EV018 if they are
    not float32, or nest badly."""
    header, start = read_header(data)
    header.pop(CARD, None)
    spans, arrays = [], Arrays()
    for name, entry in header.items():
        if not isinstance(entry, dict):
            raise ValueError(f"{name[:80]!r} is not an array")
        shape, (begin, end) = _shape(entry.get("shape")), _span(entry.get("data_offsets"))
        _check_kind(name, entry.get("dtype"))
        if end - begin != 4 * math.prod(shape) or end > len(data) - start:
            raise ValueError(f"{name[:80]!r} of shape {shape} claims bytes {begin:,} to {end:,} of "
                             f"{len(data) - start:,}")
        spans.append((begin, end))
        arrays[name] = np.frombuffer(data, "<f4", (end - begin) // 4, start + begin).reshape(shape)
    _check_names(arrays)
    ends = [(0, 0), *sorted(spans), (len(data) - start,) * 2]
    if any(before[1] != after[0] for before, after in itertools.pairwise(ends)):
        raise ValueError("its arrays overlap, or leave bytes between them")
    return arrays


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of names, shapes and float32 numbers."""
    whole = hashlib.sha256()
    for name in sorted(arrays):
        whole.update(f"{name}\0{list(arrays[name].shape)}\n".encode())
        whole.update(np.ascontiguousarray(arrays[name], "<f4").data)
    return whole.hexdigest()


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("its header has a name twice")
    return found


def _shape(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or len(value) > 32 or not all(
            type(n) is int and 0 <= n <= MOST_SIDE for n in value):
        raise ValueError(f"a shape is {str(value)[:80]}")
    return tuple(value)


def _span(value: Any) -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2 or not all(type(n) is int for n in value) or (
            not 0 <= value[0] <= value[1]):
        raise ValueError(f"an offset is {str(value)[:80]}")
    return value[0], value[1]


def _check_kind(name: str, kind: Any) -> None:
    if kind != "F32":
        raise EvflowDataError("EV018", f"{name[:80]} is of {str(kind)[:20]}.",
                              "Expected float32 arrays, as save_weights writes them.")


def _check_names(arrays: Arrays) -> None:
    """Raise EV018 unless each name is a path of parts, and none is also a group of others."""
    groups = {str(parent) for name in arrays for parent in PurePosixPath(name).parents}
    for name in arrays:
        parts = name.split("/")
        if not all(parts) or len(parts) > DEEPEST:
            raise EvflowDataError("EV018", f"an array is called {name[:80]!r}.",
                                  "Expected names such as default/encoder/bias.")
        if str(PurePosixPath(name)) in groups:
            raise EvflowDataError("EV018", f"{name[:80]} is an array and also a group of others.",
                                  "Expected names such as default/encoder/bias.")

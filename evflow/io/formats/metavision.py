"""HDF5 of Prophesee's Metavision (docs.prophesee.ai, HDF5 event files): /CD/events, a compound of
x, y, p and t in us, with or without ECF compression. The size comes from the attribute `geometry`
or the sensor's name. Triggers (/EXT_TRIGGER) are not read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode import arrays, columns, ecf, prophesee, tables
from evflow.io.decode.hdf5 import filters_of
from evflow.io.decode.stream import Chunk, Damage, collect
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "metavision"
EXTENSIONS: tuple[str, ...] = (".hdf5", ".h5")

EVENTS = "CD/events"
TOLD = ("format", "geometry", "sensor_name", "plugin_name", "generation", "sensor_generation")


def sniff(path: Path, head: bytes) -> bool:
    return tables.holds(head, path, lambda f: EVENTS in f)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (other fields), EV009 (damaged), EV010 (h5py or a filter) and what
    `stream.collect` raises."""
    with tables.opened(path) as f:
        fields = {key: value for key in TOLD
                  if (value := columns.text(f.attrs.get(key))) is not None}
        size, notes = prophesee.Header(fields, 0).size()
        data = tables.dataset(path, f, EVENTS, (None,), ecf.FILTER)
        table = arrays.structured(EVENTS, data)
        if table is None:
            raise EvflowDataError(
                "EV008", f"{path}: {EVENTS} has the fields {data.dtype.names}.",
                "Expected x, y, p and t. Convert it with Metavision: metavision_file_to_dat or "
                "metavision_file_to_csv.", where=path)
        packed = filters_of(data) == [ecf.FILTER]
        chunks = _unpacked(data, path) if packed else tables.blocks(
            table.n, table.rows, table.stored)
        return collect(path, chunks, hints, size, lambda: notes)


def _unpacked(data: Any, path: Path) -> Iterator[Chunk]:
    """The events in blocks; Damage at the first event of a damaged block."""
    rows, total = data.chunks[0], len(data)
    for first in range(0, total, rows):
        try:
            found = _block(data, first, os.path.getsize(path))
        except ValueError as e:
            raise Damage(first, f"its block is damaged ({e})", "event") from e
        count = min(rows, total - first)
        if len(found.t) < count:
            raise Damage(first, f"its block holds {len(found.t):,} events of {count:,}", "event")
        x, y, t, p = (column[:count] for column in found)
        yield Chunk(x, y, t, p, lambda i, first=first: first + i, "event")  # type: ignore[misc]


def _block(data: Any, first: int, most: int) -> ecf.Block:
    info = data.id.get_chunk_info_by_coord((first,))
    if info.byte_offset is None or not 0 < info.size <= most:
        raise ValueError("it is not in the file")
    mask, packed = data.id.read_direct_chunk((first,))
    if mask == 0:
        return ecf.decode(packed)
    plain = np.frombuffer(packed, data.dtype, len(packed) // data.dtype.itemsize)
    return ecf.Block(plain["x"], plain["y"], plain["t"], plain["p"])

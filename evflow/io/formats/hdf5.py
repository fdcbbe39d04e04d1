"""HDF5 of any layout that names its columns, or holds N x 4 numbers: M3ED (prophesee/left/{x, y, t,
p}, calib/resolution), e2calib and other flat files, compound data sets. See `hdf5_search`.

Times are us if they are integers and seconds if they have fractions, unless a name or an attribute
gives the unit; a t_offset is added. Images beside the events are its frames if their times can be
found by name.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from evflow.errors import EvflowDataError
from evflow.io.decode import hdf5_search, tables
from evflow.io.hints import Hints
from evflow.types import Recording

NAME = "hdf5"
EXTENSIONS: tuple[str, ...] = (".h5", ".hdf5")


def sniff(path: Path, head: bytes) -> bool:
    """True for any HDF5: `read` lists what it holds if no format claims it."""
    return tables.holds(head, path, lambda f: True)


def read(path: Path, hints: Hints) -> Recording:
    """Raises EV008 (nothing that could be events), EV009, EV010 (h5py or a filter) and what
    `stream.gather` raises."""
    with tables.opened(path) as f:
        found = hdf5_search.tables_of(path, f)
        if not found:
            raise EvflowDataError(
                "EV008", f"{path} is HDF5 in an unknown layout. It holds "
                f"{hdf5_search.listing(f)}.",
                hdf5_search.as_stack(f) or
                "Name the events x, y, t, p in one group, in Python: with h5py.File(path, 'a') as "
                "f: f['events/x'] = f['its/name'], and so for y, t (us) and p. No data is copied.",
                where=path)
        name, notes = hints.camera([table.name for _, table in found])
        group, table = next(pair for pair in found if pair[1].name == name)
        size = hdf5_search.declared_size(f, group)
        unit = table.unit if hints.time_unit == "auto" else hints.time_unit
        offset = hdf5_search.declared_offset(
            dataclasses.replace(hints, time_unit=unit), group, *hdf5_search.around(f, group))
        gathered = table.gather(path, hints, size, offset)
        return hdf5_search.images_beside(path, f, gathered, hints, name, notes)

"""HDF5 restricted to a single file. Links, virtual data sets and external storage lead to other
files: a missing one reads as zeros, a pipe never ends, and the file itself crashes the process.

`File` is h5py's, but every part of a path is checked before HDF5 follows it, and so is the heap
with variable-length text before HDF5 walks it (`hdf5_heaps`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from evflow.errors import EvflowDataError
from evflow.io.decode.hdf5_heaps import Heaps

MOST_LINKS = 16  # soft links followed for one name, including nested ones, as in HDF5
FIX = ("Only data in the file itself are read. Copy them in: with h5py, values = f[name][:]; "
       "del f[name]; f[name] = values.")


class _Contained(h5py.Group):  # type: ignore[misc]
    """A group whose members lie in its own file; EV009 when a member does not, KeyError if there is
    none, ValueError if a link leads nowhere or to damaged data."""

    def __getitem__(self, name: Any) -> Any:
        found = _opened(self.id, self._e(name))
        if isinstance(found, h5py.h5g.GroupID):
            return Group(found)
        if isinstance(found, h5py.h5d.DatasetID):
            return Dataset(found, readonly=True)
        return h5py.Datatype(found)

    def __contains__(self, name: Any) -> bool:
        try:
            _opened(self.id, self._e(name))
        except KeyError:
            return False
        return True

    def get(self, name: Any, default: Any = None) -> Any:  # type: ignore[override, unused-ignore]
        try:
            return self[name]
        except KeyError:
            return default

    @property
    def attrs(self) -> Attributes:
        return Attributes(self)


class Group(_Contained):
    """A group of a `File`."""


class Dataset(h5py.Dataset):  # type: ignore[misc]
    """A data set of a `File`; ValueError on reading values that lie in its heap, as variable-length
    ones do, which no format has."""

    def __getitem__(self, args: Any, new_dtype: Any = None) -> Any:
        if self.dtype.hasobject:
            raise ValueError(f"{self.name} has values of variable length, or references")
        return super().__getitem__(args, new_dtype)

    @property
    def attrs(self) -> Attributes:
        return Attributes(self)


class Attributes(h5py.AttributeManager):  # type: ignore[misc]
    """The attributes of a group or data set; ValueError if one lies in a heap in which HDF5 would
    loop forever."""

    def __getitem__(self, name: Any) -> Any:
        kind = h5py.h5a.open(self._id, self._e(name)).get_type()
        plain = isinstance(kind, (h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID)) or (
            isinstance(kind, h5py.h5t.TypeStringID) and not kind.is_variable_str())
        return super().__getitem__(name) if plain else _of_heap(self._id, name)


class File(_Contained, h5py.File):  # type: ignore[misc]
    """A file, open for reading."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r")


def _of_heap(at: Any, name: Any) -> Any:
    """An attribute of the object `at`, read with every heap checked; ValueError."""
    whole = h5py.h5i.get_file_id(at)
    if whole.get_create_plist().get_sizes()[1] != 8:
        raise ValueError(f"attribute {name} has lengths of other than 8 bytes")
    with Heaps(Path(os.fsdecode(h5py.h5f.get_name(whole)))) as file, h5py.File(file, "r") as again:
        found = _opened(again.id, h5py.h5i.get_name(at))
        kind = h5py.Dataset if isinstance(found, h5py.h5d.DatasetID) else h5py.Group
        return h5py.AttributeManager(kind(found))[name]


def _opened(at: Any, path: bytes, links: Iterator[int] | None = None) -> Any:
    """The object at a path relative to the group `at`. links: how many may still be followed."""
    links = iter(range(MOST_LINKS)) if links is None else links
    if path.startswith(b"/"):
        at = h5py.h5o.open(at, b"/")
    for part in path.split(b"/"):
        if part in (b"", b"."):
            continue
        if not isinstance(at, h5py.h5g.GroupID) or not at.links.exists(part):
            raise KeyError(f"{part.decode(errors='replace')} is not there")
        kind = at.links.get_info(part).type
        if kind == h5py.h5l.TYPE_SOFT:
            at = _followed(at, part, links)
        elif kind == h5py.h5l.TYPE_HARD:
            at = _linked(at, part)
            _check_own(at)
        else:
            raise _elsewhere(at, part, "is a link to another file")
    return at


def _linked(at: Any, part: bytes) -> Any:
    """The member `part` of the group `at`; ValueError if it cannot be opened, for which h5py raises
    the same KeyError as for a missing one."""
    try:
        return h5py.h5o.open(at, part)
    except KeyError as e:
        raise ValueError(f"{part.decode(errors='replace')} cannot be opened ({e})") from e


def _followed(at: Any, part: bytes, links: Iterator[int]) -> Any:
    """The target of the soft link `part`; ValueError if it leads nowhere: for an optional member
    that would otherwise be a silent loss."""
    try:
        if next(links, None) is not None:
            return _opened(at, at.links.get_val(part), links)
    except KeyError:
        pass
    raise ValueError(f"{part.decode(errors='replace')} is a link that leads nowhere")


def _check_own(found: Any) -> None:
    """Raise EV009 if the values of a data set are stored in other files."""
    if isinstance(found, h5py.h5d.DatasetID):
        made = found.get_create_plist()  # asking for its shape could open them
        if made.get_external_count():
            raise _elsewhere(found, b"", f"lies in another file, {made.get_external(0)[0]!r}")
        if made.get_layout() == h5py.h5d.VIRTUAL:
            raise _elsewhere(found, b"", "is a virtual data set made of other files")


def _elsewhere(at: Any, part: bytes, why: str) -> EvflowDataError:
    group = (h5py.h5i.get_name(at) or b"").rstrip(b"/")
    name = b"/".join((group, part)) if part else group
    return EvflowDataError("EV009", f"{name.decode(errors='replace')} {why}.", FIX)

"""HDF5 read as far as one file goes. Links, virtual data sets and external storage lead into other
files: a missing one reads as zeros, a pipe has no end, and the file itself ends the process.

`File` is h5py's, but every part of a path is looked at before HDF5 follows it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py

from evflow.errors import EvflowDataError

MOST_LINKS = 16  # soft links followed in one path, as HDF5 itself does
FIX = ("Only what is in the file itself is read. Copy it in: with h5py, values = f[name][:]; "
       "del f[name]; f[name] = values.")


class _Contained(h5py.Group):  # type: ignore[misc]
    """A group whose members, and theirs, lie in its own file; EV009 where one is asked for that
    does not, KeyError where there is none, ValueError where a link leads nowhere, or to what is
    damaged."""

    def __getitem__(self, name: Any) -> Any:
        found = _opened(self.id, self._e(name))
        if isinstance(found, h5py.h5g.GroupID):
            return Group(found)
        if isinstance(found, h5py.h5d.DatasetID):
            return h5py.Dataset(found, readonly=True)
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


class Group(_Contained):
    """A group of a `File`."""


class File(_Contained, h5py.File):  # type: ignore[misc]
    """A file, open for reading."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r")


def _opened(at: Any, path: bytes, links: int = MOST_LINKS) -> Any:
    """The object at a path from the group `at` on."""
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
    """The object that the group `at` holds as `part`; ValueError where it cannot be opened, which
    h5py tells by the same KeyError as that it is not there."""
    try:
        return h5py.h5o.open(at, part)
    except KeyError as e:
        raise ValueError(f"{part.decode(errors='replace')} cannot be opened ({e})") from e


def _followed(at: Any, part: bytes, links: int) -> Any:
    """What the soft link `part` stands for; ValueError where it leads nowhere, which is damage: a
    part that may be absent would be one that was lost unseen."""
    try:
        if links:
            return _opened(at, at.links.get_val(part), links - 1)
    except KeyError:
        pass
    raise ValueError(f"{part.decode(errors='replace')} is a link that leads nowhere")


def _check_own(found: Any) -> None:
    """EV009 where the values of a data set are stored in other files."""
    if isinstance(found, h5py.h5d.DatasetID):
        made = found.get_create_plist()  # asking for its shape could open them
        if made.get_external_count():
            raise _elsewhere(found, b"", f"lies outside of it, in {made.get_external(0)[0]!r}")
        if made.get_layout() == h5py.h5d.VIRTUAL:
            raise _elsewhere(found, b"", "is a virtual data set, made of those of other files")


def _elsewhere(at: Any, part: bytes, why: str) -> EvflowDataError:
    group = (h5py.h5i.get_name(at) or b"").rstrip(b"/")
    name = b"/".join((group, part)) if part else group
    return EvflowDataError("EV009", f"{name.decode(errors='replace')} {why}.", FIX)

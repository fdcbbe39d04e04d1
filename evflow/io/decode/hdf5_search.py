"""Finds events, and the sensor's size beside them, in an HDF5 file of any layout.

Events are four data sets of equal length in one group, with names such as x y t p, xs ys ts ps or
x y timestamp polarity; a compound data set; or N x 4 numbers.
"""

from __future__ import annotations

import collections
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.decode import arrays, columns, tables
from evflow.io.decode.hdf5 import DAMAGE
from evflow.io.decode.images_beside import are_images, beside, channels_first, times_of
from evflow.io.decode.stream import Gathered
from evflow.io.decode.units import written_unit
from evflow.io.hints import Hints
from evflow.notes import Note
from evflow.types import Recording

MOST = 2000  # groups and data sets examined
SCALES_MS = {1e3: "s", 1.0: "ms", 1e-3: "us", 1e-6: "ns"}  # eventcv's attribute, in ms


def walk(f: Any) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Every group, outer ones first, and its data sets by name; what cannot be opened is
    skipped."""
    queue, seen = collections.deque([f]), 0
    while queue:
        group = queue.popleft()
        found: dict[str, Any] = {}
        for name in group:
            seen += 1
            if seen > MOST:
                return
            try:
                member = group[name]
            except (EvflowDataError, *DAMAGE):
                continue
            if hasattr(member, "keys"):
                queue.append(member)
            elif hasattr(member, "dtype") and getattr(member, "shape", None) is not None:
                found[name] = member
        yield group, found


def has_columns(f: Any) -> bool:
    """Whether any group names four columns."""
    return any(columns.by_name(found) for _, found in walk(f))


def tables_of(path: Path, f: Any) -> list[tuple[Any, arrays.Table]]:
    """(group, events) for everything that may be events: named columns before compounds before
    matrices, outer before inner groups, a left camera before others."""
    ranked: list[tuple[tuple[int, int, bool, str], Any, arrays.Table]] = []
    for group, found in walk(f):
        for kind, table in _in_group(path, f, group, found):
            name = table.name
            rank = (kind, name.count("/"), "left" not in name.lower(), name)
            ranked.append((rank, group, table))
    ranked.sort(key=lambda entry: entry[0])
    best = ranked[0][0][0] if ranked else 0
    return [(group, table) for rank, group, table in ranked if rank[0] == best]


def _in_group(
    path: Path, f: Any, group: Any, found: dict[str, Any]
) -> Iterator[tuple[int, arrays.Table]]:
    flat = [name for name, data in found.items()
            if (len(data.shape) == 1 or tables.line(data.shape)) and data.dtype.kind in "biuf"]
    if chosen := columns.by_name(flat):
        of = {c: found[name] for c, name in chosen.items()}
        if len({max(data.shape) for data in of.values()}) == 1:
            of = {c: tables.dataset(path, group, name, (None,)) for c, name in chosen.items()}
            yield 0, arrays.named(group.name, of, len(of["t"]), unit_of(
                f, chosen["t"], of["t"]))
    for name, data in found.items():
        if len(data.shape) == 1 and data.dtype.fields and (table := arrays.structured(
                data.name, tables.dataset(path, group, name, (None,)))):
            yield 1, table
        elif len(data.shape) == 2 and 4 in data.shape and (table := arrays.matrix(
                data.name, tables.dataset(path, group, name, (None, None)))):
            yield 2, table


def unit_of(f: Any, name: str, data: Any) -> str:
    """The unit of times from their attributes, else their name, else the file."""
    for key in ("unit", "units"):
        if isinstance(written := columns.text(data.attrs.get(key)), str) and written:
            return written_unit(f"[{written}]")
    unit = written_unit(name)
    return declared_unit(f) if unit == "auto" else unit


def declared_unit(f: Any) -> str:
    """The unit that the file states for all times; "auto" if it does not."""
    stated = np.asarray(f.attrs.get("timestamp_scale_ms", 0)).ravel()
    if len(stated) != 1 or stated.dtype.kind not in "iuf":
        return "auto"
    return next((unit for ms, unit in SCALES_MS.items() if abs(stated[0] / ms - 1) < 1e-6), "auto")


def declared_offset(hints: Hints, *places: Any) -> int:
    """What to add to all times, in us: the first t_offset among the data sets and attributes of
    these groups; 0 if there is none."""
    for place in places:
        stored = place["t_offset"] if "t_offset" in place else place.attrs.get("t_offset")
        if getattr(stored, "size", None) == 1:
            return hints.instant(stored[()] if hasattr(stored, "chunks") else stored, "us")
    return 0


def declared_size(f: Any, group: Any) -> Size | None:
    """(width, height) from attributes or data sets of the group, its `calib`, or the groups it lies
    in."""
    calib = group.get("calib")
    for place in [group, *([calib] if hasattr(calib, "keys") else []), *around(f, group)]:
        for get in (place.attrs.get, lambda name, at=place: _small(at, name)):
            if size := columns.stated_size(get):
                return size
    return None


def around(f: Any, group: Any) -> list[Any]:
    """The groups that a group lies in, the nearest first and the file last."""
    parts = group.name.strip("/").split("/")
    return [*(f["/".join(parts[:n])] for n in range(len(parts) - 1, 0, -1)), f]


def arrays_in(f: Any) -> dict[str, Any]:
    """All data sets by name, without the first slash."""
    return {data.name.strip("/"): data for _, members in walk(f) for data in members.values()}


def as_stack(f: Any) -> str:
    """How to save the images of a file without events as a stack of frames; "" if it holds none."""
    of = arrays_in(f)
    name = next((name for name, data in of.items() if are_images(data)), "")
    if not name:
        return ""
    times, pixels = times_of(name, of), f"f['{name}'][:]"
    if channels_first(of[name].shape):
        pixels = f"np.moveaxis({pixels}, 1, -1)"
    return (
        f"It holds images and no events. As frames (--frames, evflow simulate): np.savez('a.npz', "
        f"frames={pixels}" + (f", frame_times=f['{times}'][:])" if times else
                              ", frame_times=their times)") + " with f = h5py.File(path).")


def images_beside(
    path: Path, f: Any, found: Gathered, hints: Hints, events: str, notes: tuple[Note, ...] = ()
) -> Recording:
    """The recording of these events and of images anywhere in the file (`images_beside`)."""
    of = arrays_in(f)

    def checked(name: str) -> Any:
        return tables.dataset(path, f, name, (None,) * len(of[name].shape))

    return beside(path, of, lambda name: checked(name)[()], lambda name, part:
                  tables.stored_frames(checked(name), part), found, hints, events.strip("/"), notes)


def _small(group: Any, name: str) -> Any:
    """The value of a small data set, None if there is none."""
    if name not in group:
        return None
    data = group[name]
    few = getattr(data, "size", None) and data.size <= 4 and not data.chunks
    return data[()] if few and data.dtype.kind in "iuf" else None


def listing(f: Any) -> str:
    """The data sets of a file with their shapes, for messages."""
    found = [f"{data.name} {data.dtype if data.dtype.names is None else data.dtype.names} "
             f"{data.shape}" for _, members in walk(f) for data in members.values()]
    more = f" and {len(found) - 12:,} more" if len(found) > 12 else ""
    return (", ".join(found[:12]) or "no data set") + more

"""evflow's own .npz: t (int64 us), x, y, p, size = (width, height), and optionally frames,
frame_times, exposure_us and full_scale (white of uint16 and float32 frames). Other names of these
(`decode.columns`) and a single array of records or N x 4 numbers (`decode.arrays`) are read too.
Pickles are never loaded: members that are not needed may be Python objects, and a note names them.

Members are checked against the bytes that the archive really holds before memory is allocated, and
columns are decompressed in parallel, in blocks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from evflow.checks import COLUMNS, Size, check_columns, check_size
from evflow.errors import EvflowDataError
from evflow.files.archives import BLOCK, DAMAGE, Member, members
from evflow.files.arrays import GrowingArray
from evflow.files.atomic import aside
from evflow.files.moves import remove
from evflow.files.whole import need_members
from evflow.io.decode import arrays, columns, tables
from evflow.io.decode.images_beside import beside, stamps_of, times_of
from evflow.io.decode.stream import Gathered, gather
from evflow.io.decode.units import written_unit
from evflow.io.hints import Hints
from evflow.io.images.event_clock import beside_events
from evflow.io.images.exposures import KEY, exposed_note
from evflow.io.images.recorded import cut, in_order
from evflow.io.images.streams import ImageStream, choose, events_alone
from evflow.io.images.white import WHITE, stated_white
from evflow.io.writer import EventWriter
from evflow.notes import Note
from evflow.types import Events, Recording

NAME = "npz"
EXTENSIONS: tuple[str, ...] = (".npz",)


def sniff(path: Path, head: bytes) -> bool:
    if not head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except DAMAGE:
        return path.suffix.lower() in EXTENSIONS  # truncated: the extension decides


def read(path: Path, hints: Hints) -> Recording:
    """Events are read to the end even if stop_s comes before it, to verify their checksums.

    Raises EV002 (shapes), EV008 (a column is missing or pickled), EV009 (damaged), and what
    `stream.gather` and `Recording` raise.
    """
    with members(path, streamed=["frames.npy"]) as found:
        recording = _recording(path, found, hints)
        notes = [*recording.notes]
        if columns.LABEL in found:
            notes.append(columns.LABELS_UNREAD)
        if pickled := ", ".join(name for name, member in found.items() if member.pickled):
            notes.append(Note("events.unread", "Python objects were not read, as pickles are never "
                              f"loaded: {pickled}"))
        return dataclasses.replace(recording, notes=tuple(notes))


def _recording(path: Path, found: dict[str, Member], hints: Hints) -> Recording:
    plain = {name: member for name, member in found.items() if not member.pickled}
    chosen = columns.by_name(plain) or columns.by_name(found)
    for name in chosen.values():
        found[name].need_numbers()
    size = _size(path, plain) if hints.size is None else hints.size
    if chosen:
        events = _events(path, {c: found[name] for c, name in chosen.items()}, hints, size,
                         written_unit(chosen["t"]) if chosen["t"] != "t" else "us")
    else:
        events = _table(path, found).gather(path, hints, size)
    if _own_frames(found):
        return _with_frames(path, found, events, hints)
    images = plain.get("frames")
    if images and images.shape and not (hints.no_frames or times_of("frames", found)):
        with events_alone():
            raise EvflowDataError("EV008", f"{path} holds frames but no frame_times.",
                                  where=path)
    return beside(path, found, lambda name: found[name].whole(),
                  lambda name, part: found[name].spooled()[part], events, hints)


def _own_frames(found: dict[str, Member]) -> bool:
    """Whether frames and frame_times are as `NpzWriter` writes them."""
    return {"frames", "frame_times"} <= set(found) and len(found["frames"].shape) == 3 and (
        found["frames"].dtype in (np.uint8, np.uint16, np.float32)) and (
        len(found["frame_times"].shape) == 1)


def _size(path: Path, found: dict[str, Member]) -> Any:
    """Size of the sensor as stored: `size` is (width, height), even if that looks odd, or text
    such as 64x48. EV015 if it is something else."""
    for name in ("size", "wh"):
        if name in found:
            stored = found[name].whole().ravel()
            words = " ".join(map(str, stored.tolist()))
            sides = columns.written_size(f"size {words}") if stored.dtype.kind in "US" else (
                stored.tolist() if stored.dtype.kind in "iuf" else None)
            try:
                return check_size([int(v) if v == int(v) else v for v in sides or ()])
            except (EvflowDataError, ValueError, OverflowError):
                raise EvflowDataError(
                    "EV015", f"{name} in {path} holds {words[:60] or 'nothing'}.",
                    "It is (width, height) in pixels; where it is wrong, pass --size WxH.",
                    where=path) from None

    def small(name: str) -> Any:
        member = found.get(name)
        return None if member is None or math.prod(member.shape) > 4 else member.whole()

    size = columns.stated_size(small)
    if size and "frames" in found and found["frames"].shape[1:3] == size and "width" not in found:
        return size[::-1]  # the larger side was taken for the width, but frames are upright
    return size


def _table(path: Path, found: dict[str, Member]) -> arrays.Table:
    """The only array that may hold events; EV008 if there is none or several."""
    fit = []
    for name, member in found.items():
        many = len(member.shape) == 2 and 4 in member.shape and member.dtype.kind in "biuf"
        if many or (len(member.shape) == 1 and member.dtype.fields and not member.pickled):
            data = member.whole()
            table = arrays.matrix(name, data) if many else arrays.structured(name, data)
            fit += [table] if table else []
    if len(fit) == 1:
        return fit[0]
    if {"theta_on", "eta_on"} <= set(found):
        raise EvflowDataError(
            "EV008", f"{path} is a camera, not a recording.", "Use it in `evflow simulate VIDEO "
            "--camera` or `evflow export`, or compare two of them with `evflow compare`.",
            where=path)
    held = ", ".join(f"{name} {member.dtype} {member.shape}" for name, member in found.items())
    pickled = any(member.pickled for member in found.values())
    missing = [c for c in ("t", "x", "y", "p") if c not in map(columns.meaning, found)]
    raise EvflowDataError(
        "EV008", f"{path} holds {held[:400] or 'nothing'}, but not {missing}." if not fit else
        f"{path} holds several arrays that may be events: {', '.join(t.name for t in fit)}.",
        "Expected the keys t, x, y, p, size, and optionally frames, frame_times; or one array of "
        "events only." + (" Save objects as numbers: pickles are never loaded." if pickled else ""),
        where=path)


def _with_frames(
    path: Path, found: dict[str, Member], gathered: Gathered, hints: Hints
) -> Recording:
    events, span, notes = gathered
    shape = found["frames"].shape
    size = (shape[2], shape[1]) if len(shape) == 3 else None
    chosen = choose((ImageStream("frames", size),), hints, events.size)
    notes = (*notes, *chosen.notes)
    if chosen.stream is None:
        return Recording.of_events(events, notes)
    with events_alone():
        stamps = stamps_of(
            "frames", "frame_times", found, lambda name: found[name].whole(), path)
        times, more, exposure_us, _ = beside_events(stamps, path, "us", hints, events).believed()
        frames = found["frames"].spooled()
        order, late = in_order(times, hints)
        if order is not None and len(frames) == len(times):
            frames, times = frames[order], times[order]
        said = (exposed_note(exposure_us),) if exposure_us else ()
        notes = (*notes, *more, *late, *said)
        return cut(Recording(events, frames, times, notes, exposure_us, _white(found)), span)


def _white(found: dict[str, Member]) -> int:
    """The DN of white of uint16 or float32 frames that the file states, 0 if it does not."""
    member, deep = found.get(WHITE), found["frames"].dtype in (np.uint16, np.float32)
    return stated_white(member.whole()) if member and deep and member.shape in ((), (1,)) and (
        member.dtype.kind in "iu") else 0


def _events(
    path: Path, found: dict[str, Member], hints: Hints, size: Size | None, unit: str
) -> Gathered:
    """`gather` on the columns; damage is reported before errors in their values."""
    members = [found[name] for name in COLUMNS]
    lines = [(max(m.shape),) if tables.line(m.shape) else m.shape for m in members]
    check_columns(*(np.broadcast_to(np.int8(0), shape) for shape in lines))

    def rows(part: slice) -> Any:
        return tuple(member.take(part.stop - part.start) for member in members)

    chunks, native = tables.blocks(lines[0][0], rows), "us"
    try:
        if unit != "us":
            chunks, native = arrays.in_unit(path, chunks, unit, hints)
        gathered = gather(path, chunks, hints, None if size is None else hints.sensor(size), native)
    except EvflowDataError:
        _finish(members)
        raise
    _finish(members)
    return gathered


def _finish(members: list[Member]) -> None:
    for member in members:
        member.finish()


class NpzWriter(EventWriter):
    """Columns grow as .npy files in a temporary folder beside the output; at the end they are
    compressed one by one, and no whole array is ever in memory."""

    NAME = NAME
    LABELS = True

    def _open(self, temporary: Path, stack: contextlib.ExitStack) -> None:
        self._archive = stack.enter_context(zipfile.ZipFile(
            temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1))
        self._folder = aside(self.path, "part")
        stack.callback(remove, self._folder)
        self._folder.mkdir()
        self._sizes: dict[str, int | None] = {"size.npy": None}
        kinds = {"t": "i8", "x": "u2", "y": "u2", "p": "?"}
        self._columns = {name: self._column(name, kind, stack) for name, kind in kinds.items()}

    def _column(
        self, name: str, dtype: Any, stack: contextlib.ExitStack, item: tuple[int, ...] = ()
    ) -> GrowingArray:
        return stack.enter_context(GrowingArray(self._folder / f"{name}.npy", dtype, item))

    def _write(self, events: Events) -> None:
        for name in ("t", "x", "y", "p"):
            self._columns[name].append(getattr(events, name))

    def _write_frames(self, frames: np.ndarray, times: np.ndarray) -> None:
        if "frames" not in self._columns:
            for name, dtype, item in (("frames", frames.dtype, frames.shape[1:]),
                                      ("frame_times", "i8", ())):
                self._columns[name] = self._column(name, dtype, self._stack, item)
        self._columns["frames"].append(frames)
        self._columns["frame_times"].append(times)

    def _write_labels(self, noise: np.ndarray) -> None:
        if columns.LABEL not in self._columns:
            self._columns[columns.LABEL] = self._column(columns.LABEL, "?", self._stack)
        self._columns[columns.LABEL].append(noise)

    def _finish(self) -> None:
        for name, column in self._columns.items():
            column.close()
            self._sizes[f"{name}.npy"] = (self._folder / f"{name}.npy").stat().st_size
            # not archive.write, which stores when the column was written
            with open(self._folder / f"{name}.npy", "rb") as f, self._archive.open(
                    f"{name}.npy", "w", force_zip64=True) as member:
                shutil.copyfileobj(f, member, BLOCK)
        with self._archive.open("size.npy", "w") as f:
            np.lib.format.write_array(f, np.array(self.size, np.int32))
        stated = {KEY: self.exposure_us, WHITE: self.white} if "frames" in self._columns else {}
        for name, number in stated.items():
            if number:
                self._sizes[f"{name}.npy"] = None
                with self._archive.open(f"{name}.npy", "w") as f:
                    np.lib.format.write_array(f, np.array(number, np.int64))

    def _verify(self, temporary: Path) -> None:
        need_members(temporary, self._sizes)

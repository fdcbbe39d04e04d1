"""Files of frame times: one time per line, alone, before or after the frame's name.

Supported layouts: bare times (vid2e, DSEC), `time name` (IJRR, TUM), `name time` (DVS-Voltmeter),
`index time`, begin and end of the exposure (DSEC), or any number of columns of which a header names
one as the time, and perhaps one as the exposure; separated by blanks, tabs, commas or semicolons;
and arrays in .npy or .npz. Lines that begin with # are comments. A unit written in a comment or
header is used ("[ns]", "timestamp_us"); otherwise the only unit that makes the numbers a plausible
video, with a note.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from evflow.checks import check_times
from evflow.errors import EvflowDataError, naming
from evflow.files.archives import load_npz, npy_header
from evflow.files.arrays import mapped
from evflow.files.limits import read_whole
from evflow.io.decode.columns import meaning
from evflow.io.decode.text import is_float
from evflow.io.decode.units import (
    UNITS_US,
    usual_step,
    video_unit,
    written_unit,
)
from evflow.io.hints import Hints
from evflow.io.images.exposures import (
    Stamps,
    believed,
    beside_times,
    ends_of,
    mid_exposure,
    middle,
    stated,
)
from evflow.io.images.frames import existing
from evflow.notes import Note

MAX_BYTES = 1 << 28  # 256 MiB of text: some ten million frames
TELL = "pass --timestamps-unit with --frames (simulate: --time-unit)"

Notes = tuple[Note, ...]


class FrameTimes(NamedTuple):
    """us: (T,) int64; notes: what was assumed; exposure_us: 0 if it is unknown; names: (T,) of the
    frames, or none."""

    us: np.ndarray
    notes: Notes
    exposure_us: int = 0
    names: tuple[str, ...] = ()

    def believed(self) -> FrameTimes:
        """The same without an exposure that is longer than the interval between frames, but a note
        on it."""
        exposure_us, notes = believed(self.exposure_us, self.us)
        return self._replace(exposure_us=exposure_us, notes=(*self.notes, *notes))


def read_times(path: Path, unit: str = "auto", names: Collection[str] = ()) -> FrameTimes:
    """Frame times of a file, with the frames' names and exposure if it has them.

    names: of the images at hand, to distinguish a column of names from one of times.
    Raises EV008 (columns of unclear meaning), EV009 (damaged), EV001 (none), EV003 (unclear unit),
    EV004 (not increasing), EV007 (NaN), EV016 (not found).
    """
    if (suffix := existing(path).suffix) in (".npy", ".npz"):
        stamps = _stored(path) if suffix == ".npy" else _archived(path)
        return to_us(stamps, path, unit).believed()
    rows, header, written = _rows(path)
    named = [i for i, field in enumerate(header) if meaning(field) == "t"]
    if len(header) == len(rows[0] if rows else ()) and len(named) == 1:
        stamps, written = _named(path, rows, header, named[0])
        labels = _labels(rows, names)
    else:
        stamps, labels = _columns(path, rows, names)
    found = to_us(stamps, path, unit if unit != "auto" else written)
    return found._replace(names=tuple(labels)).believed()


def _named(
    path: Path, rows: list[list[str]], header: list[str], time: int
) -> tuple[Stamps, str]:
    """The stamps of columns that a header names, `time` the one of the times, and their unit."""
    def column(name: str) -> np.ndarray:
        place = header.index(name)
        return _numbers(path, [row for row in rows if is_float(row[place])], place)

    times = _numbers(path, rows, time)
    pair = beside_times(header[time], times, header, column)
    units = map(written_unit, (*(ends_of(header) if pair else ()), header[time]))
    return (pair or Stamps(times))._replace(stated_us=stated(header, column)), next(
        (unit for unit in units if unit != "auto"), "auto")


def _stored(path: Path) -> Stamps:
    """The stamps of an .npy of times (T,), or of begin and end of the exposures (T, 2)."""
    try:
        with open(path, "rb") as f:
            pairs = npy_header(f)[0][1:] == (2,)
    except (OSError, EOFError, ValueError):  # `mapped` explains
        pairs = False
    return mid_exposure(np.array(mapped(path, (None, 2) if pairs else (None,))), path)


def _archived(path: Path) -> Stamps:
    """The stamps of an .npz: its only array, or the one that is named a time, or begin and end of
    the exposures."""
    held = load_npz(path)
    arrays = {name: array for name, array in held.items() if array.ndim}
    for named in (arrays, [name for name in arrays if meaning(name) == "t"]):
        if len(named) == 1:
            times = arrays[clock := next(iter(named))]
            pair = beside_times(clock, times, arrays, arrays.__getitem__)
            return (pair or mid_exposure(times, path))._replace(
                stated_us=stated(held, held.__getitem__))
    ends = [arrays[name] for name in ends_of(arrays)]
    if ends and ends[0].shape == ends[1].shape == (len(ends[0]),):
        return mid_exposure(np.stack(ends, 1), path)
    raise EvflowDataError(
        "EV008", f"{path} holds {', '.join(arrays) or 'no array'}; which are the frames' times?",
        "Call that array t, or save it alone (.npy).", where=path)


def to_us(stamps: Stamps, where: object, unit: str = "auto") -> FrameTimes:
    """Strictly increasing times in us, and a note if the unit was inferred.

    Raises EV001, EV002, EV003, EV004, EV007.
    """
    times = stamps.times
    if times.ndim != 1 or times.dtype.kind not in "iuf":
        raise EvflowDataError(
            "EV002", f"{where} holds times of shape {times.shape} and dtype {times.dtype}.",
            "Expected one number per frame.", where=where)
    if len(times) == 0:
        raise EvflowDataError("EV001", f"{where} holds no frame time.", where=where)
    if not np.isfinite(times).all():
        raise EvflowDataError(
            "EV007", f"{where} holds {(~np.isfinite(times)).sum():,} times that are not finite.",
            where=where)
    back = np.flatnonzero(times[1:] <= times[:-1])
    if len(back):
        at = int(back[0]) + 1
        raise EvflowDataError(
            "EV004", f"{where}: time {at:,} is {times[at]}, the one before {times[at - 1]} "
            f"({len(back):,} in all).", "Frame times must increase: lines out of order, or "
                                        "repeated?",
            where=where)
    notes: Notes = ()
    if unit == "auto":
        unit, notes = _video_unit(times, where)
    elif (likely := video_unit(times)[0]) and unit not in video_unit(times)[1]:
        notes = (Note("frames.unit", f"times of {where}, read in {unit}, are "
                      f"{1e-6 * UNITS_US[unit] * usual_step(times):.3g} s apart; in {likely} they "
                      "would be those of a video."),)
    us = Hints(time_unit=unit).microseconds(times, unit)
    with naming(where):
        us = check_times(us, f"times read in {unit}", strict=True)
    return FrameTimes(us, (*stamps.notes, *notes), stamps.exposure_us(unit))


def _video_unit(times: np.ndarray, where: object) -> tuple[str, Notes]:
    """The unit in which the times are those of a video, with a note; EV003 if unclear."""
    unit, rates = video_unit(times)
    if unit is not None:
        rate = f"{rates[unit]:.4g} frames/s"
        return unit, (Note("frames.unit", f"times of {where} were read in {unit} ({rate}); if that "
                           f"is wrong, {TELL}."),)
    would = ", ".join(f"{rate:.4g} frames/s in {u}" for u, rate in rates.items())
    what = (f"steps of {usual_step(times):g} (from {times[0]}) have" if len(times) > 1 else
            f"a single time ({times[0]}) has")
    raise EvflowDataError(
        "EV003", f"{where}: {what} no clear unit" + (f": {would}." if would else "."),
        f"Is it {', '.join(UNITS_US)}? {TELL.capitalize()}.", where=where)


def _rows(path: Path) -> tuple[list[list[str]], list[str], str]:
    """The fields of every line with data, equally many; those of the last line before them; and the
    written unit, or "auto"."""
    try:
        text = read_whole(path, MAX_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        raise EvflowDataError("EV009", f"{path} cannot be read as text ({e}).", where=path) from e
    if "\0" in text:
        raise EvflowDataError("EV009", f"{path} is not a text file of times.", where=path)
    rows: list[list[str]] = []
    words, header = "", [""]
    for number, line in enumerate(text.splitlines(), 1):
        content, _, comment = line.partition("#")
        fields = _fields(content)
        if not fields or (not rows and not any(map(is_float, fields))):
            header_text = comment if not fields else content  # a comment or the header
            words, header = f"{words} {header_text}", header if rows else _fields(header_text)
            continue
        if rows and len(fields) != len(rows[0]):
            raise EvflowDataError(
                "EV009", f"{path}, line {number:,} is {line[:60]!r}; lines before it have "
                f"{len(rows[0])} columns.", "Truncated or damaged? Copy it again.", where=path)
        rows.append(fields)
    return rows, header, written_unit(words)


def _fields(line: str) -> list[str]:
    return [field for field in re.split(r"[\s,;]+", line) if field]


def _labels(rows: list[list[str]], names: Collection[str]) -> list[str]:
    """The names of images in the only column that holds them; none if there is no such column."""
    known = _known(names)
    found = [column for column in zip(*rows, strict=True) if all(_tail(f) in known for f in column)]
    return [known[_tail(field)] for field in found[0]] if len(found) == 1 else []


def _known(names: Collection[str]) -> dict[str, str]:
    """The names, by themselves and by their stems."""
    return {key: name for name in names for key in (PurePosixPath(name).stem, name)}


def _tail(field: str) -> str:
    return PurePosixPath(field.replace("\\", "/")).name


def _columns(
    path: Path, rows: list[list[str]], names: Collection[str]
) -> tuple[Stamps, list[str]]:
    """The column of times, or those of begin and end, and that of the names, if any."""
    columns = list(zip(*rows, strict=True))
    if len(columns) <= 1:
        return Stamps(_numbers(path, rows, 0)), []
    known = _known(names)
    label = [all(_tail(f) in known for f in column) for column in columns]
    if sum(label) != 1:  # not the images at hand: names are non-numbers, or count up
        label = [not all(map(is_float, column)) or _counts(column) for column in columns]
    clock = [i for i, named in enumerate(label) if not named]
    stamps = (Stamps(_numbers(path, rows, clock[0])) if len(clock) == 1 else
              middle(*(_numbers(path, rows, column) for column in clock)) if len(clock) == 2
              else None)
    if stamps is None or sum(label) > 1:
        raise EvflowDataError(
            "EV008", f"{path} has lines like {' '.join(rows[0])[:60]!r}; which column is the time?",
            "Keep one time per line, `time name`, or begin and end of the exposure.", where=path)
    named = columns[label.index(True)] if any(label) else ()
    if all(map(str.isdecimal, named)) and not set(named) <= set(known):
        return stamps, []
    return stamps, [known.get(_tail(f), _tail(f)) for f in named]


def _numbers(path: Path, rows: list[list[str]], column: int) -> np.ndarray:
    """A column as int64 if all are integers (exact, also for ns since 1970), else float64."""
    fields = [row[column] for row in rows]
    for number, field in enumerate(fields):
        if not is_float(field):
            raise EvflowDataError(
                "EV009", f"{path}: {field[:40]!r} at time {number:,} is not a number.",
                "Truncated or damaged? Copy it again.", where=path)
    try:
        return np.array([int(f) for f in fields], np.int64)
    except (ValueError, OverflowError):
        return np.array([float(f) for f in fields])


def _counts(column: tuple[str, ...]) -> bool:
    """Integers that count up by one: an index, not times (from 2 lines on)."""
    if len(column) < 2 or not all(f.isdecimal() and len(f) < 19 for f in column):
        return False
    return bool((np.diff(np.array([int(f) for f in column])) == 1).all())

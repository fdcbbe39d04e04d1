"""The text folder of the IJRR 2017 / ECD event-camera data sets, or a zip of it.

events.txt has a line `t[s] x y p` per event; images.txt, where there is one, a line `t[s] path`
per image. Times become int64 us by round(t * 1e6). An image's time is used as it stands: the
data set does not say where in the exposure it lies. calib.txt, imu.txt and poses are not read.
"""

from __future__ import annotations

import io
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from evflow.checks import check_times
from evflow.errors import EvflowDataError
from evflow.io.frames import stack_frames
from evflow.io.hints import Hints
from evflow.io.images import decode
from evflow.types import Events, Recording

NAME = "ijrr"
EXTENSIONS: tuple[str, ...] = (".zip", ".txt", "")

EVENTS, IMAGES = "events.txt", "images.txt"
BLOCK = 1 << 22  # bytes of text parsed at a time, 150,000 lines
MAX_LINE = 1000  # a longer one is not text

Root = Path | zipfile.Path


def sniff(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / EVENTS).is_file()
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        try:
            with zipfile.ZipFile(path) as archive:
                return any(_is_events(name) for name in archive.namelist())
        except (zipfile.BadZipFile, OSError, ValueError):
            return path.suffix.lower() == ".zip"  # cut off: the extension decides
    lines = [line for line in head.split(b"\n") if line and not line.startswith(b"#")]
    return bool(lines) and re.fullmatch(
        rb"\d+\.\d+ \d+ \d+ -?[01]\r?", lines[0]) is not None


def read(path: Path, hints: Hints) -> Recording:
    """A folder, a zip with that folder at any depth, or events.txt itself (then images.txt is
    looked for beside it).

    Raises EV008 (not that layout), EV009 (damaged text, image or zip), EV016 (an image is
    missing), and what `Events` and `Recording` raise.
    """
    try:
        if path.is_dir():
            return _read(path, EVENTS, hints)
        with open(path, "rb") as f:
            zipped = f.read(2) == b"PK"
        if not zipped:
            return _read(path.parent, path.name, hints)
        with zipfile.ZipFile(path) as archive:
            found = [PurePosixPath(name) for name in archive.namelist() if _is_events(name)]
            if len(found) != 1:
                raise EvflowDataError(
                    "EV008", f"{path} holds {len(found)} recordings: {sorted(map(str, found))}.",
                    "Unpack it and pass one folder.")
            parent = "" if found[0].parent == PurePosixPath(".") else f"{found[0].parent}/"
            return _read(zipfile.Path(archive, parent), EVENTS, hints)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError,
            ValueError) as e:
        raise EvflowDataError("EV009", f"{path} is damaged ({e}).", "Copy it again.") from e


def _is_events(name: str) -> bool:
    return PurePosixPath(name).name == EVENTS and not name.startswith("__MACOSX")


def _read(root: Root, name: str, hints: Hints) -> Recording:
    text = root / name
    table = _read_events(text, hints)
    if hints.time_unit == "auto" and len(table) >= 10 and (table[:, 0] % 1 == 0).all():
        raise EvflowDataError(
            "EV003", f"{text}: all times are whole numbers ({table[0, 0]:.0f}, ...), not seconds.",
            "Microseconds? Pass time_unit='us' (--time-unit us).")
    t = hints.microseconds(table[:, 0], "s")
    x, y, p = (_whole(text, table[:, i], n) for i, n in ((1, "x"), (2, "y"), (3, "p")))
    times, names = (_read_index(root / IMAGES, hints) if name == EVENTS
                    else (np.zeros(0, np.int64), []))
    if not len(t) and not names and hints.size is None:
        raise EvflowDataError("EV001", f"{text} holds no event.")
    size = _image(root, names[0]).shape[1::-1] if names else None
    reach = (int(x.max()), int(y.max())) if len(x) else None
    events = Events(x, y, t, hints.on(p), hints.sensor(size, reach=reach))
    if len(t) and not hints.whole:  # decode only the images that `crop` will keep
        keep = slice(*np.searchsorted(times, hints.span_us(int(t[0]))))
        times, names = times[keep], names[keep]
    if not names:
        return hints.crop(Recording.of_events(events))
    frames, notes = stack_frames([_image(root, n) for n in names], text)
    notes = ("frame times are those of images.txt", *notes)
    return hints.crop(Recording(events, frames, times, notes))


def _read_events(text: Root, hints: Hints) -> np.ndarray:
    """The table t, x, y, p as float64 (N, 4), read until `stop_s`."""
    tables, line, stop = [np.zeros((0, 4))], 1, np.inf
    with text.open("rb") as f:
        for block in _blocks(f):
            rows = _parse(text, block, line)
            line += block.count(b"\n")
            if len(rows) and len(tables) == 1 and hints.stop_s is not None:
                stop = hints.span_us(hints.instant(rows[0, 0], "s"))[1]
            tables.append(rows)
            if len(rows) and stop < np.inf and hints.instant(rows[-1, 0], "s") >= stop:
                break
    return np.concatenate(tables)


def _blocks(f: Any) -> Iterator[bytes]:
    """The file in pieces of whole lines."""
    rest = b""
    while chunk := f.read(BLOCK):
        rest += chunk
        end = rest.rfind(b"\n") + 1
        if end:
            yield rest[:end]
            rest = rest[end:]
        elif len(rest) > MAX_LINE:
            raise ValueError(f"a line of more than {MAX_LINE} bytes is not text")
    if rest:
        yield rest


def _parse(text: Root, block: bytes, line: int) -> np.ndarray:
    """A block that begins at `line` as float64 (rows, 4); EV009 names the first bad line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a block of comments holds no data
            rows = np.loadtxt(io.StringIO(block.decode("ascii")), ndmin=2)
        if rows.size == 0 or rows.shape[1] == 4:
            return rows.reshape(-1, 4)
    except ValueError:
        pass
    for number, content in enumerate(block.split(b"\n"), line):
        fields = content.partition(b"#")[0].split()
        if fields and not (len(fields) == 4 and all(map(_is_number, fields))):
            raise EvflowDataError(
                "EV009", f"{text}, line {number:,} is {content[:60]!r}; expected t[s] x y p.",
                "Cut off or damaged? Copy it again, or delete the last line if it is that one.")
    raise EvflowDataError("EV009", f"{text} is not plain text near line {line:,}.")


def _is_number(field: bytes) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _whole(text: Root, column: np.ndarray, name: str) -> np.ndarray:
    """A column of whole numbers as int64; EV003 (coordinates), EV006 (polarity), EV007 (NaN)."""
    bad = ~np.isfinite(column)
    if bad.any():
        raise EvflowDataError(
            "EV007", f"{text}: {name} is {column[bad][0]} at event {int(np.argmax(bad)):,}.")
    bad = (column % 1 != 0) | (np.abs(column) > 2**31)
    if bad.any():
        raise EvflowDataError(
            "EV006" if name == "p" else "EV003",
            f"{text}: {name} is {column[bad][0]} at event {int(np.argmax(bad)):,}.",
            "Expected 0 or 1." if name == "p" else
            "Coordinates are raw integer pixels: were they undistorted? Use the raw ones.")
    return column.astype(np.int64)


def _read_index(index: Root, hints: Hints) -> tuple[np.ndarray, list[str]]:
    """Times (T,) int64 us and names of the images; none where there is no images.txt."""
    if not index.is_file():
        return np.zeros(0, np.int64), []
    seconds, names = [], []
    for number, content in enumerate(index.read_bytes().split(b"\n"), 1):
        fields = content.partition(b"#")[0].split()
        if not fields:
            continue
        if len(fields) != 2 or not _is_number(fields[0]):
            raise EvflowDataError(
                "EV009", f"{index}, line {number:,} is {content[:60]!r}; expected t[s] path.")
        seconds.append(float(fields[0]))
        names.append(fields[1].decode("utf-8"))
    times = hints.microseconds(np.array(seconds), "s")
    return check_times(times, str(index), strict=True), names


def _image(root: Root, name: str) -> np.ndarray:
    """One image file at its full bit depth, grey or RGB; EV008, EV009, EV016."""
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts:
        raise EvflowDataError("EV008", f"images.txt names {name}, which leaves the recording.")
    file = root.joinpath(*parts.parts)
    if not file.is_file():
        raise EvflowDataError(
            "EV016", f"images.txt names {name}, which is not in {root}.",
            "Restore the image, or remove its line.")
    image = decode(file)
    return image if image.ndim == 2 else image[..., 2::-1]  # OpenCV's order is B, G, R(, A)

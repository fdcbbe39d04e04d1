"""The text folder of the IJRR 2017 / ECD event-camera data sets, or a zip of it.

events.txt has a line `t[s] x y p` per event, or what its header says (`plain_text`); images.txt, if
present, has a line `t[s] path` per image. Times become int64 us by round(t * 1e6). Image times are
used unchanged: the data set does not say where in the exposure they lie. calib.txt, imu.txt and
poses are not read.
"""

from __future__ import annotations

import codecs
import re
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.files.archives import DAMAGE, unzipped
from evflow.files.limits import FREE, read_whole
from evflow.files.regular import is_there
from evflow.io.decode import tables, text
from evflow.io.decode.stream import Chunk, gather
from evflow.io.formats import plain_text
from evflow.io.hints import Hints
from evflow.io.images.exposures import Stamps
from evflow.io.images.folder import decode, unread_images
from evflow.io.images.streams import ImageStream, events_alone
from evflow.notes import Note
from evflow.types import Recording

NAME = "ijrr"
EXTENSIONS: tuple[str, ...] = (".zip", ".txt", "")

EVENTS, IMAGES, FOLDER = "events.txt", "images.txt", "images"
CLOCK = Note("frames.clock", "frame times are those of images.txt")
ROW = re.compile(rb"\d+\.\d+[ \t]+\d+[ \t]+\d+[ \t]+-?[01][ \t]*\r?")

BETWEEN = re.compile(rb"[\s,;]+")  # the time of an image and its name
HEADER = re.compile(rb"[a-z_\s,;\[\]]+", re.IGNORECASE)  # words alone

Root = Path | zipfile.Path


def sniff(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / EVENTS).is_file()
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        try:
            with zipfile.ZipFile(path) as archive:
                return any(_is_events(name) for name in archive.namelist())
        except DAMAGE:
            return path.suffix.lower() == ".zip"  # truncated: the extension decides
    if text.is_binary(head):
        return False
    lines = [line for line in text.plain(head, 0).split(b"\n")
             if line.strip() and not line.startswith(b"#")]
    if path.name == EVENTS:  # `text` explains what is wrong
        fields = lines[0].split() if lines else []
        return plain_text.sniff(path, head) or (
            len(fields) == 4 and all(map(text.is_number, fields)))
    return bool(lines) and ROW.fullmatch(lines[0]) is not None


def read(path: Path, hints: Hints) -> Recording:
    """A folder, a zip with that folder at any depth, or events.txt itself (images.txt is then
    expected beside it).

    Raises EV008 (not that layout), EV009 (damaged text, image or zip), EV016 (an image is
    missing), and what `stream.gather` and `Recording` raise.
    """
    try:
        if path.is_dir():
            return _read(path / EVENTS, path, EVENTS, hints)
        with open(path, "rb") as f:
            zipped = f.read(2) == b"PK"
        if not zipped:
            return _read(path, path.parent, path.name, hints)
        with unzipped(path) as archive:
            found = [PurePosixPath(name) for name in archive.namelist() if _is_events(name)]
            if len(found) != 1:
                raise EvflowDataError(
                    "EV008", f"{path} holds {len(found)} recordings: {sorted(map(str, found))}.",
                    "Unpack it and pass one folder.", where=path)
            parent = "" if found[0].parent == PurePosixPath(".") else f"{found[0].parent}/"
            return _read(path, zipfile.Path(archive, parent), EVENTS, hints)
    except ValueError as e:
        raise EvflowDataError("EV009", f"{path} is damaged ({e}).", "Copy it again.",
                              where=path) from e


def _is_events(name: str) -> bool:
    return PurePosixPath(name).name == EVENTS and not name.startswith("__MACOSX")


def _read(path: Path, root: Root, name: str, hints: Hints) -> Recording:
    """path: the name used in messages."""
    indexed = name == EVENTS and is_there(root / IMAGES)
    seen = _size(root, hints) if indexed else None
    with (root / name).open("rb") as f:
        chunks, native, layout = plain_text.events(path, f, hints)
        size = layout.size or seen
        found = gather(path, _some(path, chunks, hints, size), hints, size, native)
    if not indexed:
        beside = unread_images(root) if isinstance(root, Path) and name == EVENTS and not (
            hints.no_frames) else ()
        return Recording.of_events(found.events, (*layout.notes, *found.notes, *beside))

    def load() -> tables.Loaded:
        seconds, names = _read_index(root / IMAGES)
        return tables.Loaded(
            Stamps(seconds), lambda keep: (_image(root, n) for n in names[keep]))

    images = tables.Images(ImageStream(IMAGES, seen), load)
    return tables.with_frames(path, found, hints, images, "s", layout.notes, (CLOCK,))


def _size(root: Root, hints: Hints) -> Size | None:
    """Size of the first image, the only source for the sensor's size; raises what is wrong with
    that image, unless the size is not needed."""
    try:
        with events_alone():
            _, names = _read_index(root / IMAGES)
            shape = _image(root, names[0]).shape if names else None
    except (EvflowDataError, ValueError):
        if hints.size is None and not hints.no_frames:
            raise
        return None
    return None if shape is None else (shape[1], shape[0])


def _some(
    path: Path, chunks: Iterable[Chunk], hints: Hints, size: Size | None
) -> Iterator[Chunk]:
    """The chunks; EV001 if there is neither an event nor a size."""
    seen = False
    for chunk in chunks:
        seen = seen or len(chunk.t) > 0
        yield chunk
    if not (seen or size or hints.size):
        raise EvflowDataError("EV001", f"{path} holds no event.", where=path)


def _read_index(index: Root) -> tuple[np.ndarray, list[str]]:
    """Times (T,) as written, seconds by the format, and names of the images."""
    seconds: list[float] = []
    names: list[str] = []
    whole = read_whole(index, FREE).removeprefix(codecs.BOM_UTF8)
    for number, content in enumerate(whole.split(b"\n"), 1):
        line = content.partition(b"#")[0].strip()
        fields = BETWEEN.split(line, maxsplit=1)
        if not line or (not seconds and HEADER.fullmatch(line)):
            continue
        if len(fields) != 2 or not text.is_number(fields[0]):
            raise EvflowDataError(
                "EV009", f"{index}, line {number:,} is {content[:60]!r}; expected t[s] path.",
                where=index)
        seconds.append(float(fields[0]))
        names.append(fields[1].decode("utf-8").strip('"').replace("\\", "/"))
    back = np.flatnonzero(np.diff(seconds) <= 0)
    if len(back):
        raise EvflowDataError(
            "EV004", f"{index}: time {seconds[back[0] + 1]:.9g} follows {seconds[back[0]]:.9g} "
            f"({len(back):,} in all).", "Times must increase: lines out of order, or repeated?",
            where=index)
    if len(set(names)) < len(names):  # each would be decoded: a small text could fill the memory
        raise EvflowDataError("EV009", f"{index} has {len(names):,} lines for {len(set(names)):,} "
                              "images.", "Give each time its own image.", where=index)
    return np.array(seconds), names


def _image(root: Root, name: str) -> np.ndarray:
    """One image file at its full bit depth, grey or B, G, R; EV008, EV009, EV016."""
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts:
        raise EvflowDataError("EV008", f"images.txt names {name}, which is outside of it.")
    file = root.joinpath(*parts.parts)
    if not file.is_file():  # some name images without their folder
        file = root.joinpath(FOLDER, *parts.parts)
    if not file.is_file():
        raise EvflowDataError(
            "EV016", f"images.txt names {name}, which is not in {root} or its {FOLDER}.",
            "Restore the image, or remove its line.", where=root)
    return decode(file)

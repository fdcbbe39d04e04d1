"""Events in columns of HDF5 data sets or of arrays, read in blocks of rows; frames beside them.

Every data set is checked against the size of its file before memory is allocated, and whatever h5py
raises on a damaged file becomes EV009.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evflow.checks import Size, check_times
from evflow.errors import EvflowDataError
from evflow.io.decode.hdf5 import DAMAGE, MAGIC, MAX_RATIO, load_h5py, need_filters, plausible
from evflow.io.decode.stream import Chunk, Gathered
from evflow.io.hints import Hints
from evflow.io.images.event_clock import beside_events
from evflow.io.images.exposures import Stamps, stated_by
from evflow.io.images.recorded import FrameStack, in_order
from evflow.io.images.streams import ImageStream, choose, events_alone
from evflow.io.images.white import WHITE, stated_white
from evflow.notes import Note
from evflow.types import Recording

ROWS = 1 << 15  # events read at a time: four float64 columns of 1 MiB in total, which fit a cache


def holds(head: bytes, path: Path, test: Callable[[Any], bool]) -> bool:
    """Whether the path is an HDF5 file that passes the test, or might pass if the test had not led
    to another file."""
    if not head.startswith(MAGIC):
        return False
    try:
        with _file(path) as f:
            return bool(test(f))
    except EvflowDataError as e:
        return e.code == "EV009"  # `read` explains why
    except DAMAGE:
        return False


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The open HDF5 file; EV009 (damaged; data in another file), EV010 (no h5py)."""
    try:
        with _file(path) as f:
            yield f
    except DAMAGE as e:
        raise EvflowDataError(
            "EV009", f"{path} is truncated or damaged ({type(e).__name__}: {e}).",
            "Copy it again; h5ls and h5dump list what is left.", where=path) from e


def _file(path: Path) -> Any:
    """The file, with nothing outside it followed."""
    load_h5py()
    from evflow.io.decode.hdf5_contained import File

    return File(path)


def dataset(
    path: Path, group: Any, name: str, shape: tuple[int | None, ...],
    own_filter: int | None = None, *, spooled: bool = False,
) -> Any:
    """Data set `name` of that shape (None: any length); EV008 (absent), EV009, EV010. own_filter:
    a compression that the caller undoes itself; spooled: as in `plausible`."""
    if name not in group:
        raise EvflowDataError(
            "EV008", f"{path}: {group.name} holds {sorted(group)[:8]} but not {name!r}.",
            "Another layout? Convert it to a format listed in docs/formats.md.", where=path)
    data = group[name]
    found = getattr(data, "shape", None)
    if shape == (None,) and line(found):
        return Line(dataset(path, group, name, (None, None), own_filter))
    if found is None or len(found) != len(shape) or any(
            want is not None and want != got for want, got in zip(shape, found, strict=True)):
        raise EvflowDataError(
            "EV009", f"{path}: {name} of {group.name} has shape {found}; expected {shape}.",
            "Write the file again.", where=path)
    need_filters(path, plausible(path, data, spooled=spooled), own_filter)
    block = math.prod(data.chunks or (0,)) * data.dtype.itemsize
    if block > MAX_RATIO * os.path.getsize(path) + (1 << 20):  # HDF5 decodes whole blocks
        raise EvflowDataError(
            "EV009", f"{path}: {name} claims blocks of {block:,} bytes in a file of "
            f"{os.path.getsize(path):,}.", "Copy or write the file again.", where=path)
    return data


def line(shape: Any) -> bool:
    """Whether an array of that shape is a row or column of numbers, as MATLAB writes them."""
    return shape is not None and len(shape) == 2 and 1 in shape and max(shape) > 1


class Line:
    """A data set (N, 1) or (1, N) as if it were (N,)."""

    def __init__(self, data: Any) -> None:
        self._data, self._across = data, data.shape[0] == 1
        self.shape = (max(data.shape),)
        self.chunks = data.chunks and (data.chunks[self._across],)

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, part: Any) -> Any:
        return self._data[0, part] if self._across else self._data[part, 0]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._data, name)


def blocks(
    n: int,
    rows: Callable[[slice], tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
    stored: int = 1,
    begin: int = 0,
) -> Iterator[Chunk]:
    """Chunks of events begin to n; rows(slice) gives their x, y, t, p. stored: rows of an HDF5
    chunk, which is decoded as a whole: whole chunks are read, each once."""
    for part in aligned(begin, n, max(ROWS // stored, 1) * stored):
        yield Chunk(*rows(part), lambda i, first=part.start: first + i,  # type: ignore[misc]
                    "event")


def aligned(begin: int, end: int, step: int) -> Iterator[slice]:
    """Slices that cover [begin, end) and meet at multiples of step."""
    for first in range(begin - begin % step, end, step):
        yield slice(max(first, begin), min(first + step, end))


def stored_rows(data: Any) -> int:
    """Rows in a chunk of an HDF5 data set; 1 if it is not chunked."""
    return int(data.chunks[0]) if data.chunks else 1


def same_length(path: Path, columns: dict[str, Any]) -> int:
    """The length of all columns; EV009 if they differ."""
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise EvflowDataError(
            "EV009", f"{path} has columns of different lengths: {lengths}.", "Write it again.",
            where=path)
    return next(iter(lengths.values()))


class Loaded(NamedTuple):
    """stamps: of images as stored; decode(part): the images of a slice; full_scale: the DN of white
    that the file states, 0 if it does not."""

    stamps: Stamps
    decode: Callable[[slice], Iterable[np.ndarray]]
    full_scale: int = 0


class Images(NamedTuple):
    """Images of a file, decoded on demand. stream: what they are; load(): what `Loaded`
    says."""

    stream: ImageStream
    load: Callable[[], Loaded]


def with_frames(
    path: Path, found: Gathered, hints: Hints, images: Images | Sequence[Images], native: str,
    notes: tuple[Note, ...] = (), clock: tuple[Note, ...] = (), events: str = "",
) -> Recording:
    """The recording with the images that are its frames, at times within its span.

    images: of one stream, or of several; native: unit of their times in the format; notes: on the
    recording; clock: on frames; events: their name, as in `choose`. Faulty images never prevent
    reading the events: see `streams.events_alone`.
    """
    stored, span, added = found
    notes = (*notes, *added)
    several = (images,) if isinstance(images, Images) else images
    chosen = choose([image.stream for image in several], hints, stored.size, events)
    if chosen.stream is None:
        return Recording.of_events(stored, (*notes, *chosen.notes))
    with events_alone():
        stamps, decode, white = next(i for i in several if i.stream is chosen.stream).load()
        times, added, exposure_us, _ = beside_events(
            stamps, path, native, hints, stored).believed()
        order, _ = in_order(times, hints)
        check_times(times if order is None else times[order], "frame times", strict=True)
        within = np.flatnonzero((times >= span[0]) & (times < span[1]))
        keep = slice(int(within[0]), int(within[-1]) + 1) if len(within) else slice(0)
        stack = FrameStack(path, stored.size, hints.colour, white)
        for image, time in zip(decode(keep), times[keep], strict=True) if len(within) else ():
            if span[0] <= time < span[1]:
                stack.append(image, time, exposure_us=exposure_us)
        return stack.beside(stored, hints, (*clock, *notes, *added, *chosen.notes))


def stored_frames(data: Any, keep: slice) -> Iterator[np.ndarray]:
    """Frames of an HDF5 data set one by one; each stored chunk is decoded once."""
    for part in aligned(keep.start, keep.stop, stored_rows(data)):
        yield from data[part]


def frame_size(data: Any) -> Size | None:
    """(width, height) of frames (T, H, W) or (T, H, W, C); None if they have another shape."""
    shape: tuple[int, ...] = getattr(data, "shape", ())
    return (int(shape[2]), int(shape[1])) if len(shape) in (3, 4) and all(shape[1:3]) else None


def dataset_images(path: Path, group: Any, name: str, times: str) -> Images:
    """Frames in data set `name` of an HDF5 group, and their times in another; an attribute of
    either may state their exposure, and one of the frames their white."""
    def load() -> Loaded:
        frames = dataset(path, group, name, (None, None, None), spooled=True)
        clock = dataset(path, group, times, (len(frames),))
        stamps = Stamps(clock[:], stated_us=stated_by(frames, clock))
        return Loaded(stamps, lambda keep: stored_frames(frames, keep),
                      stated_white(frames.attrs.get(WHITE)))

    whole = f"{group.name}/{name}".strip("/")
    return Images(ImageStream(whole, frame_size(group[name])), load)

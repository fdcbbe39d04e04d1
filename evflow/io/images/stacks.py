"""Videos in NumPy files: memory-mapped .npy stacks, and .npz stacks decompressed frame by frame.

A stack is (T, H, W) or (T, H, W, 3) in R, G, B. In an .npz it is called frames (or images, imgs,
video, arr_0), and its times, if any, frame_times (or timestamps, times, t, or another such name);
they may be begin and end of the exposures, or beside an exposure (`exposure_us`).
"""

from __future__ import annotations

import dataclasses
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.archives import BLOCK, DAMAGE, Member, is_zip, npy_header, unzipped
from evflow.files.limits import check_expansion
from evflow.io.decode.images_beside import stamps_of, times_of
from evflow.io.images.exposures import Stamps
from evflow.io.images.frames import FrameHints, Image
from evflow.io.images.times import FrameTimes, read_times, to_us
from evflow.notes import Note

FRAMES = ("frames", "images", "imgs", "video", "arr_0")
TIMES = ("frame_times", "timestamps", "times", "t")


def is_stack(path: Path) -> bool:
    """Whether it is an .npy, or an .npz with frames and no events."""
    if path.suffix.lower() == ".npy":
        return True
    if path.suffix.lower() != ".npz" or not is_zip(path):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return not {"t.npy", "x.npy", "y.npy", "p.npy"} <= set(archive.namelist())
    except DAMAGE:
        return True  # `open_stack` explains why


@dataclasses.dataclass(frozen=True)
class Stack:
    """A stack of `shape` on disk; member: its name in an .npz, "" for an .npy. count: frames to
    read, shape[0] unless the file is truncated. times_us (count,) int64; exposure_us: 0 if it is
    unknown."""

    path: Path
    member: str
    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    offset: int
    times_us: np.ndarray
    notes: tuple[Note, ...]
    exposure_us: int = 0

    @property
    def size(self) -> tuple[int, int]:
        return self.shape[2], self.shape[1]

    def images(self, partial: bool = False) -> Iterator[Image]:
        """The frames in OpenCV's channel order; EV009 if an .npz ends early."""
        read = self._members(partial) if self.member else self._mapped()
        times = self.times_us.tolist()
        native = self.dtype.newbyteorder("=")
        for index, (pixels, time) in enumerate(zip(read, times, strict=not partial)):
            pixels = pixels.astype(native, copy=False)
            order = [2, 1, 0, 3][: self.shape[3]] if len(self.shape) == 4 else []
            pixels = pixels[..., order] if len(order) >= 3 else pixels
            yield Image(pixels, time, f"frame {index} of {self.path}")

    def _mapped(self) -> Iterator[np.ndarray]:
        mapped = np.memmap(self.path, self.dtype, "r", self.offset, self.shape,
                           "F" if self.fortran else "C")
        for index in range(len(self.times_us)):
            yield np.array(mapped[index])

    def _members(self, partial: bool) -> Iterator[np.ndarray]:
        count = math.prod(self.shape[1:])
        done = 0
        try:
            with zipfile.ZipFile(self.path) as archive, archive.open(self.member) as f:
                npy_header(f)
                while done < self.shape[0]:
                    data = f.read(count * self.dtype.itemsize)
                    yield np.frombuffer(data, self.dtype, count).reshape(self.shape[1:])
                    done += 1
                while f.read(BLOCK):  # to the checksum, in case a damaged header claims less
                    pass
        except Exception as e:  # zip, zlib, lzma, ValueError: many types
            if not (partial and done):
                raise cut_off(self.path, done, self.shape[0], str(e)) from e


def open_stack(path: Path, hints: FrameHints) -> Stack:
    """Raises EV001 (no frames), EV002 (shape, number of times), EV003 (dtype), EV009 (damaged or
    truncated, unless `hints.partial`), EV020 (no times)."""
    try:
        if path.suffix.lower() == ".npz":
            stack, stamps = _open_npz(path)
        else:
            stack, stamps = _open_npy(path, hints.partial), None
    except (OSError, EOFError, ValueError) as e:
        raise EvflowDataError(
            "EV009", f"{path} is not a valid .npy ({e or type(e).__name__}).",
            "Copy or save it again.", where=path) from e
    _check(stack)
    found = frame_times(path, stack.shape[0], hints, stamps)
    return dataclasses.replace(
        stack, times_us=found.us, notes=found.notes, exposure_us=found.exposure_us)


def cut_off(path: object, read: int, promised: int, why: str) -> EvflowDataError:
    """EV009 with the number of frames that can be read."""
    return EvflowDataError(
        "EV009", f"{read:,} of the {promised:,} frames of {path} can be read"
        f"{f' ({why})' if why else ''}.",
        "Truncated or damaged: copy it again"
        + (", or pass --partial (partial=True) to use those." if read else "."), where=path)


def _open_npy(path: Path, partial: bool) -> Stack:
    with open(path, "rb") as f:
        shape, fortran, dtype = npy_header(f)
        offset = f.tell()
    frame = max(1, math.prod(shape[1:]) * dtype.itemsize)
    whole = min((path.stat().st_size - offset) // frame, shape[0] if shape else 0)
    if shape and whole < shape[0] and not (partial and whole and not fortran):
        raise cut_off(path, 0 if fortran else whole, shape[0], "")
    shape = (whole, *shape[1:])
    return Stack(path, "", shape, dtype, fortran, offset, np.zeros(0, np.int64), ())


def _open_npz(path: Path) -> tuple[Stack, Stamps | None]:
    with unzipped(path, streamed=[f"{name}.npy" for name in FRAMES]) as archive:
        names = [name[:-4] for name in archive.namelist() if name.endswith(".npy")]
        member = next((name for name in FRAMES if name in names), None)
        if member is None:
            raise EvflowDataError(
                "EV008", f"{path} holds {sorted(names)} but no frames.",
                f"Expected {', '.join(FRAMES)}; or t, x, y, p for a recording.", where=path)
        with archive.open(member + ".npy") as f:
            shape, fortran, dtype = npy_header(f)
        arrays = {name: Member(archive, archive.getinfo(f"{name}.npy")) for name in names}
        clock = next((name for name in TIMES if name in names), "") or (
            times_of(member, arrays) if shape else "")
        stamps = stamps_of(member, clock, arrays, lambda name: arrays[name].whole(), path) if (
            clock) else None
    if fortran and len(shape) > 1:
        raise EvflowDataError(
            "EV009", f"{path} holds {member} in Fortran order, in which frames are not contiguous.",
            "Save np.ascontiguousarray(frames).", where=path)
    stack = Stack(path, member + ".npy", shape, dtype, False, 0, np.zeros(0, np.int64), ())
    return stack, stamps


def _check(stack: Stack) -> None:
    shape = stack.shape
    if len(shape) not in (3, 4) or (len(shape) == 4 and shape[-1] not in (1, 3, 4)):
        first = len(shape) == 4 and shape[1] in (1, 3, 4)
        raise EvflowDataError(
            "EV002", f"{stack.path} has shape {shape}.",
            "Channels come last: np.moveaxis(frames, 1, -1)." if first else
            "Expected frames (T, H, W), or (T, H, W, 3) in R, G, B.", where=stack.path)
    if stack.member:
        check_expansion(math.prod(shape[1:]) * stack.dtype.itemsize, stack.path.stat().st_size,
                        f"one frame of {stack.path}")
    if min(shape) == 0:
        raise EvflowDataError("EV001", f"{stack.path} holds frames of shape {shape}.",
                              where=stack.path)


def frame_times(
    path: Path, count: int, hints: FrameHints, stamps: Stamps | None, unit: str = "auto"
) -> FrameTimes:
    """When the `count` frames of a file were taken: as the options say, else by its own stamps in
    that unit. EV002 (another number), EV020 (none)."""
    if hints.fps is not None:
        return FrameTimes(np.array([hints.at_rate(i) for i in range(count)], np.int64), ())
    if hints.timestamps is not None:
        where: Any = Path(hints.timestamps)
        found = read_times(where, hints.time_unit)
    elif stamps is not None:
        where = "but"
        unit = unit if hints.time_unit == "auto" else hints.time_unit
        found = to_us(stamps, path, unit).believed()
    else:
        raise EvflowDataError(
            "EV020", f"{path} holds {count:,} frames but no times.",
            "Pass --fps or --timestamps FILE.", where=path)
    if len(found.us) != count and not (hints.partial and len(found.us) > count):
        raise EvflowDataError(
            "EV002", f"{path} holds {count:,} frames, {where} {len(found.us):,} times.",
            "Give one time per frame, or pass --fps.", where=path)
    return found._replace(us=found.us[:count])

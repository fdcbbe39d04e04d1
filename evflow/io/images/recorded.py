"""Frames that are part of a recording: collected as they are decoded, then joined to its events."""

from __future__ import annotations

import collections
import dataclasses

import numpy as np

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.files.spool import Spool
from evflow.io.decode.late import longest
from evflow.io.hints import Hints
from evflow.io.images.exposures import believed, exposed_note
from evflow.light.colour import CONVERTED, luma, mosaic, seen_note
from evflow.notes import Note
from evflow.types import Events, Recording


class FrameStack:
    """Images (H, W) or (H, W, 3) in B, G, R that arrive one by one, as the frames of a recording:
    colour becomes luma, or what pixels see of it. Stored in a `Spool`.

    where: names their file in messages; size: (width, height) of the sensor: images of another
    size, such as a region of it, are left out and counted. seen: what pixels see, as
    `Hints.colour`. full_scale: the DN of white if the file states it; else 0.
    """

    def __init__(
        self, where: object, size: Size, seen: str = "luma", full_scale: int = 0
    ) -> None:
        self.where, self.size, self.seen, self.colour = where, size, seen, False
        self.full_scale = full_scale
        self.times: list[int] = []
        self.exposures: list[int] = []
        self.left: collections.Counter[str] = collections.Counter()
        self._spool: Spool | None = None

    def append(self, image: np.ndarray, time: int, origin: tuple[int, int] = (0, 0),
               exposure_us: int = 0) -> None:
        """Add an image, its time, the sensor pixel (x, y) of its top left corner, and its exposure
        if it is known.

        Raises EV002 (no image), EV003 (the dtype changes), EV019 (disk full).
        """
        if image.ndim != 2 and not (image.ndim == 3 and image.shape[-1] in (3, 4)):
            raise EvflowDataError(
                "EV002", f"{self.where} has a frame of shape {image.shape}.",
                "Expected (H, W) or (H, W, 3).", where=self.where)
        width, height = self.size
        if image.shape[:2] != (height, width):
            region = image.shape[0] <= height and image.shape[1] <= width and any(origin)
            self.left[f"{image.shape[1]}x{image.shape[0]}"
                      + (f" from x={origin[0]}, y={origin[1]}" if region else "")] += 1
            return
        grey = (image if image.ndim == 2 else luma(image[..., :3]) if self.seen == "luma" else
                mosaic(image[..., :3], self.seen))
        if self._spool is None:
            self._spool = Spool(grey.dtype)
        if grey.dtype != self._spool.dtype:
            raise EvflowDataError(
                "EV003", f"{self.where} has frames of {self._spool.dtype} and {grey.dtype}.",
                "Use frames of one bit depth.", where=self.where)
        self._spool.append(grey.ravel())
        self.colour |= image.ndim == 3
        self.times.append(time)
        self.exposures.append(exposure_us)

    def beside(self, events: Events, hints: Hints, notes: tuple[Note, ...]) -> Recording:
        """The recording of these events and all frames; raises as `Recording`."""
        return self.at(np.array(self.times, np.int64), events, hints, notes)

    def at(
        self, times: np.ndarray, events: Events, hints: Hints, notes: tuple[Note, ...]
    ) -> Recording:
        """The same with other times (T,) int64 us."""
        if self.left:
            sizes = ", ".join(f"{n:,} of {what}" for what, n in self.left.most_common(4))
            notes = (*notes, Note("frames.unused", f"images whose size differs from the sensor's "
                     f"{self.size[0]}x{self.size[1]} were left out: {sizes}"))
        if self._spool is None:
            return Recording.of_events(events, notes)
        frames = self._spool.array().reshape(-1, *self.size[::-1])
        if self.seen != "luma":
            notes = (*notes, seen_note(self.seen, self.colour))
        elif self.colour:
            notes = (*notes, CONVERTED)
        order, more = in_order(times, hints)
        if order is not None:
            frames, times = frames[order], times[order]
        exposure_us, doubted = believed(round(np.median(self.exposures)), times)
        more = (*more, *doubted)
        if exposure_us:
            more = (*more, exposed_note(exposure_us))
        white = self.full_scale if frames.dtype != np.uint8 else 0
        return Recording(events, frames, times, (*notes, *more), exposure_us, white)


def in_order(times: np.ndarray, hints: Hints) -> tuple[np.ndarray | None, tuple[Note, ...]]:
    """Indices that make frame times (T,) increase as `hints.late` says, and a note; None if they
    already do, or are to be refused."""
    if hints.late not in ("drop", "sort") or bool((np.diff(times) > 0).all()):
        return None, ()
    if hints.late == "sort":
        order = np.unique(times, return_index=True)[1]
        return order, (Note("frames.late", "late frames were sorted in; "
                            f"{len(times) - len(order):,} with equal times were left out "
                            "(--late sort)"),)
    kept = longest(times)
    kept = kept[np.diff(times[kept], prepend=times[kept[0]] - 1) > 0]
    return kept, (Note("frames.late", f"{len(times) - len(kept):,} of {len(times):,} frames whose "
                       "time goes back or repeats were left out (--late drop)"),)


def cut(recording: Recording, span: tuple[int, int]) -> Recording:
    """The recording with only those frames that lie in [start, stop) us."""
    keep = slice(*np.searchsorted(recording.frame_times, np.array(span)))
    return dataclasses.replace(
        recording, frames=recording.frames[keep], frame_times=recording.frame_times[keep])

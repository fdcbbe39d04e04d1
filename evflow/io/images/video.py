"""Video files through OpenCV: colour frames and their times, one by one.

A video begins at 0 us. Its times come from `fps` or `timestamps` if the user gave one, else from
the container, which knows variable frame rates. OpenCV decodes to 8 bits per channel.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from typing import IO, Any

import cv2
import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.images.folder import SUFFIXES
from evflow.io.images.frames import FrameHints, Image, existing
from evflow.io.images.matroska import first_stamp_s
from evflow.io.images.stacks import cut_off
from evflow.io.images.times import read_times
from evflow.io.images.transfer import box, hdr_note
from evflow.notes import Note

SLACK = 1.5  # frames; containers without a count derive it from their rounded duration
SLACK_SHARE = 0.001
REST = "the rest is missing or damaged"
BLACK, NOT_BLACK = 2, 1e-3  # code value; share of bytes of a black picture that may exceed it
TICK_US = 1000.5  # Matroska and WebM round times to the millisecond


@dataclasses.dataclass(frozen=True)
class Video:
    """A video file: size (width, height), fps and the frame count that its header claims (0 =
    unknown); times_us (T,) and exposure_us (0 = unknown) if the user gave them."""

    path: Path
    size: tuple[int, int]
    fps: float
    claimed: int
    hints: FrameHints
    times_us: np.ndarray | None
    notes: list[Note]
    exposure_us: int = 0

    def images(self) -> Iterator[Image]:
        """The frames (H, W, 3) from first to last, B, G, R.

        Raises EV002 (more or fewer frames than `timestamps`), EV004 (the container's times do
        not increase), EV009 (fewer frames than the container promises, unless `partial`).
        """
        clock, count, first, still = Clock(self.path, self.fps), 0, None, True
        with _capture(self.path) as capture:
            while True:
                good, pixels = capture.read()
                if not good:
                    break
                first = pixels if first is None else first
                still = still and np.array_equal(first, pixels)
                yield Image(pixels, self._time(count, clock, capture), self._name(count))
                count += 1
        lost = min(self.claimed - count, self.claimed - 1 - clock.last_us * self.fps * 1e-6)
        if self.times_us is not None or self.hints.fps is not None or not clock.trusted:
            lost = self.claimed - count
        if lost > _slack(self.claimed) and not self.hints.partial:
            raise _short(self.path, count, self.claimed)
        if self.times_us is not None and count < len(self.times_us) and not self.hints.partial:
            raise self._miscounted(f"{count:,}")
        more = clock.notes() + ([_still(self.path, count)] if still and count > 1 else [])
        self.notes.extend(note for note in more if note not in self.notes)

    def _name(self, index: int) -> str:
        return f"frame {index} of {self.path}"

    def _time(self, index: int, clock: Clock, capture: Any) -> int:
        if self.hints.fps is not None:
            return self.hints.at_rate(index)
        if self.times_us is None:
            return clock.time(index, capture.get(cv2.CAP_PROP_POS_MSEC))
        if index >= len(self.times_us):
            raise self._miscounted(f"more than {index:,}")
        return int(self.times_us[index])

    def _miscounted(self, count: str) -> EvflowDataError:
        assert self.times_us is not None
        return EvflowDataError(
            "EV002", f"{self.path} has {count} frames, {self.hints.timestamps} "
            f"{len(self.times_us):,} times.", "Give one time per frame, or pass --fps.",
            where=self.path)


class Clock:
    """Times of frames in us from the container's in ms, which may be coarse or absent.

    If all times are whole milliseconds within 1 ms of the nominal rate's, they are the nominal
    ones, rounded, and the exact rate is used. A container whose second frame is not later than its
    first keeps no times, and only the rate is used.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self.fps = path, fps
        self.first_us = self.last_us = 0.0
        self.trusted, self.coarse, self.steady = True, True, True
        self.steps = (float("inf"), 0.0)

    def time(self, index: int, stamp_ms: float) -> int:
        """The time of frame `index`; EV004 if it does not follow the previous one."""
        nominal = index * 1e6 / self.fps
        if index == 0:
            self.first_us = stamp_ms * 1e3
        stamp = stamp_ms * 1e3 - self.first_us
        if index == 1:
            self.trusted = stamp > 0
        self.coarse &= abs(stamp_ms - round(stamp_ms)) < 1e-6
        self.steady &= abs(stamp - nominal) <= TICK_US
        now = nominal if not self.trusted or (self.coarse and self.steady) else stamp
        if index and now <= self.last_us:
            raise EvflowDataError(
                "EV004", f"frame {index} of {self.path} is at {now:.0f} us, the previous one at "
                f"{self.last_us:.0f} us: its container's times do not increase.",
                f"Pass --fps {self.fps:.6g} to count frames instead.", where=self.path)
        if index:
            step = now - self.last_us
            self.steps = min(self.steps[0], step), max(self.steps[1], step)
        self.last_us = now
        return round(now)

    def notes(self) -> list[Note]:
        """A note if the frame rate varied by more than rounding."""
        shortest, longest = self.steps
        if longest <= 1.1 * shortest + 2 * TICK_US:
            return []
        return [Note("frames.rate", f"{self.path} has a variable frame rate ({1e6 / longest:.4g} "
                     f"to {1e6 / shortest:.4g} frames/s); its own times were used.")]


def open_video(path: str | os.PathLike, hints: FrameHints | None = None) -> Video:
    """Open a video; only its first frame is decoded unless it is damaged.

    Raises EV008 (no video, a single picture), EV009 (nothing can be decoded; truncated, unless
    `hints.partial`), EV016 (not found), EV020 (no frame rate), and what `read_times` raises.
    """
    path, hints = existing(path), hints or FrameHints()
    if path.suffix.lower() in SUFFIXES:
        raise EvflowDataError(
            "EV008", f"{path} is a single picture.", "For an image sequence pass its folder; to "
            "move a sensor over one picture, --saccades 10 (evflow simulate).", where=path)
    with _capture(path) as capture:
        if not capture.isOpened():
            raise EvflowDataError(
                "EV008", f"{path} is neither a recording nor a video that OpenCV can open.",
                "A truncated mp4 has lost its index: copy it again. Convert other formats to mp4 "
                "(H.264) or avi (MJPG).", where=path)
        rate = capture.get(cv2.CAP_PROP_FPS)
        claimed = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if claimed > 0 and 0 < rate < 1e6:  # counted from 0, although a film may begin later
            claimed -= math.floor(first_stamp_s(path) * rate + 0.5)
        claimed = max(0, claimed)
        good, first = capture.read()
        if not good:
            codec = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little")
            raise EvflowDataError(
                "EV009", f"no frame of {path} can be decoded; its codec is "
                f"{codec.decode('ascii', 'replace')}, which OpenCV may not know here.",
                f"Convert it: ffmpeg -i {quote(path.name)} -c:v libx264 -crf 12 new.mp4; or, if it "
                "is damaged, copy it again.", where=path)
        _check_converted(path, capture, claimed, first)
        if not hints.partial and claimed > 1:
            _check_end(path, capture, claimed)
        if not hints.partial:
            _check_bytes(path)
    times, notes, exposure_us = None, list(hdr_note(path)), 0
    if hints.timestamps is not None:
        times, more, exposure_us, _ = read_times(Path(hints.timestamps), hints.time_unit)
        notes += more
    if not (rate and 0 < rate < 1e6) and times is None and hints.fps is None:
        raise EvflowDataError("EV020", f"{path} states no frame rate ({rate:g}).", "Pass --fps.",
                              where=path)
    return Video(path, first.shape[1::-1], float(rate), claimed, hints, times, notes,
                 exposure_us)


def _check_converted(path: Path, capture: Any, claimed: int, first: np.ndarray) -> None:
    """Raise EV009 if all frames are identically black: OpenCV fails to convert some interlaced
    video and says so only on the terminal."""
    if claimed < 2 or np.median(first) > BLACK or (first > BLACK).mean() > NOT_BLACK:
        return
    for share in (0.25, 0.5, 0.75):
        capture.set(cv2.CAP_PROP_POS_FRAMES, int(share * claimed))
        good, other = capture.read()
        if not good or not np.array_equal(first, other):
            return
    raise EvflowDataError(
        "EV009", f"all frames of {path} are decoded to the same black picture: interlaced video "
        "that OpenCV does not convert here?",
        f"Deinterlace it: ffmpeg -i {quote(path.name)} -vf bwdif new.mp4.", where=path)


def _still(path: Path, count: int) -> Note:
    return Note("frames.still", f"all {count:,} frames of {path} are identical: nothing moves, or "
                "it is interlaced, which some versions of OpenCV do not convert: deinterlace it "
                f"(ffmpeg -i {quote(path.name)} -vf bwdif new.mp4).")


def _check_end(path: Path, capture: Any, claimed: int) -> None:
    """Raise EV009 at once if the end is missing, rather than after an hour of simulation.

    The frames are counted, by decoding them all, only if the last one cannot be sought.
    """
    slack = int(_slack(claimed))
    capture.set(cv2.CAP_PROP_POS_FRAMES, max(0, claimed - 1 - slack))
    if capture.grab():
        return
    with _capture(path) as again:
        count, last = 0, 0.0
        while again.grab():
            count, last = count + 1, again.get(cv2.CAP_PROP_POS_MSEC)
        by_time = claimed - 1 - last * 1e-3 * again.get(cv2.CAP_PROP_FPS)
    lost = min(claimed - count, by_time) if last > 0 else claimed - count
    if lost > _slack(claimed):
        raise _short(path, count, claimed)


def _short(path: Path, count: int, claimed: int) -> EvflowDataError:
    """EV009 for frames that are missing; a whole mp4 with an edit list was probably trimmed."""
    with open(path, "rb") as f:
        total = path.stat().st_size
        whole = f.read(8)[4:] == b"ftyp" and _boxes_end(f, total) == total
        if not (count and whole and b"elst" in box(f, b"moov")):
            return cut_off(path, count, claimed, REST)
    return EvflowDataError(
        "EV009", f"{count:,} of the {claimed:,} frames of {path} can be read: the others were "
        "probably trimmed away by its edit list, as a cut without re-encoding leaves them.",
        "If so, pass --partial (partial=True), or encode it again: ffmpeg -i "
        f"{quote(path.name)} -c:v libx264 -crf 12 new.mp4. If it was not cut, it is damaged: copy "
        "it again.", where=path)


def _check_bytes(path: Path) -> None:
    """Raise EV009 if an AVI or mp4 claims more bytes than the file has: OpenCV would fill the rest
    of its last frame with grey."""
    total = path.stat().st_size
    with open(path, "rb") as f:
        head = f.read(12)
        if head.startswith(b"RIFF") and head[8:] == b"AVI ":
            end = 8 + int.from_bytes(head[4:8], "little")
        elif head[4:8] == b"ftyp":
            end = _boxes_end(f, total)
        else:
            return
    if end > total:
        raise EvflowDataError(
            "EV009", f"{path} ends {end - total:,} bytes early, at byte {total:,}.",
            "It is truncated: copy it again, or pass --partial (partial=True).", where=path)


def _boxes_end(f: IO[bytes], total: int) -> int:
    """The end of the last box of an mp4: {u32 size, name}, size 1: u64 size, 0: to the end."""
    at = 0
    while at + 8 <= total:
        f.seek(at)
        box = f.read(16)
        size = int.from_bytes(box[:4], "big")
        size = int.from_bytes(box[8:], "big") if size == 1 else size or total - at
        if size < 8:
            break
        at += size
    return at


def _slack(claimed: int) -> float:
    return SLACK + SLACK_SHARE * claimed


@contextlib.contextmanager
def _capture(path: Path) -> Iterator[Any]:
    capture = cv2.VideoCapture(str(path))
    try:
        yield capture
    finally:
        capture.release()

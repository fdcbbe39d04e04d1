"""Events as a film or an image: ON red, OFF blue, on white or over the recording's frames.

Needs OpenCV and Pillow alone.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from evflow.errors import EvflowDataError
from evflow.estimation.pipeline import Progress
from evflow.files.atomic import atomic_write, need_no_folder
from evflow.recordings.windows import need_few_windows
from evflow.report.caption import captioned
from evflow.report.page import short
from evflow.report.plots import event_image
from evflow.report.resimulate import busiest_instant
from evflow.report.video import CODECS, FPS, SCALES, Codec, check_within, enlarged, write_video
from evflow.types import Events, Recording

SUFFIXES = (".mp4", ".gif", ".png")
SLOW = (1e-3, 1e6)  # times slower than life
GAP = 8  # pixels between the pictures of a sheet


@dataclasses.dataclass(frozen=True)
class Film:
    """How events become pictures. fps: pictures per second; window_us: time over which a picture
    collects events; window_events: instead, number of consecutive events per picture; slow: times
    slower than life; over_frames: drawn on the frames nearest in time; scale: screen pixels per
    pixel, None makes the film about 640 wide; caption: time, duration and colours in a line below;
    codec: of .mp4, "mpeg4" (video players) or "vp9" (also browsers; some 50 times slower). Raises
    EV020."""

    fps: float = 30.0
    window_us: int = 33_000
    slow: float = 1.0
    over_frames: bool = False
    scale: int | None = None
    codec: Codec = "mpeg4"
    window_events: int | None = None
    caption: bool = False

    def __post_init__(self) -> None:
        for name, bounds in (("fps", FPS), ("window_us", (1, 10**9)), ("slow", SLOW),
                             ("scale", SCALES), ("window_events", (1, 10**9))):
            check_within(bounds, name, getattr(self, name))
        if self.codec not in CODECS:
            raise EvflowDataError("EV020", f"codec={self.codec!r}.", f"Choose {CODECS}.")

    @property
    def step_us(self) -> float:
        """Recorded time from picture to picture."""
        return 1e6 / (self.fps * self.slow)

    def check_target(self, path: Path, *, overwrite: bool) -> None:
        """EV013 where it exists or is a folder, EV020 where it is neither .mp4, .gif nor .png."""
        if path.suffix.lower() not in SUFFIXES:
            raise EvflowDataError("EV020", f"{path.name} does not end in {', '.join(SUFFIXES)}.",
                                  "The extension selects the format.")
        need_no_folder(path)
        if path.exists() and not overwrite:
            raise EvflowDataError("EV013", f"{path} exists.", "Pass --overwrite.")


def write_film(
    path: str | os.PathLike, recording: Recording, film: Film, *, overwrite: bool = False,
    progress: Progress | None = None,
) -> str:
    """Write an .mp4 or .gif of the whole recording; returns what was written, in words.

    Raises EV001 (no events), EV011 (over_frames without any), EV013, EV019 (OpenCV cannot
    write it), EV020.
    """
    path = Path(path)
    film.check_target(path, overwrite=overwrite)
    _check(recording, film)
    count = len(_windows(recording, film))
    return write_video(path, _pictures(recording, film, count, progress), count, fps=film.fps,
                       codec=film.codec, overwrite=overwrite)


def write_sheet(
    path: str | os.PathLike, recording: Recording, film: Film, *, at_s: float | None = None,
    overwrite: bool = False,
) -> str:
    """Write a .png of one window: events and, if there are frames, the frame and both together.

    at_s: seconds from the first event to the window's middle; None for the busiest. Returns what
    was written, in words. Raises EV001, EV013, EV020 (outside the recording).
    """
    path, events = Path(path), recording.events
    film.check_target(path, overwrite=overwrite)
    _check(recording, film)
    span = (int(events.t[0]), int(events.t[-1]) + 1)
    if at_s is None:
        begin = busiest_instant(events, span, film.window_us)
    else:
        if not 0 <= at_s <= events.duration_us / 1e6:
            raise EvflowDataError("EV020", f"at={at_s} s.", "The recording covers 0 to "
                                  f"{events.duration_us / 1e6:.3f} s from its first event.")
        begin = span[0] + round(1e6 * at_s) - film.window_us // 2
    end = begin + film.window_us
    if film.window_events is not None:
        begin, end = _around(events, begin + film.window_us // 2, film.window_events)
    begin, end = max(begin, span[0]), min(end, span[1])
    middle = (begin + end) // 2
    shown = event_image(events, begin, end)
    parts = [shown]
    if recording.has_frames:
        frame = _frame(recording, middle, _white(recording))
        parts = [np.repeat(frame, 3, -1), shown, _over(frame, shown)]
    parts = [enlarged(part, film.scale) for part in parts]
    gap = np.full((parts[0].shape[0], GAP, 3), 255, np.uint8)
    sheet = np.concatenate([piece for part in parts for piece in (part, gap)][:-1], 1)
    if film.caption:
        sheet = captioned(sheet, _caption(events, begin, end, "   {}x{} pixels".format(
            *events.size)))
    with atomic_write(path, overwrite=overwrite) as temporary:
        Image.fromarray(sheet).save(temporary, "png", optimize=True)
    inside = len(events.slice(begin, end))
    return (f"{inside:,} events of {(end - begin) / 1e3:g} ms around "
            f"{(middle - span[0]) / 1e6:.3f} s")


def _check(recording: Recording, film: Film) -> None:
    if not len(recording.events):
        raise EvflowDataError("EV001", "the recording has no events.", "There is nothing to show.")
    if film.over_frames and not recording.has_frames:
        raise EvflowDataError("EV011", "the recording has no frames.", "Leave out --over-frames.")


def _pictures(
    recording: Recording, film: Film, count: int, progress: Progress | None
) -> Iterator[np.ndarray]:
    """(H, W, 3) uint8 RGB, one after the other."""
    white = _white(recording) if film.over_frames else 1.0
    for i, (begin, end) in enumerate(_windows(recording, film)):
        shown = event_image(recording.events, begin, end)
        if film.over_frames:
            shown = _over(_frame(recording, (begin + end) // 2, white), shown)
        picture = enlarged(shown, film.scale)
        if film.caption:
            picture = captioned(picture, _caption(recording.events, begin, end))
        yield picture
        if progress:
            progress(i + 1, count)


def _caption(events: Events, begin: int, end: int, more: str = "") -> str:
    """When, for how long, and what the colours are."""
    at_s = ((begin + end) / 2 - int(events.t[0])) / 1e6
    return (f"{at_s:.3f} s   {short((end - begin) / 1e3)} ms   ON red, OFF blue: full at 3 events"
            f"{more}")


def _windows(recording: Recording, film: Film) -> list[tuple[int, int]]:
    """Begin and end in us of each picture's events: around evenly spaced times, or consecutive
    events by number (including others at the time of the last one)."""
    t = recording.events.t
    if film.window_events is None:
        need_few_windows(t, max(1, int(film.step_us)))
        count = max(1, math.ceil(recording.events.duration_us / film.step_us))
        middles = [int(t[0]) + round((i + 0.5) * film.step_us) for i in range(count)]
        return [(m - film.window_us // 2, m - film.window_us // 2 + film.window_us)
                for m in middles]
    edges = [*t[:: film.window_events].tolist(), int(t[-1]) + 1]
    return [(a, b) for a, b in itertools.pairwise(edges) if b > a]


def _around(events: Events, at_us: int, count: int) -> tuple[int, int]:
    """Begin and end in us of `count` events around an instant."""
    middle = int(np.searchsorted(events.t, at_us))
    first = max(0, min(middle - count // 2, len(events) - count))
    return int(events.t[first]), int(events.t[min(first + count, len(events)) - 1]) + 1


def _white(recording: Recording) -> float:
    """The DN shown as white: 99.5 % of the pixels of a few frames are below it."""
    some = np.unique(np.linspace(0, len(recording.frames) - 1, 8).astype(int))
    return max(1.0, float(np.percentile([recording.frame_dn(i) for i in some], 99.5)))


def _frame(recording: Recording, at_us: int, white: float) -> np.ndarray:
    """The frame nearest in time, (H, W, 1) in 0..1."""
    nearest = int(np.argmin(np.abs(recording.frame_times - at_us)))
    return np.minimum(recording.frame_dn(nearest)[..., None] / white, 1.0)


def _over(frame: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """An event image over a frame, which shows where there are no events."""
    strength = np.minimum(1.0, 1.5 * (1.0 - shown.min(-1, keepdims=True)))
    return (1 - strength) * frame + strength * shown

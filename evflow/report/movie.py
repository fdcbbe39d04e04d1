"""Events as a film or a sheet: red ON, blue OFF, over white or over the recording's frames.

Needs OpenCV and Pillow alone. A film is written beside its place, opened again, and only moved
there if all its pictures can be read.
"""

from __future__ import annotations

import dataclasses
import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from PIL import Image

from evflow.errors import EvflowDataError
from evflow.files import atomic_write
from evflow.recording import Progress
from evflow.report.plots import event_image
from evflow.report.resimulate import busiest_instant
from evflow.types import Recording

FOURCC = {"mpeg4": "mp4v", "vp9": "vp09"}  # H.264 is in no free build of OpenCV
SUFFIXES = (".mp4", ".gif", ".png")
WIDTH = 640  # screen pixels that a small sensor is enlarged to
GIF_TICK_S = 0.01  # GIF counts time in hundredths of a second
GIF_FRAMES = 600  # a GIF is held in memory and grows large: more are refused
GAP = 8  # pixels between the pictures of a sheet


@dataclasses.dataclass(frozen=True)
class Film:
    """How events become pictures. fps: pictures per second; window_us: how long one gathers
    events; slow: times slower than life; over_frames: on the frames nearest in time; scale:
    screen pixels per pixel, None for as many as make it 640 wide;
    codec: of .mp4, "mpeg4" (players) or "vp9" (browsers too; some 50 times slower). Raises
    EV020."""

    fps: float = 30.0
    window_us: int = 33_000
    slow: float = 1.0
    over_frames: bool = False
    scale: int | None = None
    codec: Literal["mpeg4", "vp9"] = "mpeg4"

    def __post_init__(self) -> None:
        for name, low, high in (("fps", 0.1, 240.0), ("window_us", 1, 10**9),
                                ("slow", 1e-3, 1e6), ("scale", 1, 32)):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise EvflowDataError(
                    "EV020", f"{name}={value}.", f"Give a value from {low:g} to {high:g}.")
        if self.codec not in FOURCC:
            raise EvflowDataError("EV020", f"codec={self.codec!r}.", f"Choose {tuple(FOURCC)}.")

    @property
    def step_us(self) -> float:
        """Recorded time from picture to picture."""
        return 1e6 / (self.fps * self.slow)

    def check_target(self, path: Path, *, overwrite: bool) -> None:
        """EV013 where it exists, EV020 where it is neither .mp4, .gif nor .png."""
        if path.suffix.lower() not in SUFFIXES:
            raise EvflowDataError("EV020", f"{path.name} is none of {', '.join(SUFFIXES)}.",
                                  "The ending says what is made.")
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
    count = max(1, math.ceil(recording.events.duration_us / film.step_us))
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    with atomic_write(path, overwrite=overwrite) as temporary, \
            tempfile.TemporaryDirectory(dir=temporary.parent, prefix=".render") as folder:
        made = Path(folder) / f"film{path.suffix.lower()}"
        said = write(made, _pictures(recording, film, count, progress), film, count)
        os.replace(made, temporary)
    return f"{count} pictures, {count / film.fps:.1f} s, {said}"


def write_sheet(
    path: str | os.PathLike, recording: Recording, film: Film, *, at_s: float | None = None,
    overwrite: bool = False,
) -> str:
    """Write a .png of one window: events, and where there are frames the frame and both together.

    at_s: seconds from the first event to the window's middle; None for the busiest. Returns what
    was written, in words. Raises EV001, EV013, EV020 (outside the recording).
    """
    path, events = Path(path), recording.events
    film.check_target(path, overwrite=overwrite)
    _check(recording, film)
    span = (int(events.t[0]), int(events.t[-1]) + 1)
    begin = busiest_instant(events, span, film.window_us)
    if at_s is not None:
        if not 0 <= at_s <= events.duration_us / 1e6:
            raise EvflowDataError("EV020", f"at={at_s} s.", "The recording covers 0 to "
                                  f"{events.duration_us / 1e6:.3f} s from its first event.")
        begin = span[0] + round(1e6 * at_s) - film.window_us // 2
    middle = begin + film.window_us // 2
    shown = event_image(events, begin, begin + film.window_us)
    parts = [shown]
    if recording.has_frames:
        frame = _frame(recording, middle, _white(recording))
        parts = [np.repeat(frame, 3, -1), shown, _over(frame, shown)]
    parts = [_enlarged(part, film.scale) for part in parts]
    gap = np.full((parts[0].shape[0], GAP, 3), 255, np.uint8)
    sheet = np.concatenate([piece for part in parts for piece in (part, gap)][:-1], 1)
    with atomic_write(path, overwrite=overwrite) as temporary:
        Image.fromarray(sheet).save(temporary, "png", optimize=True)
    inside = len(events.slice(begin, begin + film.window_us))
    return (f"{inside:,} events of {film.window_us / 1e3:g} ms around "
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
    start = int(recording.events.t[0])
    white = _white(recording) if film.over_frames else 1.0
    for i in range(count):
        middle = start + round((i + 0.5) * film.step_us)
        begin = middle - film.window_us // 2
        shown = event_image(recording.events, begin, begin + film.window_us)
        if film.over_frames:
            shown = _over(_frame(recording, middle, white), shown)
        yield _enlarged(shown, film.scale)
        if progress:
            progress(i + 1, count)


def _white(recording: Recording) -> float:
    """The DN that is shown as white: what 99.5 % of the pixels of a few frames stay below."""
    some = np.unique(np.linspace(0, len(recording.frames) - 1, 8).astype(int))
    return max(1.0, float(np.percentile([recording.frame_dn(i) for i in some], 99.5)))


def _frame(recording: Recording, at_us: int, white: float) -> np.ndarray:
    """The frame nearest in time, (H, W, 1) in 0..1."""
    nearest = int(np.argmin(np.abs(recording.frame_times - at_us)))
    return np.minimum(recording.frame_dn(nearest)[..., None] / white, 1.0)


def _over(frame: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """An event image on a frame: where there are no events, the frame shows."""
    strength = np.minimum(1.0, 1.5 * (1.0 - shown.min(-1, keepdims=True)))
    return (1 - strength) * frame + strength * shown


def _enlarged(image: np.ndarray, scale: int | None) -> np.ndarray:
    """(H, W, 3) floats as uint8, each pixel scale x scale, the sides even: codecs store colour at
    half the resolution."""
    scale = scale or max(1, round(WIDTH / image.shape[1]))
    pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8).repeat(scale, 0).repeat(scale, 1)
    height, width = pixels.shape[:2]
    return np.pad(pixels, [(0, height % 2), (0, width % 2), (0, 0)], mode="edge")


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], film: Film, count: int) -> str:
    first = next(pictures)
    size = (first.shape[1], first.shape[0])
    fourcc = cv2.VideoWriter.fourcc(*FOURCC[film.codec])
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, film.fps, size)
    if not writer.isOpened():
        raise EvflowDataError("EV019", f"OpenCV {cv2.__version__} does not write {film.codec}.",
                              "Try the other codec, or write a .gif.")
    try:
        writer.write(first[..., ::-1])
        for picture in pictures:
            writer.write(picture[..., ::-1])
    finally:
        writer.release()
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    readable = 0
    while capture.grab():
        readable += 1
    capture.release()
    if readable != count:
        raise EvflowDataError("EV019", f"{readable} of {count} pictures can be read again.",
                              "Is the disk full? Nothing was kept.")
    return f"{size[0]}x{size[1]}, {film.codec}"


def _write_gif(path: Path, pictures: Iterator[np.ndarray], film: Film, count: int) -> str:
    if count > GIF_FRAMES:
        raise EvflowDataError("EV020", f"the GIF would have {count:,} pictures.",
                              f"At most {GIF_FRAMES}: show less (--start, --stop), or .mp4.")
    images = [Image.fromarray(p).quantize(64, dither=Image.Dither.NONE) for p in pictures]
    ticks = max(2, round(1 / (film.fps * GIF_TICK_S)))  # faster ones are slowed down by browsers
    images[0].save(path, save_all=True, append_images=images[1:], loop=0, optimize=False,
                   duration=1000 * ticks * GIF_TICK_S)
    width, height = images[0].size
    return f"{width}x{height}, shown at {1 / (ticks * GIF_TICK_S):.0f} fps"

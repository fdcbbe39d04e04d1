"""Decoded images of one camera as frames in DN, with the user's hints applied.

A source decodes `Image`s in OpenCV's channel order; `converted` turns them, one by one, into frames
of one shape and dtype: uint8 stays as it is, all else becomes float32 on 0..255. Nothing is
clipped.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.regular import need_regular
from evflow.io.decode.units import UNITS_US
from evflow.io.hints import Hints, check_choices, known
from evflow.io.images import values
from evflow.light import response
from evflow.light.colour import (
    COLOURS,
    mosaic_luma,
    mosaic_note,
    parse_pattern,
    seen_note,
)
from evflow.light.ranges import DARKEST_DN, DIM_DN, check_bits, meaning, meaning_of_logs
from evflow.notes import Note

Frames = Iterator[tuple[np.ndarray, int]]

Array = np.ndarray

DOUBTED = 100  # frames


class Image(NamedTuple):
    """pixels (H, W) or (H, W, 1, 3 or 4) in B, G, R(, A); its time in us; its origin for
    messages."""

    pixels: np.ndarray
    time_us: int
    where: str


@dataclasses.dataclass(frozen=True)
class FrameHints:
    """What the user knows about a video.

    fps: frames per second, instead of the file's own times.
    timestamps: a file with one time per frame; time_unit: "s", "ms", "us", "ns", or "auto".
    colour: "luma", or a Bayer pattern: then colour frames stay (H, W, 3), for `colour.mosaic`.
    full_scale: DN of white; None = 255 for uint8 and floats, 65535 for uint16.
    partial: use what can be read of a damaged or truncated file.
    bayer: pattern of the raw mosaic in the frames, which is converted to luma.
    flip: mirror them. response: how they encode light (see `light.response`), or "auto": as is
        usual for their source, see `io.source`.
    background: what transparent images are laid over, "black" or "white".
    start_s, stop_s: frames with start <= time < stop, in seconds from the first; for a recording
        from its first event.
    frames_topic: which image stream of a recording to use (see `Hints`).
    repeated: "keep" or "drop" frames that repeat the one before (`repeats`). picture: the source
        may be a single picture, whose time is not asked for.
    clip: treat values above full_scale as white and negative ones as black, for radiance, which has
        no upper limit, instead of refusing them.
    """

    fps: float | None = None
    timestamps: str | os.PathLike | None = None
    time_unit: str = "auto"
    colour: str = "luma"
    full_scale: float | None = None
    partial: bool = False
    bayer: str | None = None
    flip: str = "none"
    response: str = "linear"
    background: str = "black"
    start_s: float | None = None
    stop_s: float | None = None
    frames_topic: str | None = None
    repeated: str = "keep"
    picture: bool = False
    clip: bool = False

    def __post_init__(self) -> None:
        check_choices(self, time_unit=("auto", *UNITS_US), colour=COLOURS,
                      flip=("none", *response.FLIPS), response=("auto", *response.RESPONSES),
                      background=tuple(values.BACKGROUNDS), repeated=("keep", "drop"))
        Hints(start_s=self.start_s, stop_s=self.stop_s, frames_topic=self.frames_topic)  # EV020
        if self.bayer is not None and parse_pattern(self.bayer) and self.colour != "luma":
            raise EvflowDataError(
                "EV020", f"bayer={self.bayer} converts a mosaic to luma, colour={self.colour} "
                "keeps the mosaic itself.", "Give only one of them.")
        for name in ("fps", "full_scale"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise EvflowDataError("EV020", f"{name}={value}.", "It must be > 0.")
        if self.fps is not None and not 1e-6 <= self.fps <= 1e6:
            raise EvflowDataError("EV020", f"fps={self.fps:g}.", "Times are integer microseconds: "
                                  "give 1e-6 to 1e6.")
        if self.fps is not None and self.timestamps is not None:
            raise EvflowDataError(
                "EV020", f"fps={self.fps:g} and timestamps={self.timestamps} contradict each "
                         "other.",
                "Give only one of them.")

    @staticmethod
    def parse(given: dict[str, Any]) -> FrameHints:
        """Hints from keyword arguments; an unknown one raises EV020."""
        return FrameHints(**known(given, FrameHints, "Videos"))

    def at_rate(self, index: int) -> int:
        """The time of frame `index` in us at `fps`."""
        assert self.fps is not None
        return round(index * 1e6 / self.fps)


@dataclasses.dataclass(frozen=True)
class FrameSource:
    """size (width, height); count: frames expected (0 = unknown); open(): a new iterator of (frame,
    time in us), decoded one at a time. notes: what was assumed; may grow while frames are read.
    recorded: by a camera that also recorded events; exposure_us: of the frames, 0 if it is unknown.
    Frames are (H, W), or (H, W, 3) if a mosaic of colour input was requested, uint8 or float32 DN
    on 0..255."""

    size: tuple[int, int]
    count: int
    open: Callable[[], Frames]
    notes: list[Note] = dataclasses.field(default_factory=list)
    recorded: bool = False
    exposure_us: int = 0

    def watched(self, progress: Callable[[int, int], None]) -> Frames:
        """The frames; progress(done, total) is called after each."""
        for index, pair in enumerate(self.open(), 1):
            yield pair
            progress(index, max(self.count, index))


def converted(images: Iterable[Image], hints: FrameHints, notes: list[Note]) -> Frames:
    """(frame, time in us) from decoded images, one at a time.

    Raises EV002 (shape), EV003 (dtype, values above `full_scale`, floats on 0..1), EV004 (time
    does not advance), EV007 (NaN), EV015 (the size changes); each message names the frame.
    """
    first: tuple[np.ndarray, np.dtype] | None = None
    last, peak, doubt = 0, 0, _Doubt(hints)
    for image in images:
        doubt.look(image)
        frame = _seen(image, hints, notes)
        depth = image.pixels.dtype
        peak = max(peak, int(image.pixels.max(initial=0))) if depth == np.uint16 else peak
        if first is None:
            first = frame, depth
            codes = {note.code for note in notes}  # may include the response already
            codes |= {"frames.linearised"} if "frames.response" in codes else set()
            notes += [n for n in _seen_first(image, frame, hints) if n not in notes and not (
                n.code in ("frames.linearised", "frames.raw") and n.code in codes)]
        elif image.time_us <= last:
            raise EvflowDataError(
                "EV004", f"{image.where} is at {image.time_us} us, the previous frame at {last} "
                         "us.",
                "Frame times must increase: pass --fps, or correct --timestamps.",
                where=image.where)
        if frame.shape[:2] != first[0].shape[:2]:
            raise EvflowDataError(
                "EV015", f"{image.where} is {frame.shape[1]}x{frame.shape[0]}, the first frame "
                f"{first[0].shape[1]}x{first[0].shape[0]}.",
                "All frames must have the same size: remove the others.", where=image.where)
        if depth != first[1] or frame.ndim != first[0].ndim:
            raise EvflowDataError(
                "EV003", f"{image.where} is {'grey' if frame.ndim == 2 else 'colour'} {depth}, the "
                f"first frame {'grey' if first[0].ndim == 2 else 'colour'} {first[1]}.",
                "All frames must have one bit depth and number of channels.", where=image.where)
        last = image.time_us
        yield frame, last
    doubt.settle()
    notes += [note for note in doubt.notes() if note not in notes]
    if hints.full_scale is None:
        check_bits(peak)


class _Doubt:
    """Whether float frames are in DN: refused where none exceeds DARKEST_DN in all, or in the first
    DOUBTED, for a video that fades in from black; noted where none exceeds DIM_DN."""

    def __init__(self, hints: FrameHints) -> None:
        self.dim = hints.full_scale is None  # while no frame exceeds DIM_DN
        self.logs = hints.response == "log"
        self.error: EvflowDataError | None = None
        self.seen, self.peak = 0, 0.0  # DN

    def look(self, image: Image) -> None:
        """Take one more frame into account; EV003."""
        pixels = image.pixels
        if not (self.dim and pixels.dtype.kind == "f" and pixels.size):
            self.dim = False
            return
        high = float(pixels.max())
        self.peak = max(self.peak, float(np.exp(min(high, DIM_DN))) if self.logs else high)
        self.dim = self.peak <= DIM_DN
        if self.peak <= DARKEST_DN and self.error is None and (
                meant := (meaning_of_logs if self.logs else meaning)(pixels)):
            self.error = values.misread(meant, image.where, pixels, 255)
        self.seen += 1
        if self.seen == DOUBTED:
            self.settle()

    def settle(self) -> None:
        """Raise EV003 if no frame was bright."""
        if self.error is not None and self.peak <= DARKEST_DN:
            raise self.error

    def notes(self) -> list[Note]:
        """That all frames are dim, if so."""
        return [Note("frames.depth", f"the frames reach {self.peak:.3g} where white is 255: "
                     f"--full-scale {self.peak:.3g}?")] if self.dim and self.peak > 0 else []


def _seen(image: Image, hints: FrameHints, notes: list[Note]) -> Array:
    """The frame as light."""
    pixels, where = image.pixels, image.where
    if hints.bayer is not None:
        pixels = mosaic_luma(pixels, hints.bayer, where)
    if pixels.ndim == 3 and pixels.shape[-1] == 1:
        pixels = pixels[..., 0]
    if pixels.ndim != 2 and not (pixels.ndim == 3 and pixels.shape[-1] in (3, 4)):
        raise EvflowDataError(
            "EV002", f"{where} has shape {pixels.shape}.", "Expected (H, W) or (H, W, 3).",
            where=where)
    pixels = np.asarray(pixels, np.float32) if pixels.dtype.kind == "f" else pixels
    values.white_of(pixels.dtype, where)
    if hints.clip:
        pixels = np.clip(pixels, 0, np.float32(hints.full_scale or np.inf))
    if pixels.ndim == 3 and pixels.shape[-1] == 4:
        pixels, through = values.opaque(pixels, hints.background)
        if through and not any(note.code == "frames.alpha" for note in notes):
            notes.append(Note("frames.alpha", f"images are partly transparent: laid over "
                              f"{hints.background} (--background black|white)."))
    frame = values.as_dn(np.ascontiguousarray(pixels), where, full_scale=hints.full_scale,
                         response=hints.response, colour=hints.colour)
    return frame if hints.flip == "none" else np.flip(frame, response.FLIPS[hints.flip])


def _seen_first(image: Image, frame: np.ndarray, hints: FrameHints) -> list[Note]:
    """Notes for the user about the first frame."""
    notes = [] if hints.bayer is None else [mosaic_note(hints.bayer)]
    if hints.response != "linear":
        notes.append(response.linearised(hints.response))
    if hints.flip != "none":
        notes.append(response.flipped(hints.flip))
    if hints.colour != "luma" and frame.ndim == 2:
        notes.append(seen_note(hints.colour, colour=False))
    peak = int(image.pixels.max()) if image.pixels.dtype == np.uint16 else 0
    if hints.full_scale is None and 0 < peak < 2**14:
        notes.append(Note("frames.depth", "16-bit frames with white at 65535, but the first one "
                          f"only reaches {peak}; for 10-, 12- or 14-bit data pass --full-scale "
                          "1023, 4095 or 16383."))
    return notes


def existing(path: str | os.PathLike) -> Path:
    """`path`; EV016 if nothing is there, or something that is neither file nor folder."""
    path = Path(path)
    if not os.path.exists(path):  # False, not an error, for an impossible path
        pattern = any(c in path.name for c in "%*?")
        raise EvflowDataError(
            "EV016", f"no file or folder at {path}.",
            "For an image sequence pass its folder." if pattern else "", where=path)
    return need_regular(path)

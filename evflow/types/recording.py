"""`Recording`: events and frames of one camera; `Window`: the part between two frames."""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.checks import (
    check_exposure,
    check_frames,
    check_full_scale,
    check_times,
    need,
    plain,
    read_only,
)
from evflow.errors import EvflowDataError
from evflow.files.spool import forget
from evflow.notes import Note
from evflow.types.events import Events

BIT_DEPTHS = (8, 10, 12, 14, 16)  # of image sensors' converters; a 16-bit file may hold any


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Events and intensity frames of one camera on one clock.

    Attributes:
        events: the events.
        frames: (T, H, W) uint8, uint16 or float32 in DN; T may be 0. Float frames are on 0..255.
        frame_times: (T,) any integer dtype, microseconds, mid-exposure, strictly increasing; kept
            as int64.
        notes: what a reader assumed, left out or converted.
        exposure_us: exposure time of the frames, the median if it changes; 0 if it is unknown.
        full_scale: the DN of a saturated pixel. Of uint8 and float32 frames it is 255; of uint16
            ones the maximum of the smallest converter (8, 10, 12, 14 or 16 bits: 255, 1023, 4095,
            16383, 65535) that covers all frames, unless a higher one is given. Float32 frames
            that nowhere exceed 1 are taken for fractions of white and refused, unless it is given
            as 255. A part of a recording made by `dataclasses.replace` keeps it.

    Raises:
        EvflowDataError: EV002 (shape, or colour), EV003 (dtype, or range of float frames), EV004
            (times do not increase), EV007 (NaN), EV015 (frames and events of different size),
            EV020 (`events` is not an `Events`, `notes` are not `Note`s, the exposure is negative,
            or full_scale no whole number 0..65535).

    Example:
        >>> recording = ef.Recording(events, frames, frame_times)
        >>> recording.frame_dn(0)  # float32, white at 255
    """

    events: Events
    frames: np.ndarray
    frame_times: np.ndarray
    notes: tuple[Note, ...] = ()
    exposure_us: int = 0
    full_scale: int = 0

    def __post_init__(self) -> None:
        need(self.events, Events, "events", "For a path: evflow.read_recording(path).")
        frames, times = (np.asarray(plain(name, getattr(self, name)))
                         for name in ("frames", "frame_times"))
        full_scale = check_full_scale(self.full_scale)
        check_frames(frames, self.events.size, full_scale)
        if times.shape != frames.shape[:1]:
            raise EvflowDataError(
                "EV002", f"frame_times has shape {times.shape} for {len(frames)} frames.",
                "Give one mid-exposure time in microseconds per frame.")
        times = check_times(times, "frame_times", strict=True)
        for note in self.notes:
            need(note, Note, "a note", "For a sentence: evflow.notes.Note(code, sentence).")
        object.__setattr__(self, "exposure_us", check_exposure(self.exposure_us))
        object.__setattr__(self, "full_scale", _white(frames, full_scale))
        object.__setattr__(self, "frames", read_only(frames))
        object.__setattr__(self, "frame_times", read_only(times))

    @staticmethod
    def of_events(events: Events, notes: tuple[Note, ...] = ()) -> Recording:
        """A recording without frames.

        Args:
            events: the recording's events.
            notes: as in `Recording`.

        Returns:
            The recording; its frames are (0, H, W) uint8.

        Raises:
            EvflowDataError: EV020 (`events` is not an `Events`, or `notes` are not `Note`s).
        """
        need(events, Events, "events", "For a recording: recording.events.")
        width, height = events.size
        return Recording(
            events, np.zeros((0, height, width), np.uint8), np.zeros(0, np.int64), notes)

    @property
    def frames_were_made(self) -> bool:
        """Whether a note says that the frames were reconstructed from the events by a network."""
        return any(note.code == "frames.made" for note in self.notes)

    def __repr__(self) -> str:
        frames = f"{len(self.frames)} frames ({self.frames.dtype})"
        return f"{self.events!r}, {frames if self.has_frames else 'no frames'}"

    @property
    def has_frames(self) -> bool:
        """Whether there is at least one frame."""
        return len(self.frames) > 0

    def frame_dn(self, index: int) -> np.ndarray:
        """One frame on the common scale.

        Args:
            index: frame number, 0..T-1.

        Returns:
            float32 (H, W), scaled so that `full_scale` is 255 DN.
        """
        return self.frames[index].astype(np.float32) * np.float32(255 / self.full_scale)


def _white(frames: np.ndarray, given: int) -> int:
    """The DN of a saturated pixel of frames (T, H, W): a converter's, or a higher given one."""
    if frames.dtype != np.uint16 or not len(frames):
        return 255
    peak = max(int(frame.max(initial=0)) for frame in frames)  # one by one: they may be mapped
    return max(given, next(2**bits - 1 for bits in BIT_DEPTHS if peak < 2**bits))


def release(recording: Recording) -> None:
    """Release the pages that were read from a memory-mapped recording."""
    events = recording.events
    forget(events.x, events.y, events.t, events.p, recording.frames)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Window:
    """What a camera saw between two of its frames: the input of one `estimate`.

    Attributes:
        events: those with t0_us <= t < t1_us.
        frame0: float32 (H, W), DN on 0..255, the frame taken at t0_us.
        frame1: float32 (H, W), DN on 0..255, the frame taken at t1_us.
        t0_us: start in microseconds, the mid-exposure of frame0.
        t1_us: end in microseconds, the mid-exposure of frame1.
        index: index among the recording's windows, from 0.
    """

    events: Events
    frame0: np.ndarray
    frame1: np.ndarray
    t0_us: int
    t1_us: int
    index: int

    def __repr__(self) -> str:
        return f"Window({self.index}: {self.events!r}, from {self.t0_us} to {self.t1_us} us)"

    @property
    def window_s(self) -> float:
        """Length in seconds, the `window_s` of `estimate`."""
        return (self.t1_us - self.t0_us) / 1e6

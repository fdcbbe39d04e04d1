"""Intensity from events and frames: the protocol shared by the reconstructing systems.

    Integration().reconstruct(events, frames, frame_times, camera, times) -> DN (T, H, W)

An image at time t knows the events up to and including t and the frames *before* t: read at a
frame's own time it is a prediction of that frame. A system is a frozen dataclass of its options.
Thresholds belong to the logarithm they were measured in, in calibration and here alike. Host side.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterator

import numpy as np

from evflow.camera import Camera
from evflow.checks import check_frames, check_times
from evflow.errors import EvflowDataError
from evflow.light.logarithm import LIN_LOG, Logarithm
from evflow.types import Events


@dataclasses.dataclass(frozen=True)
class Reconstructor(abc.ABC):
    """A system that tracks pixels' brightness by events and frames.

    logarithm: that of the thresholds. start_dn: initial brightness before the first frame.
    """

    logarithm: Logarithm = LIN_LOG
    start_dn: float = 127.5

    @abc.abstractmethod
    def log_images(
        self, events: Events, frames: np.ndarray, frame_times: np.ndarray, camera: Camera,
        times: np.ndarray,
    ) -> np.ndarray:
        """Log intensity (T, H, W) float32 at times (T,), not clipped. Arguments and errors as of
        `reconstruct`."""

    def reconstruct(
        self, events: Events, frames: np.ndarray, frame_times: np.ndarray, camera: Camera,
        times: np.ndarray,
    ) -> np.ndarray:
        """Intensity (T, H, W) float32 in DN, clipped to 0..255 as a frame is.

        frames: (K, H, W) uint8 or float32 DN 0..255, K may be 0; frame_times: (K,) int us, strictly
        increasing; camera: maps (H, W) in the units of `logarithm`; times: (T,) int us,
        non-decreasing. Raises EV002, EV003, EV004, EV007, EV015.
        """
        log = self.log_images(events, frames, frame_times, camera, times)
        return np.clip(np.asarray(self.logarithm.dn(log)), 0.0, 255.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Segment:
    """The time (begin_us, end_us] between two neighbouring frames or images.

    frame: number of the frame at its begin, -1 for none; events: first and last + 1; images:
    numbers of the images at its end.
    """

    begin_us: int
    end_us: int
    frame: int
    events: slice
    images: range


def segments(events: Events, frame_times: np.ndarray, times: np.ndarray) -> Iterator[Segment]:
    """The stream, cut at every frame and every image, in time order."""
    knots = np.unique(np.concatenate([frame_times, times]))
    begin = int(min([*knots[:1], *(events.t[:1] - 1)], default=0))
    cuts = np.searchsorted(events.t, np.append(begin, knots), side="right")
    read = np.searchsorted(times, np.append(knots, np.iinfo(np.int64).max))
    frame = -1
    for i, knot in enumerate(knots):
        yield Segment(begin, int(knot), frame, slice(int(cuts[i]), int(cuts[i + 1])),
                      range(int(read[i]), int(read[i + 1])))
        place = int(np.searchsorted(frame_times, knot))
        frame = place if place < len(frame_times) and frame_times[place] == knot else -1
        begin = int(knot)


def checked(
    events: Events, frames: np.ndarray, frame_times: np.ndarray, camera: Camera, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Validated frames, frame_times, theta (2, H*W) float32 and times; raises as
    `Reconstructor.reconstruct`."""
    width, height = events.size
    frames, frame_times, times = np.asarray(frames), np.asarray(frame_times), np.asarray(times)
    check_frames(frames, events.size)
    if frames.dtype == np.uint16:
        raise EvflowDataError("EV003", "the frames are uint16.", "Give Recording.frame_dn(i), "
                              "float32 DN on 0..255.")
    if frame_times.shape != frames.shape[:1]:
        raise EvflowDataError("EV002", f"frame_times has shape {frame_times.shape} for "
                              f"{len(frames)} frames.", "Give one time in us per frame.")
    if camera.shape != (height, width):
        raise EvflowDataError("EV015", f"the camera's maps are {camera.shape}, the sensor "
                              f"{(height, width)}.", "Both are (height, width).")
    theta = np.stack([np.asarray(m, np.float32).ravel()
                      for m in (camera.validate().theta_on, camera.theta_off)])
    return (frames, check_times(frame_times, "frame_times", strict=True), theta,
            check_times(times, "times", strict=False))


def steps_of(events: Events, part: slice, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel (N,) int64 and log step (N,) float32, +theta_ON or -theta_OFF, of some events."""
    pixel = events.y[part].astype(np.int64) * events.size[0] + events.x[part]
    on = events.p[part]
    return pixel, np.where(on, theta[0, pixel], -theta[1, pixel])

"""Frames from whatever a user points at: a recording with frames, or a video file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.base import read_recording
from evflow.io.video import open_video

Frames = Iterator[tuple[np.ndarray, int]]


@dataclasses.dataclass(frozen=True)
class FrameSource:
    """size (width, height); count: frames expected (0 = unknown); open(): a fresh iterator of
    (frame (H, W), time in us). Frames are uint8 or float32 DN on 0..255."""

    size: tuple[int, int]
    count: int
    open: Callable[[], Frames]

    def watched(self, progress: Callable[[int, int], None]) -> Frames:
        """The frames, with progress(done, total) called after each."""
        for index, pair in enumerate(self.open(), 1):
            yield pair
            progress(index, max(self.count, index))


def open_frames(path: str | os.PathLike, fps: float | None = None) -> FrameSource:
    """The frames of a recording, or of a video file if it is none. Raises EV011 where a
    recording has no frames, and what the readers raise."""
    try:
        recording = read_recording(path)
    except EvflowDataError as e:
        if e.code != "EV008":
            raise
        video = open_video(path, fps)
        return FrameSource(video.size, video.claimed, video.frames)
    if not recording.has_frames:
        raise EvflowDataError("EV011", f"{path} has events but no frames.",
                              "Simulate a recording with frames, or a video.")

    def frames() -> Frames:
        for i, t in enumerate(recording.frame_times.tolist()):
            yield recording.frame_dn(i), t

    return FrameSource(recording.events.size, len(recording.frames), frames)

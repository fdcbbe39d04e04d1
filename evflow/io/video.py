"""Video files through OpenCV: grey frames and their times, one by one."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from evflow.errors import EvflowDataError


@dataclasses.dataclass(frozen=True)
class Video:
    """A video file: size (width, height), fps and the frame count that its header claims."""

    path: Path
    size: tuple[int, int]
    fps: float
    claimed: int

    def frames(self) -> Iterator[tuple[np.ndarray, int]]:
        """(frame (H, W) uint8 luma, time in us) from first to last; EV009 if nothing decodes."""
        capture = cv2.VideoCapture(str(self.path))
        count = 0
        try:
            while True:
                good, frame = capture.read()
                if not good:
                    break
                grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                yield grey, round(count * 1e6 / self.fps)
                count += 1
        finally:
            capture.release()
        if count == 0:
            raise EvflowDataError("EV009", f"no frame of {self.path} can be decoded.")


def open_video(path: str | os.PathLike, fps: float | None = None) -> Video:
    """Open a video; `fps` overrides what the file says. Raises EV008, EV016, EV020."""
    path = Path(path)
    if not path.is_file():
        raise EvflowDataError("EV016", f"no file at {path}.")
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise EvflowDataError(
                "EV008", f"{path} is neither a recording nor a video that OpenCV can open.",
                "Convert it, for example to mp4 (H.264) or avi (MJPG).")
        size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
                int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        rate = fps or capture.get(cv2.CAP_PROP_FPS)
        claimed = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        capture.release()
    if not rate or not rate > 0:
        raise EvflowDataError("EV020", f"{path} states no frame rate.", "Pass --fps.")
    return Video(path, size, float(rate), claimed)

"""Frames from whatever a user points at, one by one: a video file, a folder of images, a NumPy
stack, or a recording with frames."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from evflow.errors import EvflowDataError, naming
from evflow.io.base import find_format, read_recording
from evflow.io.frames import FrameHints, Frames, FrameSource, Image, converted, existing
from evflow.io.images import open_folder
from evflow.io.stacks import is_stack, open_stack


def open_frames(path: str | os.PathLike, **hints: Any) -> FrameSource:
    """The frames of anything, in bounded memory (a recording's are read whole).

    hints: fps, timestamps, time_unit, colour, full_scale, partial (see `FrameHints`).
    Raises EV016 (not there), EV008 (nothing that has frames), EV011 (a recording without
    frames), EV020 (unknown hint; no times), and what the readers raise.
    """
    told, path = FrameHints.parse(hints), existing(path)
    with naming(path):
        return _open(path, told)


def _open(path: Path, told: FrameHints) -> FrameSource:
    if is_stack(path):
        stack = open_stack(path, told)
        return _source(stack.size, len(stack.times_us), lambda: stack.images(told.partial), told,
                       list(stack.notes))
    if not _is_recording(path):
        return _folder(path, told) if path.is_dir() else _video(path, told)
    return _recording(path, told)


def _is_recording(path: Path) -> bool:
    try:
        find_format(path)
    except EvflowDataError as e:
        if e.code != "EV008":
            raise
        return False
    return True


def _folder(path: Path, told: FrameHints) -> FrameSource:
    folder = open_folder(path, told)
    first = next(folder.images()).pixels
    size = first.shape[1], first.shape[0]
    return _source(size, len(folder.files), folder.images, told, list(folder.notes))


def _video(path: Path, told: FrameHints) -> FrameSource:
    from evflow.io.video import open_video

    video = open_video(path, told)
    return _source(video.size, video.claimed, video.images, told, video.notes)


def _recording(path: Path, told: FrameHints) -> FrameSource:
    if told.fps is not None or told.timestamps is not None:
        raise EvflowDataError(
            "EV020", f"{path} is a recording, whose frames have their own times.",
            "Leave out --fps and --timestamps, or pass its images alone.")
    recording = read_recording(path, time_unit=told.time_unit)
    if not recording.has_frames:
        raise EvflowDataError("EV011", f"{path} has events but no frames.",
                              "Simulate a recording with frames, or a video.")
    white = told.full_scale or recording.full_scale
    told = FrameHints(colour=told.colour, full_scale=white)

    def images() -> Iterator[Image]:
        for i, t in enumerate(recording.frame_times.tolist()):
            yield Image(recording.frames[i], t, f"frame {i} of {path}")

    return _source(recording.events.size, len(recording.frames), images, told,
                   list(recording.notes))


def _source(size: tuple[int, int], count: int, images: Any, told: FrameHints,
            notes: list[str]) -> FrameSource:
    def frames() -> Frames:
        return converted(images(), told, notes)

    return FrameSource(size, count, frames, notes)

"""Frames from any source, one by one: a video file, a folder of images, a picture of several
pages, a NumPy stack, or a recording with frames.

With `response` "auto" they are assumed to encode light as usual for their source: videos and 8-bit
images are sRGB; raw mosaics, deeper images, arrays and frames recorded by an event camera are
linear.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError, naming
from evflow.io.images import repeats, values
from evflow.io.images.exposures import exposed_note
from evflow.io.images.folder import RADIANCE, SUFFIXES, ImageFolder, open_folder
from evflow.io.images.frames import FrameHints, Frames, FrameSource, Image, converted, existing
from evflow.io.images.pages import open_pages, pages
from evflow.io.images.stacks import is_stack, open_stack
from evflow.io.registry import find_format, read_recording
from evflow.notes import Note, why_no_frames

OF_EVENTS = ("--size", "--polarity", "--drop-outside", "--events-topic", "--late")


def open_frames(path: str | os.PathLike, **hints: Any) -> FrameSource:
    """The frames of any source, in bounded memory (a recording is read as a whole).

    hints: those of `FrameHints`.
    Raises EV001 (none between start_s and stop_s), EV008 (not a source of frames), EV011 (a
    recording without frames), EV016 (not found), EV020 (unknown hint; no times), and what the
    readers raise.
    """
    asked, path = FrameHints.parse(hints), existing(path)
    with naming(path):
        return _open(path, asked)


def _open(path: Path, asked: FrameHints) -> FrameSource:
    if is_stack(path):
        stack = open_stack(path, asked)
        asked, notes = _responding(asked, "linear", "numbers of a stack")
        return _source(stack.size, len(stack.times_us), lambda: stack.images(asked.partial), asked,
                       [*stack.notes, *notes], stack.exposure_us)
    if (count := pages(path)) > 1:
        found = open_pages(path, count, asked)
        usual = ("srgb", "8-bit images") if found.first.dtype == np.uint8 else (
            "linear", "images of more than 8 bits")
        asked, notes = _responding(asked, *usual)
        return _source(found.first.shape[1::-1], count, found.images, asked,
                       [*found.notes, *notes], found.exposure_us)
    if asked.picture and path.suffix.lower() in SUFFIXES:
        return _of_images(ImageFolder((path,), np.zeros(1, np.int64), ()), asked)
    if not _is_recording(path):
        if asked.frames_topic is not None:
            raise EvflowDataError("EV020", f"{path} is not a recording with image streams.",
                                  "Leave out frames_topic (--frames-topic).", where=path)
        return _folder(path, asked) if path.is_dir() else _video(path, asked)
    return _recording(path, asked)


def _is_recording(path: Path) -> bool:
    try:
        find_format(path)
    except EvflowDataError as e:
        if e.code != "EV008":
            raise
        return False
    return True


def _folder(path: Path, asked: FrameHints) -> FrameSource:
    folder = open_folder(path, asked)
    if (count := pages(folder.files[0])) > 1:
        raise EvflowDataError(
            "EV008", f"{folder.files[0]} holds {count:,} pages, not one image.",
            f"Pass the file itself{'' if len(folder.files) == 1 else ', one by one'}, or a folder "
            "with one image a file.", where=path)
    return _of_images(folder, asked)


def _of_images(folder: ImageFolder, asked: FrameHints) -> FrameSource:
    first = next(folder.images()).pixels
    size = first.shape[1], first.shape[0]
    raw = asked.bayer is not None or (first.ndim == 2 and asked.colour != "luma")
    asked, notes = _responding(
        asked, *(("linear", "pixels of a raw mosaic") if raw else
                ("linear", "images made from events") if folder.notes and any(
                    note.code == "frames.made" for note in folder.notes) else
                ("srgb", "8-bit images") if first.dtype == np.uint8 else
                ("linear", "images of more than 8 bits")))
    if folder.files[0].suffix.lower() in RADIANCE:
        white, note = values.white_of_radiance(first, asked.full_scale)
        asked = dataclasses.replace(asked, full_scale=white, clip=True)
        notes = (*notes, note)
    if asked.full_scale is None and (named := values.white_of_files(folder.files)):
        asked = dataclasses.replace(asked, full_scale=named)
        notes = (*notes, Note("frames.white", f"{named} is white, as the images say (maxval); "
                              "--full-scale sets another value."))
    return _source(size, len(folder.files), folder.images, asked, [*folder.notes, *notes],
                   folder.exposure_us)


def _video(path: Path, asked: FrameHints) -> FrameSource:
    from evflow.io.images.video import open_video

    video = open_video(path, asked)
    asked, notes = _responding(asked, *(("srgb", "videos") if asked.bayer is None else
                                      ("linear", "pixels of a raw mosaic")))
    video.notes.extend(notes)
    return _source(video.size, video.claimed, video.images, asked, video.notes,
                   video.exposure_us)


def _recording(path: Path, asked: FrameHints) -> FrameSource:
    if (asked.fps is not None and not asked.picture) or asked.timestamps is not None:
        raise EvflowDataError(
            "EV020", f"{path} is a recording, whose frames have their own times.",
            "Leave out --fps and --timestamps, or pass only its images.", where=path)
    # Only the frames of the recording are used, so the order of its events does not matter.
    try:
        recording = read_recording(path, time_unit=asked.time_unit, partial=asked.partial,
                                   start_s=asked.start_s, stop_s=asked.stop_s, late="drop",
                                   frames_topic=asked.frames_topic, colour=asked.colour)
    except EvflowDataError as e:
        if not any(option in e.fix for option in OF_EVENTS):
            raise
        raise EvflowDataError(e.code, e.seen, f"{e.fix} These are options of events: evflow "
                              "convert takes them, and what it writes can be simulated.",
                              where=e.where) from e
    if not recording.has_frames:
        raise EvflowDataError(
            "EV011", f"{path} has events but no frames{why_no_frames(recording.notes)}.",
            "Simulate a recording with frames, or a video.", where=path)
    white = asked.full_scale or recording.full_scale
    asked = dataclasses.replace(asked, full_scale=white, start_s=None, stop_s=None)
    asked, notes = _responding(asked, "linear", "a recording's own frames")

    def images() -> Iterator[Image]:
        for i, t in enumerate(recording.frame_times.tolist()):
            yield Image(recording.frames[i], t, f"frame {i} of {path}")

    return dataclasses.replace(
        _source(recording.events.size, len(recording.frames), images, asked,
                [*(n for n in recording.notes if n.code != "events.late"), *notes]),
        recorded=True, exposure_us=recording.exposure_us)


def _responding(asked: FrameHints, usual: str, what: str) -> tuple[FrameHints, tuple[Note, ...]]:
    """The hints with the response chosen if it was "auto", and the note that says so."""
    if asked.response != "auto":
        return asked, ()
    applied = {"srgb": "converted to light by the sRGB curve, the usual encoding of {} "
                       "(--response linear: they are already linear)",
               "linear": "assumed to be linear in light, as usual for {} (--response srgb: they "
                         "are encoded like videos)"}[usual].format(what)
    return (dataclasses.replace(asked, response=usual),
            (Note("frames.response", f"frames were {applied}."),))


def _between(images: Iterator[Image], asked: FrameHints) -> Iterator[Image]:
    """The images from start_s to stop_s after the first; EV001 if there is none."""
    start, stop = (None if s is None else 1e6 * s for s in (asked.start_s, asked.stop_s))
    first = last = None
    count = 0
    for image in images:
        last = image.time_us
        first = last if first is None else first
        if stop is not None and last - first >= stop:
            break
        if start is None or last - first >= start:
            count += 1
            yield image
    if not count and first is not None and last is not None:
        raise EvflowDataError(
            "EV001", f"no frame between {asked.start_s or 0:g} s and "
            f"{'the end' if asked.stop_s is None else f'{asked.stop_s:g} s'} from the first.",
            f"The frames read cover 0 to {(last - first) / 1e6:.3f} s.")


def _source(size: tuple[int, int], count: int, images: Any, asked: FrameHints,
            notes: list[Note], exposure_us: int = 0) -> FrameSource:
    if exposure_us:
        notes.append(exposed_note(exposure_us))

    def shown() -> Frames:
        return converted(_between(images(), asked), asked, notes)

    def frames() -> Frames:
        if asked.repeated == "drop":
            yield from repeats.dropped(shown, notes)
            return
        runs = repeats.Runs()
        yield from runs.watched(shown())
        if note := runs.note():
            notes.append(note)

    return FrameSource(size, count, frames, notes, exposure_us=exposure_us)

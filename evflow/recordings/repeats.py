"""Frames of a recording that repeat the one before while its pixels fire: inserted by a converter,
or by a camera that had no new frame.

The time of a repeat is not the time of its content. Without repeats, a frame has the time of its
first showing; if a converter inserted repeats at regular positions (24 to 30 a second), the frames
in between were evenly spaced before, and are made so again.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.io.images.cadence import evened
from evflow.notes import Note
from evflow.recordings.contradictions import FRAMES
from evflow.types import Recording, release

Array = np.ndarray

NOTED = "frames.repeated"
LONGEST = 4  # times a frame is shown; more, and the scene is static
FIRING_SHARE = 0.01  # of the pixels have events when a frame should have changed
STRIDE = 4  # every 4th pixel of every 4th row is compared first


def repeated_frames(recording: Recording) -> Array:
    """Indices (R,) of frames that equal the one before while pixels fire; frames of a single value
    are never repeats, since any two of them are equal."""
    frames, times = recording.frames, recording.frame_times
    found = []
    for i in range(1, len(frames)):
        if i % FRAMES == 0:
            release(recording)
        if _same_picture(frames[i - 1], frames[i]) and _fires(
                recording, *times[i - 1:i + 1].tolist()):
            found.append(i)
    return np.array(found, int)


def without_repeats(recording: Recording) -> Recording:
    """The recording without frames shown up to LONGEST times, and a note; unchanged if there are
    none, or if its notes say that it was done."""
    if any(note.code == NOTED for note in recording.notes):
        return recording
    found = repeated_frames(recording)
    runs = np.split(found, np.flatnonzero(np.diff(found) > 1) + 1)
    at = np.concatenate([run for run in runs if len(run) < LONGEST] or [found[:0]])
    if not len(at):
        return recording
    kept = np.delete(np.arange(len(recording.frames)), at)
    times = recording.frame_times[kept]
    even = _evenly(recording, kept)
    note = Note(NOTED, f"{len(at)} of {len(recording.frames)} frames repeat the one "
                "before while pixels fire; they are left out"
                + ("" if even is None else "; the others are evenly spaced again") + ".")
    return dataclasses.replace(
        recording, frames=recording.frames[kept], frame_times=times if even is None else even,
        notes=(*recording.notes, note))


def ends_stale(recording: Recording) -> int | None:
    """Time of the last frame in us if it repeats the one before while pixels fire; else None."""
    last = dataclasses.replace(
        recording, frames=recording.frames[-2:], frame_times=recording.frame_times[-2:])
    return int(last.frame_times[-1]) if len(repeated_frames(last)) else None


def _evenly(recording: Recording, kept: Array) -> Array | None:
    """Times (K,) of the kept frames if a converter repeated frames at regular positions, else None
    (`cadence`)."""
    some = recording.frames[:, ::STRIDE, ::STRIDE].astype(np.float32)[kept]
    changes = np.abs(np.diff(some, axis=0)).mean((1, 2))
    return evened(recording.frame_times[kept], changes,
                  float(np.median(np.diff(recording.frame_times))))


def _same_picture(a: Array, b: Array) -> bool:
    some = np.s_[::STRIDE, ::STRIDE]
    return np.array_equal(a[some], b[some]) and np.array_equal(a, b) and bool(np.ptp(a))


def _fires(recording: Recording, t0: int, t1: int) -> bool:
    return bool((recording.events.slice(t0, t1).count_map().sum(0) > 0).mean() > FIRING_SHARE)

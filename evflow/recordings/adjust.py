"""Corrections to a recording: frames from another file, clock offset, mirroring, response curve.

Each function returns a new `Recording` with a note on what was done; events are never changed.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.io.decode.units import too_large
from evflow.io.images.exposures import given_exposure, noted
from evflow.io.images.repeats import REPEATED
from evflow.io.source import open_frames
from evflow.light import response as light
from evflow.light.colour import CELLS, are_luma, as_seen, mosaic_luma, mosaic_note
from evflow.notes import Note
from evflow.recordings.mosaics import LEAST_DN, UNEVEN, planes
from evflow.types import Recording

MARGIN_US = 1_000_000  # frames this far outside the events are kept: their clock may be off


def linearised(recording: Recording, response: str) -> Recording:
    """The recording with frames proportional to light: the camera's tone curve undone.

    Thresholds refer to the log of light. Measured from frames with a gamma of 2.2 they come out 2.2
    times too small.

    Args:
        recording: with frames as they were stored.
        response: "linear" (returned as it is), "gamma" (code = light^(1/2.2)) or "srgb"
            (IEC 61966-2-1).

    Returns:
        A recording with float32 frames on 0..255 DN and a note of what was done.

    Raises:
        EvflowDataError: EV020 (another response).
    """
    if response == "linear":
        return recording
    frames = np.empty(recording.frames.shape, np.float32)
    for i in range(len(frames)):
        frames[i] = light.linear_light(recording.frame_dn(i), response)
    return _changed(recording, light.linearised(response), frames=frames)


def demosaiced(recording: Recording, pattern: str) -> Recording:
    """The recording with frames that are a raw mosaic converted to luma, of the same size and
    dtype. EV020 if they were colour images already; errors of `colour.mosaic_luma`."""
    if are_luma(recording.notes):
        raise EvflowDataError(
            "EV020", "the frames are already luma of colour images, not a "
            f"{pattern.upper()} mosaic.", "Leave out --bayer.")
    frames = np.empty(recording.frames.shape, recording.frames.dtype)
    for i, frame in enumerate(recording.frames):
        frames[i] = mosaic_luma(frame, pattern)
    return _changed(recording, mosaic_note(pattern), frames=frames)


def balanced(recording: Recording) -> Recording:
    """The recording whose frames are a colour mosaic, with its four planes scaled to the median of
    the brightest: motion is followed across them, and what neighbours see is alike. A scale of
    light that stays the same changes no contrast. Frames of one brightness stay as they are."""
    medians = planes(recording)
    if medians.min() < LEAST_DN or medians.max() < UNEVEN * medians.min():
        return recording
    gains = medians.max() / medians
    frames = np.empty(recording.frames.shape, np.float32)
    for i in range(len(frames)):
        frames[i] = recording.frame_dn(i)
        for cell, gain in zip(CELLS, gains, strict=True):
            frames[i][cell] *= gain
    np.minimum(frames, 255.0, out=frames)
    scales = ", ".join(f"{gain:.2f}" for gain in gains)
    note = Note("frames.balanced", "the four planes of the colour mosaic were scaled to one "
                f"brightness (by {scales}, row by row from the top left)")
    return dataclasses.replace(_changed(recording, note, frames=frames), full_scale=255)


def shifted(recording: Recording, offset_us: int) -> Recording:
    """The recording with offset_us added to its frame times."""
    if not offset_us:
        return recording
    moved = Note("frames.moved", f"frame times shifted by {offset_us / 1e3:+g} ms")
    return _changed(recording, moved, frame_times=recording.frame_times + offset_us)


def exposed(recording: Recording, exposure_ms: float) -> Recording:
    """The recording with this exposure of its frames, whatever the file says; EV020 if it is
    negative or longer than the interval between frames."""
    exposure_us, notes = given_exposure(
        exposure_ms, recording.frame_times.tolist(), recording.notes)
    return dataclasses.replace(recording, notes=notes, exposure_us=exposure_us)


def flipped(recording: Recording, side: str) -> Recording:
    """The recording with its frames mirrored: "horizontal", "vertical" or "both"; EV020."""
    if side not in light.FLIPS:
        raise EvflowDataError("EV020", f"side={side!r}.", f"Choose from {sorted(light.FLIPS)}.")
    axes = tuple(1 + axis for axis in light.FLIPS[side])
    return _changed(recording, light.flipped(side), frames=np.flip(recording.frames, axes))


def with_frames(
    recording: Recording, path: str | os.PathLike, *, offset_us: int = 0, **hints: Any
) -> Recording:
    """The recording with the frames of `path` instead of its own: a folder of images, a video, a
    NumPy stack, another recording.

    hints: fps, timestamps, time_unit, full_scale, partial, bayer, colour, as in `open_frames`;
    times are on the events' clock after offset_us is added. Frames more than a second away from all
    events are left out.
    Raises EV012 (no frame near the events), EV015 (another size), and what `open_frames` raises.
    """
    try:
        source = open_frames(path, **hints)
    except EvflowDataError as e:
        raise EvflowDataError(e.code, _reworded(e.seen), _reworded(e.fix), where=e.where) from e
    t = recording.events.t
    if not len(t):
        raise EvflowDataError("EV001", "the recording has no events.")
    if source.size != recording.events.size:
        raise EvflowDataError(
            "EV015", f"frames of {path} are {source.size[0]}x{source.size[1]}, the events "
            f"{recording.events.size[0]}x{recording.events.size[1]}.",
            "Both must come from the same sensor, uncropped.")
    kept, times, seen = [], [], []
    for frame, time in as_seen(source.open(), hints.get("colour", "luma")):
        seen.append(time + offset_us)
        if t[0] - MARGIN_US <= seen[-1] <= t[-1] + MARGIN_US:
            kept.append(frame)
            times.append(seen[-1])
    if not kept:
        large = too_large(np.array(seen, np.int64) - offset_us, t)
        raise EvflowDataError(
            "EV012", f"events cover {t[0]:,}..{t[-1]:,} us but the frames of {path} "
            f"{seen[0]:,}..{seen[-1]:,} us.",
            f"Frame times are {large} the events': pass the unit they are in, --timestamps-unit."
            if large else "Another clock? Pass --frames-offset-ms "
            f"{(int(t[0]) - seen[0] + offset_us) / 1e3:.3f} if both begin together; for another "
            "unit pass --timestamps-unit.")
    notes = (*noted(recording.notes, 0), Note("frames.replaced", f"frames come from {path}"),
             *(Note(note.code, _as_frames(note)) for note in source.notes))
    if left := len(seen) - len(kept):
        notes = (*notes, Note("frames.unused", f"{left:,} of {len(seen):,} frames of {path} lie "
                              "before or after the events, and were left out"))
    return Recording(recording.events, np.stack(kept), np.array(times, np.int64), notes,
                     source.exposure_us, full_scale=255)  # `open_frames` has looked for white


def _reworded(text: str) -> str:
    """Next to a recording, --time-unit is the events', and --fps that of a video to be written."""
    text = text.replace(" with --frames (simulate: --time-unit)", "")
    return text.replace("--time-unit", "--timestamps-unit").replace("--fps", "--frames-fps")


def _as_frames(note: Note) -> str:
    """The text of a note on frames that a video is simulated from, for frames of a recording, with
    the options that there are."""
    if note.code == REPEATED:
        return f"{note.text.partition(':')[0]}: an estimate leaves them out."
    return _reworded(note.text.replace(" (--background black|white)", ""))


def _changed(recording: Recording, note: Note, **fields: Any) -> Recording:
    return dataclasses.replace(recording, notes=(*recording.notes, note), **fields)

"""Frames that do not show what the pixels saw: flashes, black frames, exposure changes.

Frames and events come from different circuits. If only the frame camera stumbles, the change of
brightness between two frames says nothing about thresholds. Flashes and changes of static parts are
found in the frames alone, other faults by comparison with the events.
"""

from __future__ import annotations

import numpy as np

from evflow.recordings.contradictions import FRAMES, contradicted
from evflow.types import Recording, release

DARK_DN, LEAST = 15.0, 0.1  # pixels below are ignored; minimum share of brighter ones
STRIDE = 4  # every 4th pixel of every 4th row is enough for a whole frame's fault
JUMP = 0.15  # log units: more than frame noise
GLITCH_SHARE = 0.3  # of the pixels, all brighter or all darker: fast textures are both
OTHER_SHARE = 0.02
EXPOSURE = 0.08  # log units: change shared by most pixels
ALIKE, ALIKE_SHARE = 0.05, 0.6  # log units, share of pixels
SATURATED_DN, BLACK_DN = 252.0, 0.5  # a frame at either end hides what its pixel saw
ALL_CHANGES = "the whole frame changes by"  # how the reasons for faulty steps begin
LIT_SHARE = 0.3  # of the pixels: more ON than OFF or the reverse, if the light itself changed


def faulty_frames(
    recording: Recording, start_us: int, stop_us: int
) -> tuple[dict[int, str], dict[int, str]]:
    """({frame: fault}, {i: fault of the step from frame i to i + 1}), a short reason each.
    start_us, stop_us: the time that the events cover."""
    frames, intervals = contradicted(recording, start_us, stop_us)
    glitches = dict.fromkeys(frames, "a frame that does not match the events (old, or "
                             "damaged?)")
    steps = dict.fromkeys((i for i in intervals if not _lit(recording, i)),
                          f"{ALL_CHANGES} more than the events account for (auto-exposure?)")
    shown: list[np.ndarray] = []
    for i in range(len(recording.frame_times)):
        if i % FRAMES == 0:
            release(recording)
        small = recording.frame_dn(i)[::STRIDE, ::STRIDE]
        shown = [*shown[-2:], np.log(np.maximum(small, 1.0))]
        if len(shown) == 3 and _glitch(*shown) and not _lit(recording, i - 1):
            glitches[i - 1] = "a frame unlike the one before and the one after (a glitch?)"
        if len(shown) > 1 and (shift := _exposure(*shown[-2:])) and not _lit(recording, i - 1):
            steps[i - 1] = (f"{ALL_CHANGES} {np.expm1(shift):+.0%} without events "
                            "(auto-exposure?)")
    return glitches, steps


def exposed(*frames: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels that are neither saturated nor black in any of the frames (H, W), DN."""
    return np.all([(frame > BLACK_DN) & (frame < SATURATED_DN) for frame in frames], axis=0)


def _glitch(before: np.ndarray, frame: np.ndarray, after: np.ndarray) -> bool:
    """Whether much of the frame is brighter, or darker, than both neighbours, which agree."""
    bright = _bright(before, after)
    there, back = (frame - before)[bright], (frame - after)[bright]
    agree = np.abs(after - before)[bright] < 0.5 * JUMP
    brighter = (agree & (np.minimum(there, back) > JUMP)).sum()
    darker = (agree & (np.maximum(there, back) < -JUMP)).sum()
    most, least = max(brighter, darker), min(brighter, darker)
    return bool(most > max(GLITCH_SHARE * bright.sum(), LEAST * bright.size)
                and least < OTHER_SHARE * bright.size)


def _exposure(before: np.ndarray, after: np.ndarray) -> float:
    """The log change shared by most pixels, 0 if there is none."""
    bright = _bright(before, after)
    if bright.mean() < LEAST:
        return 0.0
    change = (after - before)[bright]
    shift = float(np.median(change))
    alike = (np.abs(change - shift) < ALIKE).mean() > ALIKE_SHARE
    return shift if abs(shift) > EXPOSURE and alike else 0.0


def _bright(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.minimum(a, b) > np.log(DARK_DN)


def _lit(recording: Recording, i: int) -> bool:
    """Whether many pixels fire with one polarity between frames i and i + 1."""
    t0, t1 = (int(t) for t in recording.frame_times[i:i + 2])
    on, off = recording.events.slice(t0, t1).count_map()
    return bool(abs((on > off).mean() - (off > on).mean()) > LIT_SHARE)

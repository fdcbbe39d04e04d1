"""Recordings whose frames are nearer to each other than an estimate can use.

In a shorter interval a pixel sends less than one event, and what decides whether its surroundings
are quiet counts intervals. Of frames 1 ms apart (a simulator's own) noise came out five times too
low, and thresholds with four times the error.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.notes import Note
from evflow.types import Recording

LEAST_US = 10_000  # the shortest interval with which the refinement was trained
TOLERANCE = 0.05  # of it


def thinned(recording: Recording) -> Recording:
    """The recording with every nth frame, LEAST_US apart or more, and a note; unchanged if its
    frames are as far from each other."""
    if len(recording.frame_times) < 3:
        return recording
    interval = max(float(np.median(np.diff(recording.frame_times))), 1.0)
    step = int(np.ceil(LEAST_US / interval - TOLERANCE))
    if step < 2:
        return recording
    frames, times = recording.frames[::step], recording.frame_times[::step]
    if len(times) < 3:
        return recording
    return dataclasses.replace(recording, frames=frames, frame_times=times, notes=(
        *recording.notes, Note(
            "frames.dense", f"frames are {interval / 1e3:.3g} ms apart: {len(times)} of "
            f"{len(recording.frame_times)} are used, as an estimate is better with 10 ms or "
            "more.")))

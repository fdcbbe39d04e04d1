"""Frame times that agree with the events; how long frames take to be read."""

from __future__ import annotations

import numpy as np

from evflow.estimation.refine import plan_runs
from evflow.estimation.refine.frame_timing import UNTIMED, Timing, frame_timing
from evflow.estimation.refine.photoreceptor import receptor_places
from evflow.recordings import adjust
from evflow.recordings.check import frames_offset
from evflow.recordings.dense import thinned
from evflow.recordings.repeats import without_repeats
from evflow.recordings.rolling import Rolling
from evflow.recordings.windows import plan_windows
from evflow.types import Recording

FARTHER_US = (24_000, -24_000, 48_000, -48_000)  # places to look around: `frame_timing` sees 14 ms


def aligned(recording: Recording) -> Recording:
    """The recording, its frame times shifted so that frames and events agree.

    To a fraction of a millisecond where the frames' changes are those of the counts, beside what
    slow pixels explain (`frame_timing`): from 2 to 4 ms on, up to half an interval between frames.
    Else by more than that, where changes of the frames and numbers of events agree best
    (`frames_offset`).

    Args:
        recording: with frames.

    Returns:
        The recording, with a note if it is shifted.
    """
    return adjust.shifted(recording, _late_us(thinned(without_repeats(recording))))


def rolling(recording: Recording) -> Rolling:
    """How the frames are read, if the events show that their rows or columns are not of one time
    (from 5 ms on); else `GLOBAL`.

    Args:
        recording: with frames whose times are right within some ms (`aligned`).

    Returns:
        The time from side to side, and the side that is read first.
    """
    return _timing(thinned(without_repeats(recording))).rolling


def _late_us(recording: Recording) -> int:
    """By how much the events are behind the frames that an estimate uses."""
    here = _timing(recording)
    if here.late.seconds:
        return round(1e6 * here.late.seconds)
    if coarse_us := frames_offset(recording):
        return _nearer(recording, coarse_us)
    if here != UNTIMED or len(recording.frame_times) < 2:
        return 0
    half_us = 0.5 * float(np.median(np.diff(recording.frame_times)))
    for trial_us in FARTHER_US:
        if abs(trial_us) < half_us + abs(FARTHER_US[0]) / 2 and (
                found_us := _nearer(recording, trial_us)) != trial_us:
            return found_us
    return 0


def _nearer(recording: Recording, about_us: int) -> int:
    """The offset near this one at which frames and events agree; the same if that is unknown."""
    return about_us + round(1e6 * _timing(adjust.shifted(recording, about_us)).left_s)


def _timing(recording: Recording) -> Timing:
    """Of the frames of a whole recording."""
    runs = plan_runs(recording, plan_windows(recording).pairs)
    return frame_timing(receptor_places([(recording, run) for run in runs])) if runs else UNTIMED

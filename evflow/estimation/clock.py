"""Frame times that agree with the events."""

from __future__ import annotations

from evflow.estimation.refine import plan_runs
from evflow.estimation.refine.frame_timing import UNTIMED, Timing, frame_timing
from evflow.estimation.refine.photoreceptor import receptor_places
from evflow.recordings import adjust
from evflow.recordings.check import frames_offset
from evflow.recordings.windows import plan_windows
from evflow.types import Recording


def aligned(recording: Recording) -> Recording:
    """The recording, its frame times shifted so that frames and events agree.

    To a fraction of a millisecond where the frames' changes are those of the counts, by up to
    14 ms and if slow pixels do not explain it (`frame_timing`). Else by more than half an interval
    between frames, where changes of the frames and numbers of events agree best (`frames_offset`).

    Args:
        recording: with frames.

    Returns:
        The recording, with a note if it is shifted.
    """
    if late_s := _timing(recording).late.seconds:
        return adjust.shifted(recording, round(1e6 * late_s))
    if not (coarse_us := frames_offset(recording)):
        return recording
    left_s = _timing(adjust.shifted(recording, coarse_us)).delay_s
    return adjust.shifted(recording, coarse_us + round(1e6 * left_s))


def _timing(recording: Recording) -> Timing:
    """Of the frames of a whole recording."""
    runs = plan_runs(recording, plan_windows(recording).pairs)
    return frame_timing(receptor_places([(recording, run) for run in runs])) if runs else UNTIMED

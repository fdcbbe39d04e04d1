"""Where the light of a bench rests, told from frames; and whether they show a bench at all.

Their level alone would do for a screen, but also for much that is none: frames of a slow pan hardly
differ in it. So most pixels must rest where it rests, and step as it steps.
"""

from __future__ import annotations

import itertools

import numpy as np

from evflow.errors import EvflowDataError
from evflow.light.log_maps import lin_log
from evflow.recordings.stillness import smooth
from evflow.types import Recording

STILL = 0.01  # log units between two frames: the screen rests
LEAST_STEP = 0.1  # log units between two rests
MOVING, MOST_MOVING = 0.1, 0.1  # log units, beside the others; of the pixels, within a rest
LEAST_TOGETHER = 0.5  # of the pixels: those that step by half to twice what the median pixel does
FILL_THE_VIEW = ("Steps of light need a screen, or a card, that fills the view, all of it at one "
                 "level and then at another. For a scene that moves leave --protocol out.")


def find_rests(recording: Recording) -> list[tuple[int, int]]:
    """(first, last) frame of each stretch in which the pixels rest, those of one light joined.

    EV011 without frames; EV017 where there are not two, or the scene moves in one.
    """
    if len(recording.frames) < 4:
        raise EvflowDataError("EV011", f"the recording has {len(recording.frames)} frames.",
                              "Record frames too; in Python, rests_us and light take their place.")
    level = np.array([_level(recording.frame_dn(i)) for i in range(len(recording.frames))])
    still = np.abs(np.diff(level)) < STILL
    found: list[tuple[int, int]] = []
    for resting, group in itertools.groupby(range(len(still)), key=lambda i: bool(still[i])):
        part = list(group)
        if not resting:
            continue
        first, last = part[0], part[-1] + 1
        before = level[found[-1][0]:found[-1][1] + 1].mean() if found else np.inf
        if abs(level[first:last + 1].mean() - before) < LEAST_STEP:
            found[-1] = (found[-1][0], last)
        else:
            found.append((first, last))
    if len(found) < 2:
        raise EvflowDataError("EV017", f"the light rests at {len(found)} levels.",
                              "A step needs two, of two frames each and 10 % apart.")
    for first, last in found:
        _check_rest(recording, first, last)
    return found


def _level(dn: np.ndarray) -> float:
    """Log intensity of a frame (H, W): the mean of its middle half, which half of the pixels may
    disturb, and which moves less than the median where grey levels are few."""
    log = np.sort(np.asarray(lin_log(dn)), axis=None)
    return float(log[len(log) // 4:len(log) - len(log) // 4].mean())


def _check_rest(recording: Recording, first: int, last: int) -> None:
    begin = smooth(recording.frame_dn(first))

    def moving(i: int) -> float:
        off = smooth(recording.frame_dn(i)) - begin
        return float((np.abs(off - np.median(off)) > MOVING).mean())  # a lamp may settle

    share = max(moving(i) for i in range(first + 1, last + 1))
    if share > MOST_MOVING:
        raise EvflowDataError(
            "EV017", f"the scene moves while the light rests (frames {first} to {last}): "
            f"{share:.0%} of the pixels change.", FILL_THE_VIEW)


def check_steps(levels: np.ndarray) -> None:
    """EV017 where most pixels do not step together; levels (K+1, H, W) log intensity at rests."""
    for k, step in enumerate(np.diff(levels, axis=0)):
        median = float(np.median(step))
        together = float((np.abs(step - 1.25 * median) <= 0.75 * abs(median)).mean())
        if not median or together < LEAST_TOGETHER:
            raise EvflowDataError(
                "EV017", f"step {k + 1} of {len(levels) - 1} is none of the whole view: the median "
                f"pixel changes by {median:+.2f} log units, and {together:.0%} of the pixels by "
                "half to twice that.", FILL_THE_VIEW)

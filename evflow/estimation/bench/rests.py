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
LOOKED, ROWS = 400, 32  # frames, and rows of them, that tell a bench at a glance
LEAST_RESTS, LEAST_RESTING = 3, 0.7  # of a bench: rests, and the share of its frames in them
FILL_THE_VIEW = ("Steps of light need a screen, or a card, that fills the view, all of it at one "
                 "level and then at another. For a scene that moves leave --protocol out.")


def find_rests(recording: Recording) -> list[tuple[int, int]]:
    """(first, last) frame of each stretch in which the pixels rest, those of one light joined.

    EV011 without frames; EV017 where there are not two, or the scene moves in one.
    """
    if len(recording.frames) < 4:
        raise EvflowDataError("EV011", f"the recording has {len(recording.frames)} frames.",
                              "Record frames too; in Python, rests_us and light take their place.")
    found = _rests(np.array([
        _level(recording.frame_dn(i)) for i in range(len(recording.frames))]))
    if len(found) < 2:
        raise EvflowDataError("EV017", f"the light rests at {len(found)} levels.",
                              "A step needs two, of two frames each and 10 % apart.")
    for first, last in found:
        _check_rest(recording, first, last)
    return found


def steps_of_light(recording: Recording) -> int:
    """How many times the light of the whole view steps in the first LOOKED frames, as on a bench;
    0 in an ordinary scene. Looks at few pixels."""
    scale, stride = np.float32(255 / recording.full_scale), max(1, recording.events.size[1] // ROWS)
    some = [frame.astype(np.float32) * scale
            for frame in recording.frames[:LOOKED, ::stride, ::stride]]
    light = np.array([np.median(dn) for dn in some])
    if len(light) < 4 or light.max() <= light.min() * np.exp(LEAST_STEP):
        return 0
    found = _rests(np.array([_level(dn) for dn in some]))
    resting = sum(last - first + 1 for first, last in found)
    if len(found) < LEAST_RESTS or resting < LEAST_RESTING * len(some):
        return 0
    try:
        check_steps(np.stack([np.asarray(lin_log(np.mean(some[first:last + 1], 0)))
                              for first, last in found]))
    except EvflowDataError:
        return 0
    moves = max(_moving(smooth(some[first]), some[last]) for first, last in found) > MOST_MOVING
    return 0 if moves else len(found) - 1


def _rests(level: np.ndarray) -> list[tuple[int, int]]:
    """(first, last) frame of each stretch in which the levels (T,) rest, those of one light
    joined."""
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
    return found


def _level(dn: np.ndarray) -> float:
    """Log intensity of a frame (H, W): the mean of its middle half, which half of the pixels may
    disturb, and which moves less than the median where grey levels are few."""
    log = np.sort(np.asarray(lin_log(dn)), axis=None)
    return float(log[len(log) // 4:len(log) - len(log) // 4].mean())


def _check_rest(recording: Recording, first: int, last: int) -> None:
    begin = smooth(recording.frame_dn(first))
    share = max(_moving(begin, recording.frame_dn(i)) for i in range(first + 1, last + 1))
    if share > MOST_MOVING:
        raise EvflowDataError(
            "EV017", f"the scene moves while the light rests (frames {first} to {last}): "
            f"{share:.0%} of the pixels change.", FILL_THE_VIEW)


def _moving(begin: np.ndarray, dn: np.ndarray) -> float:
    """The share of the pixels that change from a smoothed frame to one in DN, (H, W) both, beside
    the others: a lamp may settle."""
    off = smooth(dn) - begin
    return float((np.abs(off - np.median(off)) > MOVING).mean())


def check_steps(levels: np.ndarray) -> None:
    """EV017 where most pixels do not step together; levels (K+1, H, W) log intensity at rests."""
    for k, step in enumerate(np.diff(levels, axis=0)):
        median = float(np.median(step))
        together = float((np.abs(step - 1.25 * median) <= 0.75 * abs(median)).mean())
        if not median or together < LEAST_TOGETHER:
            raise EvflowDataError(
                "EV017", f"step {k + 1} of {len(levels) - 1} does not fill the view: the median "
                f"pixel changes by {median:+.2f} log units, and {together:.0%} of the pixels by "
                "half to twice that.", FILL_THE_VIEW)

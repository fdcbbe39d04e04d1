"""Detection of a bench in frames: whether its light steps, and when it rests.

The mean level alone would find a screen's rests, but also accept other scenes, such as a slow pan.
So most pixels must rest when the level rests, and step when it steps.
"""

from __future__ import annotations

import itertools

import numpy as np

from evflow.errors import EvflowDataError
from evflow.light.log_maps import lin_log
from evflow.notes import Note
from evflow.recordings.stillness import smooth
from evflow.types import Events, Recording

STILL = 0.01  # log units between two frames: the screen rests
LEAST_STEP = 0.1  # log units between two rests
MOVING, MOST_MOVING = 0.1, 0.1  # log units against the median pixel; share of pixels in a rest
LEAST_TOGETHER = 0.5  # share of pixels that step by half to twice the median pixel's change
LOOKED, ROWS = 400, 32  # frames, and rows of them, that are checked
LEAST_RESTS, LEAST_RESTING = 3, 0.7  # rests of a bench, and share of its frames in them
BEFORE_US, EDGE_US = 10_000, 50_000  # longest part of a light's edge before its trigger, and after
FILL_THE_VIEW = ("Steps of light need a screen, or a card, that fills the view, all of it at one "
                 "level and then at another. For a scene that moves leave --protocol out.")


def find_rests(recording: Recording) -> list[tuple[int, int]]:
    """Rests of the light; consecutive rests at one level are joined.

    Returns:
        (first, last) frame of each.

    Raises:
        EvflowDataError: EV011 without frames; EV017 with fewer than two rests, or where the scene
            moves within one.
    """
    if len(recording.frames) < 4:
        raise EvflowDataError("EV011", f"the recording has {len(recording.frames)} frames.",
                              "They show when the light rests: record them too, or pass --frames; "
                              "or give its edges, --triggers FILE, and the light of each rest, "
                              "--lux.")
    found = _rests(np.array([
        _level(recording.frame_dn(i)) for i in range(len(recording.frames))]))
    if len(found) < 2:
        raise EvflowDataError("EV017", f"the light rests at {len(found)} levels.",
                              "A step needs two, of two frames each and 10 % apart.")
    for first, last in found:
        _check_rest(recording, first, last)
    return found


def bench_note(recording: Recording) -> Note | None:
    """A note that recommends --protocol step, if the recording looks like one of a bench."""
    steps = steps_of_light(recording)
    return Note("scene.steps", f"the light of the whole view changes in steps ({steps} in the "
                "first frames) and is constant in between: --protocol step measures such a "
                "recording better, without estimating motion.") if steps else None


def steps_of_light(recording: Recording) -> int:
    """Number of steps of light in the first LOOKED frames of a bench; 0 for an ordinary scene.
    Reads every few rows and columns only."""
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


def rests_between(edges_us: np.ndarray, events: Events, count: int) -> list[tuple[int, int]]:
    """The rests (begin, end) in us between the light's edges (N,), which begin up to BEFORE_US
    earlier, as a photodiode says half-way up, and last up to EDGE_US; edges closer together are
    one, those before the events none. Raises EV020 if there are not `count`."""
    last = int(events.t[-1])
    found = np.unique(edges_us)
    found = found[found > int(events.t[0]) - EDGE_US]
    found = found[np.diff(found, prepend=-np.inf) > BEFORE_US + EDGE_US]
    # Without noise the last event may be a step's, and come before its trigger.
    late = found[found < last + BEFORE_US].tolist()
    edges = late if count == len(late) + 1 else found[found < last].tolist()
    first = min([int(events.t[0]), *(e - EDGE_US for e in edges)])
    last = max([last, *(e + 2 * EDGE_US for e in edges)])
    if count != len(edges) + 1:
        raise EvflowDataError(
            "EV020", f"{count} values of lux, {len(edges)} edges of light until the last event.",
            f"Without frames, give the light of each of the {len(edges) + 1} rests, in order of "
            "time.")
    return list(zip([first, *(e + EDGE_US for e in edges)], [*(e - BEFORE_US for e in edges), last],
                    strict=True))


def _rests(level: np.ndarray) -> list[tuple[int, int]]:
    """(first, last) frame of each rest of the levels (T,); consecutive ones at one level joined."""
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
    """Log intensity of a frame (H, W): the mean between its quartiles, robust against half of the
    pixels and, unlike the median, smooth where grey levels are few."""
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
    """Share of the pixels that change, relative to the median pixel (a lamp may settle), from a
    smoothed frame to one in DN, both (H, W)."""
    off = smooth(dn) - begin
    return float((np.abs(off - np.median(off)) > MOVING).mean())


def check_steps(levels: np.ndarray) -> None:
    """Raise EV017 where most pixels do not step together. levels: (K+1, H, W) log intensity at
    rests."""
    for k, step in enumerate(np.diff(levels, axis=0)):
        median = float(np.median(step))
        together = float((np.abs(step - 1.25 * median) <= 0.75 * abs(median)).mean())
        if not median or together < LEAST_TOGETHER:
            raise EvflowDataError(
                "EV017", f"step {k + 1} of {len(levels) - 1} does not fill the view: the median "
                f"pixel changes by {median:+.2f} log units, and {together:.0%} of the pixels by "
                "half to twice that.", FILL_THE_VIEW)

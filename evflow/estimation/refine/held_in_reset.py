"""Pixels whose amplifier is held in reset for their dead time, and begin anew at its end.

Between two events of such a pixel the path changes by a threshold since the end of the dead time,
else since the event before. These changes from event to event, unlike a pixel's sums, do not add up
the path's errors over its events, so that they tell a dead time that few intervals come near.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.fine_steps import later
from evflow.estimation.refine.receptor_data import Sample, one_stretch
from evflow.estimation.refine.receptor_noise import path_of, split_at_noise
from evflow.simulator.photoreceptor import Photoreceptor

Array = np.ndarray

# A pixel that begins anew needs a threshold's worth of change after its dead time, which is
# therefore a part of its shortest intervals, but never all of them.
PARTS = np.linspace(0.0, 1.0, 11)
FREEDOM = 3.0  # of Student's t: noise, and what the path misses, are far off
STEPS = 20  # of its fit
ENOUGH = 100  # changes of each direction
LEAST = 1e-6  # log units, of the fit's scale
CLEAR = 1e-3  # weight below which an event has waited for the dead time, or is beside black frames


class Anew(NamedTuple):
    """A dead time, (2,) thresholds of pixels that begin anew at its end and of those that keep
    their contrast, the gain of log likelihood per event, and the photoreceptor."""

    dead_s: float
    theta: Array
    kept: Array
    gain: float
    seen_by: Photoreceptor


def held_in_reset(data: Sample, ways: list[Photoreceptor], shortest_s: float) -> Anew | None:
    """The dead time of pixels that begin anew at its end.

    Args:
        data: the sample in which the photoreceptor was searched for.
        ways: photoreceptors that are to be tried.
        shortest_s: a pixel's shortest usual intervals, in seconds.

    Returns:
        The dead time that makes the events most likely, and how much more than if contrast is kept,
        each with the better photoreceptor; None if that is at an end of its range, or with too few
        events that follow one another without noise between them.
    """
    fits = [_fits(data, seen_by, shortest_s * PARTS) for seen_by in ways]
    if not all(fits):
        return None
    best = int(np.argmin([min(fit.loss for fit in row) for row in fits]))
    row = fits[best]
    loss = np.array([fit.loss for fit in row])
    at = int(np.argmin(loss))
    if not 0 < at < len(PARTS) - 1:
        return None
    before, here, after = loss[at - 1:at + 2]
    part = PARTS[at] + 0.5 * PARTS[1] * (before - after) / (before - 2 * here + after)
    kept = min(other[0].loss for other in fits)
    return Anew(float(part) * shortest_s, row[at].theta, row[0].theta, kept - here, ways[best])


class _Fit(NamedTuple):
    loss: float
    theta: Array


def _fits(data: Sample, seen_by: Photoreceptor, dead_s: Array) -> list[_Fit]:
    """Thresholds for each dead time, and the mean negative log likelihood of the changes; nothing
    with too few of them."""
    data = split_at_noise(data, seen_by)
    rows = [_changes(one_stretch(data, c), seen_by, dead_s) for c in range(len(data.dn))]
    rose = np.concatenate([on for _, on in rows])
    if min(rose.sum(), (~rose).sum()) < ENOUGH:
        return []
    return [_fit(change, rose) for change in np.concatenate([row for row, _ in rows], 1)]


def _changes(d: Sample, seen_by: Photoreceptor, dead_s: Array) -> tuple[Array, Array]:
    """(K, M) change of the path of one stretch from the end of each dead time after an event to the
    pixel's next one, positive in that event's direction; and (M,) whether that is ON."""
    path = path_of(d, seen_by)
    used = np.flatnonzero(d.weight > 0)
    pixel, group, on, clear = d.pixel[used], d.group[used], d.on[used], d.weight[used] > CLEAR
    at = np.minimum(later(d.at[used], d.dt_s, -seen_by.delay_s), len(path) - 1 - 1e-3)
    pair = np.flatnonzero((np.diff(group) == 0) & clear[1:] & clear[:-1])
    rose = on[pair + 1] > on[pair]

    def light(when: Array) -> Array:
        step = when.astype(np.int64)
        low, high = path[step, pixel[pair]], path[step + 1, pixel[pair]]
        return low + (when - step) * (high - low)

    first, then = at[pair], at[pair + 1]
    end = light(then)
    rows = np.stack([end - light(np.minimum(later(first, d.dt_s, seconds), then))
                     for seconds in dead_s])
    return np.where(rose, rows, -rows), np.asarray(rose)


def _fit(change: Array, rose: Array) -> _Fit:
    """Student's t of one scale about a threshold for each polarity."""
    theta = np.array([np.median(change[rose]), np.median(change[~rose])])
    scale = max(float(np.median(np.abs(change - np.where(rose, *theta)))), LEAST)
    for _ in range(STEPS):
        away = (change - np.where(rose, *theta)) / scale
        weight = (FREEDOM + 1) / (FREEDOM + away**2)
        theta = np.array([np.average(change[side], weights=weight[side]) for side in (rose, ~rose)])
        scale = max(float(np.sqrt(np.mean(weight * (change - np.where(rose, *theta)) ** 2))), LEAST)
    away = (change - np.where(rose, *theta)) / scale
    likely = 0.5 * (FREEDOM + 1) * np.log1p(away**2 / FREEDOM)
    return _Fit(float(np.log(scale) + likely.mean()), theta)

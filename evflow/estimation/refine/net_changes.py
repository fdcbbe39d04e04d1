"""The light that frames lack, from what the events add up to between frames: no path is needed.

Whatever the brightness did between two frames, a pixel's events carry its change, but for what the
memory left over: theta_on times its ON less theta_off times its OFF events is about one function of
the change of log light, the same in the dark and where it is bright. Of the wrong offset the
changes of dark pixels are too large or too small, and the function is none. So the offset is the
one by which the change foretells the events best. A path that misses what moves does not matter
here; what a slow pixel has not yet seen does, and differs with the time between the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.estimation.refine.sightings import Sightings
from evflow.light.log_maps import log64

Array = np.ndarray

LAGS = (2, 4)  # frame intervals of a change
CHANGES = 4000  # of a stretch and a lag that are looked at
DARK_DN, BRIGHT_DN = 4.0, 230.0  # frames that are darker may be cut off; brighter, what pixels see
LEAST_DN = 3.0  # of change: whether there are events must not matter
OFFSETS = np.array([*np.arange(-24.0, 30.0, 3.0), *np.arange(30.0, 61.0, 6.0)])  # DN
RATIOS = np.exp(np.linspace(np.log(0.4), np.log(2.5), 13))  # theta_off / theta_on
BINS = 40  # of the change
ENOUGH = 1000  # changes
LEAST_SEEN = 100_000  # pixels times intervals. Of fewer the edges are too few and alike: of 60
# recordings of 64x64 pixels and 8 intervals half were told 17 DN or more, most by 2 DN of scatter
FLOOR_DN, SHARE, WIDER = 2.0, 0.35, 1.5  # of the std: of any, of the offset, and of the scatter's
MOST_LEFT = 0.95  # of the squares: more, and changes foretell no events
TOO_FAR = 20.0  # DN of std: nothing is told


class Changes(NamedTuple):
    """Of pixels between two frames, arrays (N,): before, after: DN; on, off: their events; block:
    of the image, whose errors are independent."""

    before: Array
    after: Array
    on: Array
    off: Array
    block: Array


def changes(dn: Array, s: Sightings, block: Array, rng: np.random.Generator) -> tuple[Changes, ...]:
    """Those of each of LAGS in a stretch, of some pixels that are shown. dn: (K + 1, H, W) frames
    less their noise; block: (H * W,)."""
    intervals, pixels = s.inner.shape
    place = (s.interval * pixels + s.pixel, s.on)
    sums = [np.concatenate([np.zeros((1, pixels), int), np.bincount(
        place[0][place[1] == on], minlength=intervals * pixels).reshape(intervals, -1).cumsum(0)])
        for on in (True, False)]
    light, found = dn.reshape(len(dn), -1), []
    for lag in LAGS:
        first = np.arange(0, max(intervals + 1 - lag, 0), lag // 2)
        before, after = light[first], light[first + lag]
        on, off = (n[first + lag] - n[first] for n in sums)
        used = ((np.minimum(before, after) > DARK_DN) & (np.maximum(before, after) < BRIGHT_DN)
                & (np.abs(after - before) > LEAST_DN)
                & s.seen[first] & s.seen[first + lag])
        which = np.flatnonzero(used)
        if len(which) > CHANGES:
            which = np.sort(rng.choice(which, CHANGES, replace=False))
        columns = (before, after, on, off, np.broadcast_to(block, used.shape))
        found.append(Changes(*(np.ravel(c)[which] for c in columns)))
    return tuple(found)


def joined(of_stretches: Sequence[tuple[Changes, ...]]) -> tuple[Changes, ...]:
    """Of each lag, those of all stretches."""
    return tuple(Changes(*(np.concatenate(c) for c in zip(*some, strict=True)))
                 for some in zip(*of_stretches, strict=True))


def offset_by_changes(of_lags: tuple[Changes, ...], seen: int) -> tuple[float, float]:
    """The offset (DN) that the changes of each of LAGS tell, and its std were it nought (that of
    another has SHARE of it besides); an infinite one where they tell nothing. seen: pixels times
    intervals that the changes are of."""
    told = [_best(c) for c in of_lags if len(c.on) >= ENOUGH] if seen >= LEAST_SEEN else []
    if len(told) < len(LAGS):
        return 0.0, float("inf")
    offsets, scatter = np.array(told).T
    std = float(np.sqrt(FLOOR_DN**2 + (WIDER * scatter.max()) ** 2 + np.ptp(offsets) ** 2))
    return (float(offsets.mean()), std) if std < TOO_FAR else (0.0, float("inf"))


def _best(c: Changes) -> tuple[float, float]:
    """The offset of the best of OFFSETS and its neighbours, and its scatter over the blocks."""
    left = np.array([_unexplained(c, offset) for offset in OFFSETS])
    value = np.log(left.sum(1))
    k = int(np.clip(np.argmin(value), 1, len(OFFSETS) - 2))
    if left[k].sum() > MOST_LEFT:
        return float(OFFSETS[k]), float("inf")
    near = slice(k - 1, k + 2)
    bent, slope, _ = np.polyfit(OFFSETS[near] - OFFSETS[k], value[near], 2)
    if bent <= 0.0:
        return float(OFFSETS[k]), float("inf")
    rise = (left[k + 1] - left[k - 1]) / (OFFSETS[k + 1] - OFFSETS[k - 1]) / left[k].sum()
    scatter = float(np.sqrt(((rise - rise.mean()) ** 2).sum()))
    best = OFFSETS[k] + np.clip(-slope / (2 * bent), OFFSETS[k - 1] - OFFSETS[k],
                                OFFSETS[k + 1] - OFFSETS[k])
    return float(best), scatter / (2 * bent)


def _unexplained(c: Changes, offset: float) -> Array:
    """Squares (blocks,) of the events' sum that the change leaves, a line in each of BINS, as a
    share of all of them, at the ratio of the thresholds that leaves least."""
    before, after = (log64(np.maximum(dn + offset, 0.0), "linlog") for dn in (c.before, c.after))
    y = after - before
    weight = 1.0 / (1.0 + np.minimum(c.on, c.off))  # there and back: the thresholds' mismatch adds
    order = np.argsort(y, kind="stable")
    share = np.cumsum(weight[order])
    part = np.empty(len(y), int)
    part[order] = np.minimum(share * (BINS / share[-1]), BINS - 1).astype(int)

    def centred(v: Array) -> Array:
        return v - (np.bincount(part, weight * v, BINS) / mass)[part]

    mass = np.maximum(np.bincount(part, weight, BINS), 1e-9)
    y = centred(y)
    square = np.maximum(np.bincount(part, weight * y * y, BINS), 1e-9)
    on, off = (n - (np.bincount(part, weight * n * y, BINS) / square)[part] * y
               for n in (centred(c.on), centred(c.off)))
    whole = [n - np.average(n, weights=weight) for n in (c.on, c.off)]
    shares = [(weight * (on - r * off) ** 2).sum() / (weight * (whole[0] - r * whole[1]) ** 2).sum()
              for r in RATIOS]
    r = RATIOS[int(np.argmin(shares))]
    left = np.bincount(c.block, weight * (on - r * off) ** 2)
    return np.asarray(left * (min(shares) / max(float(left.sum()), 1e-9)))

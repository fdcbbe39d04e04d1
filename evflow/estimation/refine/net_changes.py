"""The offset of the frames (light that they lack), from net event counts between frames.

No path is needed. Between two frames a pixel's events sum to its change, up to a remainder in the
memory: theta_on times its ON minus theta_off times its OFF events is one function of the change of
log light, in dark and bright pixels alike. With a wrong offset the changes of dark pixels are too
large or too small, and there is no single function. So the estimated offset is the one at which the
change predicts the events best. Errors of the path have no effect here. The lag of a slow pixel
has, and depends on the time between the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evflow.camera.sensors import LogMap
from evflow.estimation.refine.sightings import Sightings
from evflow.light.log_maps import log64

Array = np.ndarray

LAGS = (2, 4)  # frame intervals of a change
CHANGES = 4000  # used of a stretch and a lag
DARK_DN, BRIGHT_DN = 4.0, 230.0  # darker frames may be clipped, brighter ones saturated
LEAST_DN = 3.0  # of change; a selection by events would bias the result
OFFSETS = np.array([*np.arange(-24.0, 30.0, 3.0), *np.arange(30.0, 61.0, 6.0)])  # DN
RATIOS = np.exp(np.linspace(np.log(0.4), np.log(2.5), 13))  # theta_off / theta_on
BINS = 40  # of the change
ENOUGH = 1000  # changes
LEAST_SEEN = 100_000  # pixels times intervals. Smaller recordings show too few, similar edges: in
# half of 60 recordings of 64x64 pixels and 8 intervals the offset was 17 DN or more, most with a
# scatter of only 2 DN
FLOOR_DN, SHARE, WIDER = 2.0, 0.35, 1.5  # std: its minimum, share of the offset, times the scatter
MOST_LEFT = 0.95  # share of squares left above which changes do not predict the events
TOO_FAR = 20.0  # DN of std, from which the offset counts as undetermined


class Changes(NamedTuple):
    """Pixels between two frames, arrays (N,). before, after: DN; on, off: event counts; block: of
    the image (errors of different blocks are independent)."""

    before: Array
    after: Array
    on: Array
    off: Array
    block: Array


def changes(
    dn: Array, s: Sightings, block: Array, hot: Array, rng: np.random.Generator
) -> tuple[Changes, ...]:
    """Changes of a stretch for each of LAGS, of at most CHANGES random visible pixels. dn: (K + 1,
    H, W) denoised frames; block, hot: (H * W,)."""
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
        which = which[~hot[which % len(hot)]]
        columns = (before, after, on, off, np.broadcast_to(block, used.shape))
        found.append(Changes(*(np.ravel(c)[which] for c in columns)))
    return tuple(found)


def joined(of_stretches: Sequence[tuple[Changes, ...]]) -> tuple[Changes, ...]:
    """Changes of all stretches, for each lag."""
    return tuple(Changes(*(np.concatenate(c) for c in zip(*some, strict=True)))
                 for some in zip(*of_stretches, strict=True))


def offset_by_changes(
    of_lags: tuple[Changes, ...], seen: int, log_map: LogMap = "linlog"
) -> tuple[float, float]:
    """The offset of the frames.

    Args:
        of_lags: changes for each of LAGS.
        seen: pixels times intervals from which the changes were taken.
        log_map: of the pixels.

    Returns:
        Offset in DN, and the std that it would have if it were 0 (Prior.offset_std adds SHARE of
        the offset); 0 and infinity where it is undetermined.
    """
    if seen < LEAST_SEEN or any(len(c.on) < ENOUGH for c in of_lags):
        return 0.0, float("inf")
    found = [_best(c, log_map) for c in of_lags]
    offsets, scatter = np.array(found).T
    std = float(np.sqrt(FLOOR_DN**2 + (WIDER * scatter.max()) ** 2 + np.ptp(offsets) ** 2))
    return (float(offsets.mean()), std) if std < TOO_FAR else (0.0, float("inf"))


def _best(c: Changes, log_map: LogMap) -> tuple[float, float]:
    """The best offset, by a parabola through the best of OFFSETS and its neighbours, and its
    scatter over the blocks."""
    left = np.array([_unexplained(c, offset, log_map) for offset in OFFSETS])
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


def _unexplained(c: Changes, offset: float, log_map: LogMap) -> Array:
    """Squared residuals (blocks,) of the net events after regression on the change (a line in each
    of BINS), as a share of the total, at the best of RATIOS."""
    before, after = (log64(np.maximum(dn + offset, 0.0), log_map) for dn in (c.before, c.after))
    y = after - before
    weight = 1.0 / (1.0 + np.minimum(c.on, c.off))  # pairs of ON and OFF add mismatch errors
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

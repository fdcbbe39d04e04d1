"""Frames whose clock runs at another rate than that of the events, or that come in reverse."""

from __future__ import annotations

import numpy as np

from evflow.recordings.check.findings import Finding
from evflow.recordings.check.steps import Steps

PARTS = 6
AGREES = 0.35  # least r of a part at its best offset
LEAST_PARTS = 3
LEAST_DRIFT_US = 10_000
SCATTER = 0.2  # of the drift: the most by which offsets lie off a straight line
LOST = 0.5  # of a part's best r: it does not agree
FAINT, BETTER = 0.3, 0.1  # least r backwards, and its gain


def drifting(steps: Steps) -> Finding | None:
    """EV024 if the offset at which events and frames agree best grows steadily."""
    found = [(float(steps.bounds[part].mean()), *steps.peak(r), r) for part in steps.parts(PARTS)
             if np.nanmax(r := np.nan_to_num(steps.sweep(part), nan=-1.0)) > AGREES]
    if len(found) < LEAST_PARTS:
        return None
    times, offsets, best = (np.array([f[i] for f in found]) for i in range(3))
    slope, level = np.polyfit(times - times[0], offsets, 1)
    length = float(steps.bounds[-1, 1] - steps.bounds[0, 0])
    off = np.abs(offsets - level - slope * (times - times[0])).max()
    drift = abs(slope) * length
    if drift < max(steps.interval_us / 4, LEAST_DRIFT_US) or off > SCATTER * drift:
        return None
    here = np.array([f[3][len(f[3]) // 2] for f in found])
    fps = 1e6 / steps.interval_us
    return Finding(
        "EV024", "error" if (here < LOST * best).mean() > 0.5 else "warning",
        f"the frames' times run {abs(slope):.1%} too {'slow' if slope > 0 else 'fast'}: they are "
        f"{-offsets[0] / 1e3:+.0f} ms off around {(times[0] - steps.events.t[0]) / 1e6:.2f} s and "
        f"{-offsets[-1] / 1e3:+.0f} ms around {(times[-1] - steps.events.t[0]) / 1e6:.2f} s.",
        f"Were they made from a nominal rate? Pass the camera's own (--timestamps), or a rate of "
        f"about {fps / (1 + slope):.4g} (--frames-fps) instead of {fps:.4g} per second.")


def backwards(steps: Steps, otherwise: float) -> Finding | None:
    """EV024 if frames in reverse order agree with the events better than in any other way, of which
    the best has r of `otherwise`."""
    r = steps.backwards().correlation()
    if not r > max(FAINT, otherwise + BETTER):
        return None
    return Finding(
        "EV024", "error", f"events and frames agree only if the last frame comes first (r "
        f"{steps.correlation():+.2f} -> {r:+.2f}).",
        "The frames are in reverse order: were their files sorted the other way? Reverse them, "
        "then check again.")

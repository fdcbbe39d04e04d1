"""Does anything move? Decided from a recording's events and frames.

Noise events are independent, events of a moving edge come together: nearby pixels send the same
polarity within milliseconds. Given the number of events in each cell of pixels, independent noise
makes pairs within a time bin at a known rate, by that of the whole sensor second by second; the
excess over it, per event, shows whether anything moved.
Measured: .016 in 2 s of a static scene (DVXplorer), .13 to 15 in nine recordings with motion.
"""

from __future__ import annotations

import cv2
import numpy as np

from evflow.recordings.faulty_pixels import hot_at_rest
from evflow.types import Events, Recording

CELL, BIN_US = 8, 2_000  # pixels, us: what counts as near by
DRIFT_BINS = 500  # a second
MOVING = 0.05  # excess pairs per event
LEAST_US, LEAST_EVENTS = 500_000, 1_000
MOST_EVENTS = 4_000_000  # used to count pairs: the first ones
MOST_HOT, MOST_SCATTERED = 0.01, 0.1  # of the pixels: faults anywhere, or scattered at random
STILL = 0.1  # log units: allowed change of frames, averaged over 9x9 pixels
SMOOTH, DARK_DN = 9, 15.0


def stands_still(recording: Recording) -> bool:
    """Whether neither frames nor events of a recording show motion, and there are enough events to
    decide. Then every event is noise, and counting them is the best estimate: on static scenes its
    error is a third of the network's."""
    events = recording.events
    if events.duration_us < LEAST_US:
        return False
    first = smooth(recording.frame_dn(0))
    if any((np.abs(smooth(recording.frame_dn(i)) - first) > STILL).any()
           for i in range(1, len(recording.frame_times))):
        return False
    return not unlike_noise(events, hot_at_rest(events.count_map().sum(0)))


def unlike_noise(events: Events, hot: np.ndarray) -> str:
    """Why events are not the noise of a static scene, given its hot (H, W) pixels, or are too few
    to decide; empty if nothing speaks against it."""
    if events.duration_us < LEAST_US or len(events) < LEAST_EVENTS:
        return (f"there are only {len(events):,} events in {events.duration_us / 1e6:.3f} s, too "
                f"few to decide (at least {LEAST_EVENTS:,} in {LEAST_US / 1e6:g} s).")
    excess = coincidence_excess(events, hot)
    if excess > MOVING:
        return (f"the scene moves ({excess:.2f} pairs of nearby events per event beyond chance; "
                f"noise has at most {MOVING}).")
    share = float(hot.mean())
    if share > MOST_SCATTERED or (share > MOST_HOT and clustered(hot)):
        return (f"{share:.1%} of the pixels are far busier than the others, more than the "
                f"{MOST_HOT:.0%} that can be faults if adjacent and the {MOST_SCATTERED:.0%} if "
                "scattered: flickering light, or something small that moves?")
    return ""


def clustered(hot: np.ndarray) -> bool:
    """Whether hot (H, W) pixels are adjacent more often than pixels picked at random."""
    pairs = int((hot[1:] & hot[:-1]).sum() + (hot[:, 1:] & hot[:, :-1]).sum())
    chance = float(hot.mean()) ** 2 * (hot[1:].size + hot[:, 1:].size)
    return pairs > chance + 5.0 * np.sqrt(chance) + 3.0


def smooth(frame: np.ndarray) -> np.ndarray:
    """Log intensity (H, W) with the frame's noise averaged out, ignoring nearly black pixels."""
    return np.log(np.maximum(cv2.blur(frame, (SMOOTH, SMOOTH)), DARK_DN))


def coincidence_excess(events: Events, hot: np.ndarray) -> float:
    """Pairs of events of one polarity, from different pixels of a cell and within a time bin, in
    excess of independent noise, per event; hot (H, W) pixels are left out."""
    events = events.slice(int(events.t[0]), int(events.t[min(len(events), MOST_EVENTS) - 1]) + 1)
    kept = ~hot[events.y, events.x]
    x, y, t = (getattr(events, n)[kept].astype(np.int64) for n in ("x", "y", "t"))
    on, width = events.p[kept], events.size[0]
    moment = (t - int(events.t[0])) // BIN_US
    bins = events.duration_us // BIN_US + 1
    cell = 2 * (y // CELL * -(-width // CELL) + x // CELL) + on
    pixel = 2 * (y * width + x) + on
    seen = _squares(cell * bins + moment) - _squares(pixel * bins + moment)
    expected = sum((_squares(cell[side]) - _squares(pixel[side])) * _chance(moment[side], bins)
                   for side in (on, ~on) if side.any())
    return float((seen - expected) / max(len(t), 1))


def _chance(moment: np.ndarray, bins: int) -> float:
    """Probability that two independent events lie in one of the time bins, given those (N,) of all
    events: noise that rises or falls over seconds, as where the sensor warms up, is noise."""
    counts = np.bincount(moment // DRIFT_BINS, minlength=-(-bins // DRIFT_BINS))
    lengths = np.minimum(DRIFT_BINS, bins - DRIFT_BINS * np.arange(len(counts)))
    return float((counts / len(moment)) ** 2 @ (1.0 / lengths))


def _squares(key: np.ndarray) -> float:
    """Sum of the squared number of occurrences of each value."""
    counts = np.unique(key, return_counts=True)[1].astype(np.float64)
    return float(counts @ counts)

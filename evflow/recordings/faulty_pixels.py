"""Pixels that do not measure the scene: hot ones fire without a signal, dead ones never fire, alone
or as whole columns and rows (a region of interest, a mask, a broken readout).

One rule identifies a hot pixel: it sends several times the expected number of events, and more than
chance allows (`fires_alone`). Expected is the noise while nothing happens (`hot_pixels`, from
`quiet` times), the mean of the other pixels of a static scene (`hot_at_rest`), or the neighbours'
events if the scene may move (`hot_among_neighbours`). NumPy and OpenCV only.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

HOT_FACTOR, HOT_EVENTS = 3.0, 3.0  # noise rates differ by some tens of per cent between pixels
LEAST_HZ = 0.1  # noise rate that is taken where less was seen
AROUND = 5  # pixels: side of the neighbourhood of a pixel
PASSES = 10
MOVING_FACTOR = 10.0  # edges and thresholds make neighbours differ more than noise rates do
RESTLESS = 1.5  # times the expected noise of neighbours: more means that edges passed
LEAST_FIRED, LASTING = 2, 0.75  # quiet times with events, and their share of the expected ones
TWICE = 2.0  # times the events of the neighbours: more than thresholds alone explain
OWN_SHARE = 0.5  # minimum excess over the neighbours, relative to what its quiet rate predicts
MANY_FIRED = 4  # quiet times with events: an edge is not missed so often
QUIET_NEAR = 8.0  # times its own quiet time: that of a neighbourhood that can show rest
MOST_HOT_NEAR = 2  # hot pixels in a neighbourhood, including itself
# Silent pixels side by side; those of a column beside them that fire, and their share: so many
# silent ones come by chance with a probability of .5^40.
LEAST_SILENT, LEAST_BUSY, MOSTLY = 40, 8, 0.5
# Of a static scene: share of the pixels that fired, and the events that the quietest of them sent,
# at a mean above 12.
QUIETEST, LEAST_FIRED_AT_REST = 0.01, 6
DEAD_EVENTS = 12  # median of the neighbourhood: chance e^-12, with room for a high threshold


def fires_alone(
    events: np.ndarray, expected: np.ndarray | float, factor: float = HOT_FACTOR
) -> np.ndarray:
    """Where events exceed `factor` times the expected number by more than chance."""
    most = factor * np.asarray(expected)
    return events > most + 5.0 * np.sqrt(most) + HOT_EVENTS


def hot_pixels(
    quiet: np.ndarray, rate_hz: float, counts: np.ndarray | None = None, seconds: float = 0.0
) -> np.ndarray:
    """(H, W) bool: pixels that fire far more often than rate_hz (both polarities) while nothing
    happens in front of them; less than one in a million by chance. quiet (4, H, W): events, seconds
    and number of such times, and how many of them had events. counts (H, W): events of the whole
    recording, over the given seconds.

    Faults are scattered: if several pixels of a neighbourhood are busy, or its other pixels send
    more than noise too, something moved that the frames do not show, such as an edge that passed
    between two of them. There, only a pixel that fires in most quiet times is a fault. Where things
    move quiet times are rare: there it must fire in most of them while the others rest, or send
    more events in all than any neighbour, by what its rate predicts.
    """
    events, seconds_quiet, times, fired = quiet
    expected = rate_hz * seconds_quiet
    busy = fires_alone(events, expected)
    others, noise = _around(np.where(busy, 0.0, events)), _around(np.where(busy, 0.0, expected))
    at_rest = others <= _restless(noise)
    steady = times * -np.expm1(-events / np.maximum(times, 1))  # expected times with events
    lasting = (fired >= LEAST_FIRED) & (fired >= LASTING * steady)
    hot: np.ndarray = busy & (_around(busy) <= MOST_HOT_NEAR) & (at_rest | lasting)
    if counts is None:
        return hot
    own = OWN_SHARE * seconds * events / np.maximum(seconds_quiet, 1e-9)
    usual = _median_around(counts)
    stands_out = (counts - _most_of_others(counts, hot) >= own) & (counts > TWICE * usual)
    # Whether neighbours can show rest, and whether it fires while they do: in slow scenes all fire
    # in quiet times.
    near = _around(seconds_quiet)
    comparable = near >= QUIET_NEAR * seconds_quiet
    alone = events > _restless(others / np.maximum(near, 1e-9) * seconds_quiet)
    return hot & ((usual <= _restless(rate_hz * seconds)) | stands_out
                  | (lasting & comparable & (at_rest | (alone & (fired >= MANY_FIRED)))))


def hot_in_stretch(quiet: np.ndarray, counts: np.ndarray, seconds: float) -> np.ndarray:
    """`hot_pixels` of a short stretch by itself, whose noise rate is not yet known. Arguments as
    there, of that stretch."""
    rate_hz = float(quiet[0].sum()) / max(float(quiet[1].sum()), 1e-9)
    return hot_pixels(quiet, max(rate_hz, LEAST_HZ), counts, seconds)


def _restless(noise: Any) -> Any:
    """Number of events, given the expected `noise`, above which edges must have passed."""
    return RESTLESS * noise + 2.0 * np.sqrt(RESTLESS * noise)


def hot_at_rest(counts: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels far above the mean of the others, in a static scene."""
    hot = np.zeros(counts.shape, bool)
    for _ in range(PASSES):  # hot pixels raise the mean they are compared with
        more = fires_alone(counts, float(counts[~hot].mean()))
        if (more == hot).all():
            break
        hot = more
    return hot


def hot_among_neighbours(counts: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels far above the median of their neighbourhood, in any scene. If that is 0,
    one event is expected, since few events come in clumps."""
    return fires_alone(counts, np.maximum(_median_around(counts), 1.0), MOVING_FACTOR)


def dead_pixels(n_events: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels without a single event amid pixels with many, or in columns and rows
    without any beside ones whose pixels mostly fire; n_events (H, W)."""
    alone = (n_events == 0) & (_median_around(n_events) >= DEAD_EVENTS)
    return alone | silent_lines(n_events)


def dead_at_rest(n_events: np.ndarray) -> np.ndarray:
    """`dead_pixels` of a static scene, in which even the quietest pixels fire after long enough:
    silent areas are dead too, if most pixels are not."""
    fired = n_events[n_events > 0]
    lowest = float(np.quantile(fired, QUIETEST)) if len(fired) > MOSTLY * n_events.size else 0.0
    return dead_pixels(n_events) | ((n_events == 0) & (lowest >= LEAST_FIRED_AT_REST))


def silent_lines(n_events: np.ndarray) -> np.ndarray:
    """(H, W) bool: columns and rows without a single event beside ones whose pixels mostly fire, as
    outside a region of interest; n_events (H, W)."""
    fired = n_events > 0
    return _silent_columns(fired) | _silent_columns(fired.T).T


def _silent_columns(fired: np.ndarray) -> np.ndarray:
    """(H, W) bool: the columns in which nothing fired, of LEAST_SILENT pixels or more side by side,
    if of each column next to them most of the rows that fire anywhere did. Where a scene ends
    instead, its edge passes few pixels of a column."""
    rows, silent = max(int(fired.any(1).sum()), 1), np.logical_not(fired.any(0))
    busy = fired.sum(0) >= max(MOSTLY * rows, LEAST_BUSY)
    found = np.zeros(fired.shape, bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], silent, [False]]).astype(int)))
    for begin, end in edges.reshape(-1, 2):
        beside = [i for i in (begin - 1, end) if 0 <= i < len(silent)]
        if (end - begin) * rows >= LEAST_SILENT and beside and busy[beside].all():
            found[:, begin:end] = True
    return found


def _most_of_others(counts: np.ndarray, hot: np.ndarray) -> np.ndarray:
    """The largest number of events (H, W) that a neighbour of each pixel has sent, without itself
    and hot ones."""
    others = np.ones((AROUND, AROUND), np.uint8)
    others[AROUND // 2, AROUND // 2] = 0
    return cv2.dilate(np.where(hot, 0, counts).astype(np.float32), others)


def _around(values: np.ndarray) -> np.ndarray:
    """Sums over the neighbourhood (H, W) of each pixel, itself included."""
    return cv2.boxFilter(values.astype(np.float32), -1, (AROUND, AROUND), normalize=False,
                         borderType=cv2.BORDER_CONSTANT)


def _median_around(counts: np.ndarray) -> np.ndarray:
    """Medians over the neighbourhood (H, W) of each pixel, itself included."""
    return cv2.medianBlur(counts.astype(np.float32), AROUND)

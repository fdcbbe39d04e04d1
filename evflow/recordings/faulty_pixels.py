"""Pixels that do not measure the scene: hot ones fire by themselves, dead ones never."""

from __future__ import annotations

import cv2
import numpy as np

HOT_FACTOR, HOT_EVENTS = 3.0, 3.0  # noise rates differ by some tens of per cent between pixels
AROUND = 5  # pixels: side of the neighbourhood that a dead pixel is compared with
RESTLESS = 1.5  # times the noise that neighbours are expected to send: more, and edges went by
LEAST_FIRED, LASTING = 2, 0.75  # times with events, and their share of those expected
MOST_HOT_NEAR = 2  # hot pixels in a neighbourhood, itself included
DEAD_EVENTS = 12  # median there: e^-12 by chance alone, and room for a high threshold


def hot_pixels(quiet: np.ndarray, rate_hz: float) -> np.ndarray:
    """(H, W) bool: pixels that fire far more often than rate_hz (both polarities) while nothing
    happens in front of them; less than one in a million by chance. quiet (4, H, W): events,
    seconds and number of such times, and how many of these had events.

    Faults are scattered: where several pixels of a neighbourhood are busy, or the others there
    send more than noise too, something moved that the frames do not show, such as an edge that
    went by between two of them. There only what fires at most times is a fault.
    """
    events, seconds, times, fired = quiet
    expected = rate_hz * seconds
    busy = fires_alone(events, expected)
    others, noise = _around(np.where(busy, 0.0, events)), _around(np.where(busy, 0.0, expected))
    at_rest = others <= RESTLESS * noise + 2.0 * np.sqrt(RESTLESS * noise)
    steady = times * -np.expm1(-events / np.maximum(times, 1))  # times with events, at its own rate
    lasting = (fired >= LEAST_FIRED) & (fired >= LASTING * steady)
    return busy & (_around(busy) <= MOST_HOT_NEAR) & (at_rest | lasting)


def _around(values: np.ndarray) -> np.ndarray:
    """Sums over the neighbourhood (H, W) of each pixel, itself included."""
    return cv2.boxFilter(values.astype(np.float32), -1, (AROUND, AROUND), normalize=False,
                         borderType=cv2.BORDER_CONSTANT)


def fires_alone(events: np.ndarray, expected: np.ndarray | float) -> np.ndarray:
    """Where events exceed what a pixel's noise is expected to send, and by chance."""
    most = HOT_FACTOR * np.asarray(expected)
    return events > most + 5.0 * np.sqrt(most) + HOT_EVENTS


def dead_pixels(n_events: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels without a single event amid pixels with many; n_events (H, W)."""
    around = cv2.medianBlur(np.minimum(n_events, 255).astype(np.uint8), AROUND)
    return (n_events == 0) & (around >= DEAD_EVENTS)

"""Noise where the light of the whole scene drifts: events of rested pixels.

A pixel whose light has changed by less than a threshold since its own last event has no cause for
another: what it sends is noise, whatever the light does. The frames show that change, and events
when it began. Which pixels have rested depends on the past alone, so that their noise is sampled
without bias. There are fewer of them than quiet ones, which a slow drift of the light makes fire
like noise: so they are asked only where the frames drift, and believed where they send fewer events
by what that drift explains. An auto-exposure changes frames, but causes no events.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

Array = np.ndarray

REACH = 0.5  # of a threshold: what the light of a rested pixel may have changed
LEAST_THETA = 0.1  # log units: that of usable cameras, where the threshold is undetermined
STEADY = 0.05  # log units: change of a pixel in a window, beyond which something moves there
TILES, ALIKE = (4, 4), 4.0  # of the view, and standard deviations of their mean from 0, in a block
BLOCK_S = 1.0  # the light's ups and downs are added over such times: noise of frames averages out
LEAST_SHARE = 0.15  # of the noise: fewer events by drift are not looked for
LESS, UNLIKE = 3.0, 0.05  # standard deviations by which rested pixels must send fewer events, and
# the error, relative, of what others lead to expect
# Their lack of events, over drift per threshold: .2 to 1.3 in simulations. It depends on where
# memories began, on noise that resets them, and on what was not taken for noise.
EXPLAINED = (0.1, 2.0)
ERROR = 0.1  # relative, of the noise of rested pixels, by residual signal among it


class Rested:
    """Which pixels have rested, window by window."""

    def __init__(self, shape: tuple[int, int], reach: Array) -> None:
        """reach: (2,) log units, ON and OFF: what their light may have risen, and fallen."""
        self._reach = reach
        self._low, self._high = np.full((2, *shape), np.nan, np.float32)
        self._end_us = -1

    def add(self, span_us: tuple[int, int], light: Array, counts: Array) -> Array:
        """(2, H, W) bool, for ON and OFF: pixels that rest during a window. light: (2, H, W) log
        intensity of the frames at its ends; counts: (2, H, W) its events."""
        smooth = [cv2.blur(np.ascontiguousarray(f, np.float32), (3, 3)) for f in light]
        low, high = np.minimum(*smooth), np.maximum(*smooth)
        if span_us[0] != self._end_us:
            self._low[:] = self._high[:] = np.nan
        self._end_us = span_us[1]
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)
        found = np.stack([high - self._low < self._reach[0], self._high - low < self._reach[1]])
        fired = counts.any(0)
        self._low[fired], self._high[fired] = low[fired], high[fired]
        return found


class Drift:
    """How much the light of the scene changes, window by window."""

    def __init__(self) -> None:
        self._moved = np.zeros(2)  # log units, up and down
        self._block, self._block_s = np.zeros(TILES), 0.0
        self.seconds = 0.0

    def add(self, change: Array, shown: Array, seconds: float) -> float:
        """Add a window's change (H, W) of log intensity, of pixels that are shown (H, W); returns
        the mean of those that hardly change."""
        steady = shown & (np.abs(change) < STEADY)
        counts, sums = (_by_tile(v) for v in (steady, np.where(steady, change, 0.0)))
        self._block += sums / np.maximum(counts, 1)
        self._block_s += seconds
        self.seconds += seconds
        if self._block_s >= BLOCK_S:
            self._moved += self._open()
            self._block, self._block_s = np.zeros(TILES), 0.0
        return float(sums.sum() / max(counts.sum(), 1))

    def _open(self) -> Array:
        """(2,) of the block: light changes alike all over the view, what moves does not."""
        common, apart = self._block.mean(), self._block.std(ddof=1) / np.sqrt(self._block.size)
        return np.maximum([common, -common], 0.0) * (abs(common) > ALIKE * apart)

    @property
    def per_second(self) -> Array:
        """(2,) log units per second, risen and fallen."""
        return np.asarray((self._moved + self._open()) / max(self.seconds, 1e-9))


def _by_tile(values: Array) -> Array:
    """Sums (TILES) of values (H, W)."""
    rows, columns = (np.linspace(0, n, k, endpoint=False).astype(int)
                     for n, k in zip(values.shape, TILES, strict=True))
    return np.add.reduceat(np.add.reduceat(values.astype(np.float64), rows, 0), columns, 1)


@dataclasses.dataclass(frozen=True, eq=False)
class Noise:
    """Noise of rested pixels, (2,) each, ON and OFF. hz, std_hz: its rate; less: whether that is
    less than all quiet pixels send, by about as much as drift causes."""

    hz: Array
    std_hz: Array
    less: Array


def worth_a_look(eta: Array, due: Array) -> bool:
    """Whether drift causes much of the noise eta (2,) in Hz, if all of it is taken for noise. due:
    (2,) Hz, `Drift.per_second` over the thresholds."""
    return bool((due > LEAST_SHARE * eta).any())


def noise_at_rest(eta: Array, due: Array, events: Array, seconds: Array) -> Noise:
    """From the events (2,) of rested pixels, and the seconds (2,) for which they were observed;
    eta, due: as of `worth_a_look`."""
    expected, hz = eta * seconds, (events + 0.5) / np.maximum(seconds, 1e-9)
    missing = eta - hz
    sure = expected - events > LESS * np.hypot(np.sqrt(expected), UNLIKE * expected)
    low, high = EXPLAINED
    return Noise(hz, hz * np.hypot((events + 0.5) ** -0.5, ERROR),
                 sure & (missing > low * due) & (missing < high * due))

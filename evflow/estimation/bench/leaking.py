"""Leak on a bench: ON events at rests after the light rose, which rests after a fall do not show.

A leaking memory sinks until it is an ON threshold below the light. After a rise a pixel is anywhere
on that way, and leak events come at their mean rate from the first moment. After a fall it is above
the light, and they begin later than a period, 1 / leak_hz. All other noise comes after both. What
leaked until a step brings its ON events forward, and pixels send more of them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.types import Events

Array = np.ndarray
Span = tuple[int, int]

SURE = 3.0  # standard deviations
PART = 0.5  # of the mean time between noise events: later leak comes after falls too
LATE = 0.9  # periods of leak that a fall delays: half of one, and as much by theta_OFF
# Relative error: pixels that a small rise after a fall leaves without an event leak later. Of
# benches with .1 to .5 Hz, beside up to as much other noise.
UNEVEN = 0.15
LEAST_EVENTS = 50.0  # OFF events at rest, for the other noise by direction


@dataclasses.dataclass(frozen=True)
class Leaking:
    """hz, std_hz: leak of a pixel, 0 and NaN where none shows; noise_hz: the other ON noise."""

    hz: float = 0.0
    std_hz: float = float("nan")
    noise_hz: float = 0.0

    @property
    def share(self) -> float:
        """Of the ON noise."""
        return self.hz / (self.hz + self.noise_hz) if self.hz else 0.0

    def watched(self, seconds: Array, up: Array) -> float:
        """Seconds in which ON noise comes at its mean rate. seconds: (K + 1,) of the rests, the
        first of which may follow on either direction; up: (K,) steps."""
        if not self.hz:
            return float(seconds.sum())
        without = np.concatenate([[0.5], ~up]) @ np.minimum(seconds, LATE / self.hz)
        return float(seconds.sum() - self.share * without)

    def brought_forward(
        self, seconds: Array, since: Array, rests: Array, *, stores: bool
    ) -> Array:
        """(K, H, W) ON events that leak before the steps adds to them, less those that it has sent
        at rest, if they count.

        Args:
            seconds: (K,) of the rests before the steps.
            since: (K, H, W) seconds from a pixel's last event at these to their end.
            rests: (K, 2, H, W) events at these.
            stores: whether noise resets the memory, and counting begins anew.
        """
        if stores:
            return self.hz * since
        return self.hz * seconds[:, None, None] - self.share * rests[:, 0]

    def theta_error(self, since: Array, counts: Array, theta: Array) -> Array:
        """(2,) relative errors of the thresholds theta (2,) by that of the leak, which a fall must
        make up for as well. counts: (K, 2, H, W) events of the steps; since: as of
        `brought_forward`."""
        if not self.hz:
            return np.zeros(2)
        sent = np.maximum(counts.sum((0, 2, 3)), 1.0)
        return np.asarray(self.std_hz * since.sum() / sent * theta[0] / theta)


NO_LEAK = Leaking()


def measured_leaking(events: Events, quiet: list[Span], up: Array, kept: Array) -> Leaking:
    """The leak that the rests show.

    Args:
        events: of the recording.
        quiet: the K + 1 spans in which events are noise.
        up: (K,) bool, steps between them that rise.
        kept: (H, W) bool, pixels that count.
    """
    if up.all() or not up.any():
        return NO_LEAK
    spans = quiet[1:]
    sent = np.array([events.slice(*span).count_map()[:, kept].sum() for span in spans], float)
    watched_us = np.array([b - a for a, b in spans]) * max(int(kept.sum()), 1)
    rate = max(sent[side].sum() / max(watched_us[side].sum(), 1) for side in (up, ~up))
    part_us = PART / max(rate, 1e-12)
    return _by_direction(events, [(a, int(min(b, a + part_us))) for a, b in spans], up, kept)


def _by_direction(events: Events, spans: list[Span], up: Array, kept: Array) -> Leaking:
    """The leak by the rests (K) after steps up and down."""
    sent = np.array([events.slice(*span).count_map()[:, kept].sum(1) for span in spans], float)
    seconds = np.array([b - a for a, b in spans]) * 1e-6 * max(int(kept.sum()), 1)
    (risen, off_risen), (fallen, off_fallen) = (sent[side].sum(0) for side in (up, ~up))
    watched, unmoved = seconds[up].sum(), seconds[~up].sum()
    if min(watched, unmoved) <= 0.0:
        return NO_LEAK
    noise_hz, other, unsure = fallen / unmoved, 1.0, 0.0
    if max(off_risen, off_fallen) >= LEAST_EVENTS:
        # Noise that differs with the direction, as by light, does so for OFF events too.
        off = np.array([off_risen + 1.0, off_fallen + 1.0])
        ratio = abs(np.log(off[0] / watched / (off[1] / unmoved)))
        unsure = float(np.sqrt((1.0 / off).sum()))
        other = float(np.exp(max(ratio - unsure, 0.0)))
    # A step that pixels, or the light, still follow at rest goes on in OFF events after falls.
    following = off_fallen / unmoved - off_risen / watched
    follow_std = np.sqrt(off_fallen / unmoved**2 + off_risen / watched**2)
    hz = risen / watched - other * noise_hz - max(following - follow_std, 0.0)
    std_hz = np.sqrt((risen + 1.0) / watched**2 + (fallen + 1.0) * (other / unmoved) ** 2
                     + (unsure * noise_hz) ** 2)
    if hz < SURE * std_hz:
        return NO_LEAK
    resets = (noise_hz + (off_risen + off_fallen) / (watched + unmoved)) * max(
        b - a for a, b in spans) * 1e-6
    hz *= resets / -np.expm1(-resets) if resets > 0 else 1.0  # leak that other noise sets back
    return Leaking(float(hz), float(np.hypot(std_hz, UNEVEN * hz)), float(other * noise_hz))

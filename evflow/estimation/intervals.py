"""How long pixels wait for an event while nothing happens near them: life tables.

For each time since a pixel's last event: how many seconds pixels waited that long, and how many ON
and OFF events ended the wait. Poisson noise ends waits at a constant rate, leak ends those of one
length. Tables add.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.types import Events

Array = np.ndarray

STEP = 1.12  # ratio of successive edges
EDGES = np.concatenate([[0.0], 1e-3 * STEP ** np.arange(123)])  # s: up to a quarter of an hour
CENSORED, ON, OFF = 0, 1, 2  # how a wait ended


@dataclasses.dataclass(frozen=True, eq=False)
class Waits:
    """own: (3, K) seconds waited, and ON and OFF events that ended the wait, by the time since the
    pixel's last event, between EDGES (K + 1,); first: the same for pixels without any event so far,
    by the time since they are observed."""

    own: Array
    first: Array

    @staticmethod
    def none() -> Waits:
        return Waits(*np.zeros((2, 3, len(EDGES) - 1)))

    def __add__(self, other: Waits) -> Waits:
        return Waits(self.own + other.own, self.first + other.first)


def life_table(seconds: Array, ended: Array) -> Array:
    """(3, K) from waits (N,): how long each was, and how it ended."""
    k = np.clip(np.searchsorted(EDGES, seconds, side="right") - 1, 0, len(EDGES) - 2)
    width, bins = np.diff(EDGES), len(EDGES) - 1
    beyond = np.bincount(k, minlength=bins)[::-1].cumsum()[::-1]
    within = np.bincount(k, np.minimum(seconds, EDGES[-1]) - EDGES[k], bins)
    return np.stack([(beyond - np.bincount(k, minlength=bins)) * width + within,
                     *(np.bincount(k[ended == kind], minlength=bins) for kind in (ON, OFF))])


def waits_at_rest(events: Events, hot: Array, span_us: tuple[int, int] | None = None) -> Waits:
    """The waits of all pixels (H, W) that are not hot, in a static scene. span_us: how long they
    were observed, if more than from the first event to the last."""
    begin, end = span_us or (int(events.t[0]), int(events.t[-1]))
    width, _ = events.size
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.argsort(pixel, kind="stable")
    order = order[~hot.ravel()[pixel[order]]]
    pixel, t, on = pixel[order], events.t[order] - begin, events.p[order]
    ended = np.where(on, ON, OFF)
    new = np.diff(pixel, prepend=-1) != 0
    last = np.diff(pixel, append=-1) != 0
    silent = int((~hot).sum() - new.sum())
    whole = end - begin
    first = np.concatenate([t[new], np.full(silent, whole)])
    own = np.concatenate([np.diff(t, prepend=0)[~new], whole - t[last]])
    return Waits(
        life_table(own * 1e-6, np.concatenate([ended[~new], np.zeros(int(last.sum()), int)])),
        life_table(first * 1e-6, np.concatenate([ended[new], np.zeros(silent, int)])))


class QuietWaits:
    """The waits of pixels in successive quiet windows: a wait starts at a pixel's own event and
    lasts as long as nothing happens near it."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._last = np.full(shape[0] * shape[1], np.nan)  # s, of the event that started the wait
        self._end_us = -1
        self._own = np.zeros((3, len(EDGES) - 1))

    def add(self, events: Events, span_us: tuple[int, int], quiet: Array) -> None:
        """The events of a window that begins at span_us[0], and where (H, W) it is quiet."""
        if span_us[0] != self._end_us:
            self._cut(np.ones(len(self._last), bool), self._end_us)
        self._end_us = span_us[1]
        self._cut(~quiet.ravel(), span_us[0])
        pixel = events.y.astype(np.int64) * events.size[0] + events.x
        order = np.argsort(pixel, kind="stable")
        order = order[quiet.ravel()[pixel[order]]]
        if not len(order):
            return
        pixel, t = pixel[order], events.t[order] * 1e-6
        new = np.diff(pixel, prepend=-1) != 0
        before = np.where(new, self._last[pixel], np.concatenate([[0.0], t[:-1]]))
        known = ~np.isnan(before)
        self._own += life_table((t - before)[known],
                                np.where(events.p[order], ON, OFF)[known])
        last = np.diff(pixel, append=-1) != 0
        self._last[pixel[last]] = t[last]

    def _cut(self, pixels: Array, at_us: int) -> None:
        """End the waits of these pixels."""
        waited = pixels & ~np.isnan(self._last)
        if waited.any():
            self._own += life_table(at_us * 1e-6 - self._last[waited],
                                    np.zeros(int(waited.sum()), int))
            self._last[waited] = np.nan

    def table(self) -> Waits:
        """All waits so far."""
        self._cut(np.ones(len(self._last), bool), self._end_us)
        return dataclasses.replace(Waits.none(), own=self._own)

"""Flickering light: a lamp on the mains, or a screen dimmed by pulses.

As light rises ON events come all over the sensor, as it falls OFF events, period by period: both
rates have a spectral line at one frequency, in antiphase. Motion has no line; what comes with
frames and a simulator's time slots affect both polarities at once; a blinking lamp in the scene is
seen in few places.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from evflow.types import Events

BIN_US = 500
LEAST_HZ = 45.0  # lowest frequency searched: moving things are slower
SEGMENT, LEAST_SEGMENT, MOST_SEGMENTS = 1024, 256, 16  # bins; segments evenly spread
LINE = 8.0  # times the usual amplitude
DEPTH = 0.2  # minimum modulation of both rates, relative to the mean
AGAINST = -0.5  # maximum cosine between the two
PLACES, EVENTS_A_PLACE, SPREAD = 4, 50, 0.6  # per side; minimum events; share that must agree


class Flicker(NamedTuple):
    """Its frequency, and the modulation of ON and OFF rates relative to their mean: 0 to 1, more if
    events come only in part of the period."""

    hz: float
    on: float
    off: float


def flicker(events: Events) -> Flicker | None:
    """The flicker of light over the whole sensor; None if there is none."""
    length = min(SEGMENT, events.duration_us // BIN_US)
    if length < LEAST_SEGMENT:
        return None
    parts = list(_parts(events, length))
    counts = np.array([_counts(part, begin, length) for part, begin in parts])
    mean = counts.mean((0, 2))
    window = np.hanning(length)
    lines = np.fft.rfft(window * (counts - counts.mean(2, keepdims=True)))[
        ..., (hz := np.fft.rfftfreq(length, BIN_US / 1e6)) >= LEAST_HZ]
    hz = hz[hz >= LEAST_HZ]
    power = (np.abs(lines) ** 2).mean(0)
    both = (lines[:, 0] * lines[:, 1].conj()).mean(0).real
    at = int(np.argmin(both))
    amplitude = np.sqrt(power[:, at])
    if not mean.all() or both[at] > AGAINST * amplitude.prod() or np.any(
            amplitude < LINE * np.sqrt(np.median(power, 1))):
        return None
    depth = amplitude / (mean * window.sum() / 2)
    near = slice(max(at - 1, 0), at + 2)
    found = float(np.average(hz[near], weights=np.maximum(-both[near], 0.0)))
    if depth.min() < DEPTH or _joining([part for part, _ in parts], found) < SPREAD:
        return None
    return Flicker(found, float(depth[0]), float(depth[1]))


def _parts(events: Events, length: int) -> Iterator[tuple[Events, int]]:
    """Segments of a recording and their start times, evenly spread."""
    rest_us = events.duration_us - length * BIN_US
    count = 1 + min(MOST_SEGMENTS - 1, rest_us // (length * BIN_US))
    for begin in int(events.t[0]) + np.linspace(0, rest_us, count).astype(np.int64):
        yield events.slice(int(begin), int(begin) + length * BIN_US), int(begin)


def _counts(part: Events, begin: int, length: int) -> np.ndarray:
    """ON and OFF events per bin, (2, length)."""
    at = (part.t - begin) // BIN_US + length * ~part.p
    return np.bincount(at, minlength=2 * length).reshape(2, length)


def _joining(parts: list[Events], hz: float) -> float:
    """The share of places on the sensor, among those with enough events, whose light flickers at
    this frequency in phase with the others."""
    joined, counted = 0, 0
    for part in parts:
        turn = np.where(part.p, 1.0, -1.0) * np.exp(-2j * np.pi * hz / 1e6 * part.t)
        width, height = part.size
        place = part.y.astype(np.int64) * PLACES // height * PLACES + (
            part.x.astype(np.int64) * PLACES // width)
        count = np.bincount(place, minlength=PLACES**2)
        sums = (np.bincount(place, turn.real, PLACES**2)
                + 1j * np.bincount(place, turn.imag, PLACES**2))
        enough = count >= EVENTS_A_PLACE
        whole = sums.sum() / max(abs(sums.sum()), 1e-12)
        along = (sums * np.conj(whole)).real[enough]
        joined += int(np.sum(along > DEPTH / 2 * count[enough]))
        counted += int(enough.sum())
    return joined / max(counted, 1)

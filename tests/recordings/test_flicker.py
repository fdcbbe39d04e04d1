"""Flickering light is found, with its frequency, and what resembles it is not."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.recordings.check.clocks import flickers
from evflow.recordings.flicker import flicker
from evflow.types import Events, Recording

SIZE = (32, 24)
Column = np.ndarray


def seen(light: Column, theta: float, noise: int = 0, lit: slice = slice(None)) -> Events:
    """Events of ideal pixels, whose memories begin anywhere, of one log intensity (T,), 10 kHz;
    lit: the rows that see it. noise: events at random."""
    rng = np.random.default_rng(0)
    x, y, t, p = [], [], [], []
    for row in np.arange(SIZE[1])[lit]:
        for column in range(SIZE[0]):
            level = np.floor((light + rng.uniform(0, theta)) / theta)
            for sign in (1, -1):  # a crossing each; those of a turn are dropped by neither
                at = np.flatnonzero(np.diff(level) * sign > 0)
                t.append(100 * at + rng.integers(0, 100, len(at)))
                p.append(np.full(len(at), sign > 0))
                x.append(np.full(len(at), column))
                y.append(np.full(len(at), row))
    t.append(rng.integers(0, 100 * len(light), noise))
    p.append(rng.random(noise) < 0.5)
    x.append(rng.integers(0, SIZE[0], noise))
    y.append(rng.integers(0, SIZE[1], noise))
    columns = [np.concatenate(v) for v in (x, y, t, p)]
    order = np.argsort(columns[2], kind="stable")
    a, b, c, d = (v[order] for v in columns)
    return Events(a, b, c.astype(np.int64), d, SIZE)


def wave(hz: float, depth: float, seconds: float = 1.0) -> Column:
    return np.log1p(depth * np.sin(2 * np.pi * hz * np.arange(0, seconds, 1e-4)))


@pytest.mark.parametrize(("hz", "seconds"), [(100, 1.0), (120, 3.0), (100, 0.2), (61.7, 1.0),
                                              (487, 1.0)])
def test_a_lamp_that_flickers(hz: float, seconds: float) -> None:
    events = seen(wave(hz, 0.3, seconds), 0.2, noise=3000)
    found = flicker(events)
    assert found is not None
    assert found.hz == pytest.approx(hz, abs=1.0 / seconds if seconds < 0.5 else 0.6)
    assert 0.4 < min(found.on, found.off) <= max(found.on, found.off) < 2.1
    (finding,) = flickers(Recording.of_events(events))
    assert (finding.code, finding.severity) == ("EV036", "warning")


def at(t: Column, p: Column) -> Events:
    rng = np.random.default_rng(1)
    order = np.argsort(t, kind="stable")
    return Events(rng.integers(0, SIZE[0], len(t)), rng.integers(0, SIZE[1], len(t)),
                  t[order].astype(np.int64), p[order], SIZE)


def test_what_is_no_flicker() -> None:
    rng = np.random.default_rng(2)
    sides = np.arange(40_000) % 2 == 0
    slots = at(np.repeat(np.arange(0, 1_000_000, 10_000), 400), sides)  # both polarities at once
    apart = at(np.where(sides, 0, 5_000) + 10_000 * rng.integers(0, 100, 40_000), sides)
    for what, events in {
        "noise": seen(wave(100, 0.0), 0.2, noise=40_000),
        "slots": slots,
        "slow": seen(wave(8, 0.5), 0.05, noise=3000),
        "a lamp that blinks in the scene": seen(wave(100, 0.5), 0.2, 3000, slice(0, 6)),
        "short": seen(wave(100, 0.3, 0.1), 0.2),
        "few": at(rng.integers(0, 1_000_000, 60), sides[:60]),
        "of one polarity": at(10_000 * rng.integers(0, 100, 40_000), sides | True),
        "one": at(np.array([5]), np.array([True])),
    }.items():
        assert flicker(events) is None, what
    assert flicker(apart) is not None  # ON and OFF by turns, 100 Hz

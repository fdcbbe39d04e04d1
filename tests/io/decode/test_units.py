"""The unit of times, from what is written, from rates, dates and spans."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.io.decode.units import (
    UNITS_US,
    misread,
    shared_unit,
    since_1970,
    usual_unit,
    video_unit,
    written_unit,
)
from evflow.types import Events

FRAMES_US = 40_000.0 * np.arange(26)


def events(count: int = 20_000, span_us: int = 1_000_000) -> Events:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, span_us + 1, count))
    x, y = rng.integers(0, 40, (2, count))
    return Events(x, y, t, rng.integers(0, 2, count), (40, 40))


@pytest.mark.parametrize(("words", "unit"), [
    ("timestamp [ns]", "ns"), ("t_us x y p", "us"), ("time in milliseconds", "ms"), ("t(s)", "s"),
    ("t[µs]", "us"), ("t x y p", "auto"), ("t[us] exposure[ms]", "auto")])
def test_a_unit_that_is_written(words: str, unit: str) -> None:
    assert written_unit(words) == unit


@pytest.mark.parametrize("unit", UNITS_US)
def test_frames_tell_their_unit_by_rate_date_and_events(unit: str) -> None:
    written = FRAMES_US / UNITS_US[unit]
    whole = written if unit in ("s", "ms") else np.rint(written).astype(np.int64)
    found, rates = video_unit(whole)
    assert found == unit
    assert rates[unit] == pytest.approx(25)
    assert usual_unit(whole, list(UNITS_US)) == unit
    assert shared_unit(whole, events().t, list(UNITS_US)) == unit
    assert since_1970(1.7e9 * 1e6 / UNITS_US[unit]) == [unit]
    fast = 1.7e15 / UNITS_US[unit] + 200.0 / UNITS_US[unit] * np.arange(9)  # 5,000 frames/s
    if unit in ("us", "ns"):
        assert video_unit(fast.astype(np.int64))[0] == unit  # the date tells


def test_times_that_tell_no_unit() -> None:
    found, rates = video_unit(200 * np.arange(9))
    assert found is None
    assert rates == pytest.approx({"us": 5000, "ms": 5})
    assert video_unit(np.zeros(1)) == (None, {})
    assert usual_unit(np.zeros(1), ["us", "s"]) == "us"
    assert shared_unit(FRAMES_US + 1e15, events().t, ["us"]) is None
    assert since_1970(5.0) == []


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "ms"), (1e3, "ns"), (1e-6, "s")])
def test_events_in_a_wrong_unit_contradict_the_frames(factor: float, unit: str) -> None:
    us = FRAMES_US.astype(np.int64)
    right = events()
    assert misread(right, us) is None
    t = (right.t * factor).astype(np.int64)
    found = misread(Events(right.x, right.y, t, right.p, right.size), us)
    assert found is not None
    assert found.certain
    assert found.unit.startswith(unit)


def test_the_rate_alone_tells_too() -> None:
    few = np.zeros(0, np.int64)
    fast = misread(events(span_us=1000), few)
    assert fast is not None
    assert fast.unit.startswith("ms")
    right = events()
    slow = Events(right.x, right.y, right.t * 1000, right.p, right.size)
    found = misread(slow, few)
    assert found is not None
    assert not found.certain
    assert misread(events(2), few) is None

"""Ceilings of the event rate are found, and what resembles them is not."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.recordings import ceiling, plan_windows
from evflow.recordings.ceiling import rate_ceiling
from evflow.recordings.check.rules import check
from evflow.recordings.windows import _Obstacles
from evflow.types import Events, Recording

SECONDS = 2.0


def varied(per_s: float, seed: int = 0) -> np.ndarray:
    """Times of independent events whose rate rises and falls between .1 and 1.9 times per_s."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 1e6 * SECONDS, int(2 * per_s * SECONDS)))
    return t[rng.random(len(t)) < 0.5 + 0.45 * np.sin(2e-6 * np.pi * 1.5 * t)].astype(np.int64)


def cut(t: np.ndarray, most: int, every_us: int) -> np.ndarray:
    """At most so many events of each time: the others are lost."""
    first = np.searchsorted(t, t // every_us * every_us)
    return t[np.arange(len(t)) - first < most]


def queued(t: np.ndarray, each_us: float) -> np.ndarray:
    """Events that leave one by one, each as long after the other at least."""
    waits = each_us * np.arange(len(t))
    return (np.maximum.accumulate(t - waits) + waits).astype(np.int64)


def recording(t: np.ndarray) -> Recording:
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 64, len(t)), rng.integers(0, 48, len(t))
    events = Events(x, y, t, rng.random(len(t)) < 0.5, (64, 48))
    times = 10_000 + 20_000 * np.arange(99)
    frames = rng.integers(60, 200, (99, 48, 64)).astype(np.uint8)
    return Recording(events, frames, times)


@pytest.mark.parametrize(("t", "per_s"), [
    (cut(varied(100_000), 120, 1_000), 120_000),
    (cut(varied(100_000), 24, 200), 120_000),
    (cut(varied(2_000_000), 250, 100), 2_500_000),
    (cut(varied(20_000), 10, 1_000), 10_000),
    (queued(varied(100_000), 8.0), 125_000)], ids=["1 ms", ".2 ms", "fast", "slow", "queue"])
def test_a_ceiling_is_found_with_its_rate_and_times(t: np.ndarray, per_s: float) -> None:
    found = rate_ceiling(t)
    assert found is not None
    assert found.per_s == pytest.approx(per_s, rel=0.02)
    assert 0.3 < found.share < 0.85
    begin, end = found.spans.T
    rates = np.diff(np.searchsorted(t, found.spans), axis=1)[:, 0] / (end - begin) * 1e6
    assert np.median(rates) == pytest.approx(per_s, rel=0.02)


@pytest.mark.parametrize("t", [
    varied(100_000), varied(8_000), varied(100_000, 3), np.sort(np.random.default_rng(0).integers(
        0, 2_000_000, 200_000)),
    np.arange(0, 2_000_000, 10), np.repeat(np.arange(0, 2_000_000, 1_000), 100),
    varied(100_000) // 1_000 * 1_000, varied(100)[:50], np.zeros(0, np.int64),
    np.concatenate([varied(100_000), 1_700_000_000_000_000 + varied(100_000)])], ids=[
        "varied", "few", "other", "constant", "even", "slots", "coarse", "short", "none", "jump"])
def test_what_is_no_ceiling(t: np.ndarray) -> None:
    assert rate_ceiling(t) is None


def test_blocks_count_every_event_once(monkeypatch: pytest.MonkeyPatch) -> None:
    t = cut(varied(100_000), 120, 1_000)
    whole = rate_ceiling(t)
    monkeypatch.setattr(ceiling, "BLOCK", 777)
    parts = rate_ceiling(t)
    assert whole is not None
    assert parts is not None
    np.testing.assert_array_equal(whole.spans, parts.spans)


def test_windows_at_a_ceiling_are_left_out() -> None:
    sound, capped = (recording(t) for t in (varied(100_000), cut(varied(100_000), 120, 1_000)))
    some = plan_windows(capped)
    assert plan_windows(sound).skipped == ()
    assert 10 < len(some.pairs) < len(plan_windows(sound).pairs) - 10
    assert all("ceiling of 120,000 events/s" in window.why for window in some.skipped)
    found = rate_ceiling(capped.events.t)
    assert found is not None
    for first, last in some.pairs:
        ends = capped.frame_times[[first, last]]
        assert np.diff(np.clip(found.spans, *ends)).sum() <= 0.05 * np.diff(ends)[0]


def test_check_says_that_the_rate_is_capped() -> None:
    findings = {f.code: f for f in check(recording(cut(varied(100_000), 120, 1_000))).findings}
    assert findings["EV039"].severity == "warning"
    assert "120,000 events/s" in findings["EV039"].seen
    assert "EV039" not in {f.code for f in check(recording(varied(100_000))).findings}


def test_events_that_wait_make_no_error_of_clocks() -> None:
    late = recording(queued(varied(100_000), 8.0))
    assert {f.severity for f in check(late).findings if f.code == "EV024"} <= {"warning"}


def test_time_at_a_ceiling_is_counted_within_a_window() -> None:
    rng = np.random.default_rng(1)
    capped = np.sort(rng.choice(1000, 40, replace=False)).reshape(-1, 2)
    times = np.arange(0, 1001, 37)
    nothing = np.zeros(0, np.int64)
    obstacles = _Obstacles(times, nothing, np.zeros((0, 2), np.int64), capped, 1e6, {}, {})
    before = [obstacles._capped_before(i) for i in range(len(times))]
    np.testing.assert_array_equal(
        before, [np.diff(np.clip(capped, 0, t)).sum() for t in times])

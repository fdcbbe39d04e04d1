"""Events that bunch at the frames are found, and what resembles them is not."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.recordings.bunches import MOST_BINS, _by_phase, beside, bunch
from evflow.recordings.check.clocks import bunches
from evflow.types import Events, Recording

SIZE, PERIOD_US, FRAMES = (64, 48), 40_000, 12


def recording(t: np.ndarray, p: np.ndarray) -> Recording:
    rng = np.random.default_rng(1)
    order = np.argsort(t, kind="stable")
    x, y = (rng.integers(0, n, len(t)) for n in SIZE)
    times = 20_000 + PERIOD_US * np.arange(FRAMES)
    return Recording(Events(x, y, t[order].astype(np.int64), p[order], SIZE),
                     np.zeros((FRAMES, *SIZE[::-1]), np.uint8), times)


def steady(n: int = 60_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.integers(0, PERIOD_US * FRAMES, n), rng.random(n) < 0.5


def with_pulses(phases_us: tuple[int, ...], width_us: int, each: int, every: int = 1) -> Recording:
    """A steady rate, and `each` ON events more at phases of every n-th frame."""
    t, p = steady()
    rng = np.random.default_rng(2)
    more = [20_000 + PERIOD_US * k + phase + rng.integers(0, width_us, each)
            for k in range(0, FRAMES, every) for phase in phases_us]
    return recording(np.concatenate([t, *more]), np.concatenate([p, np.ones(
        each * len(more), bool)]))


def test_a_readout_is_found_with_its_time_and_shares() -> None:
    finding, = bunches(with_pulses((-500,), 500, 600))
    assert (finding.code, finding.severity) == ("EV035", "warning")
    expected = 600 * FRAMES / (30_000 + 600 * FRAMES)
    assert "between -0.50 and +0.00 ms" in finding.seen
    share = float(finding.seen.split("come ")[1].split("%")[0])
    assert share == pytest.approx(100 * expected, abs=2)
    assert "0% of the OFF" in finding.seen


@pytest.mark.parametrize(("what", "seen"), {
    "none": recording(*steady()),
    "few": with_pulses((-500,), 500, 20),
    "some frames": with_pulses((-500,), 500, 900, every=2),
    "flicker": with_pulses((-15_000, -5_000, 5_000, 15_000), 500, 300),
    "long": with_pulses((-5_000,), 6_000, 4_000),
    "a simulator's slots": recording(np.repeat(np.arange(10_000, 470_000, 10_000), 500),
                                     np.arange(23_000) % 2 == 0),
    "no frames": Recording.of_events(recording(*steady()).events),
    "few events": recording(*steady(200)),
}.items(), ids=lambda v: v if isinstance(v, str) else "")
def test_what_is_no_readout(what: str, seen: Recording) -> None:
    assert bunches(seen) == [], what


def test_beside_a_bunch_are_the_other_events() -> None:
    seen = with_pulses((-500,), 500, 600)
    found = bunch(seen)
    assert found is not None
    assert found[:2] == (-500, 0)
    phase = (seen.events.t - 20_000 + PERIOD_US // 2) % PERIOD_US - PERIOD_US // 2
    other = beside(seen.events, seen.frame_times, found)
    np.testing.assert_array_equal(other.t, seen.events.t[(phase < -500) | (phase >= 0)])
    assert other.size == SIZE


def test_of_frames_minutes_apart_little_is_looked_at() -> None:
    t, p = steady(20_000)
    seen = recording(t * 3_000, p)
    far = Recording(seen.events, seen.frames, seen.frame_times * 3_000)
    assert _by_phase(far)[0].shape[2] == MOST_BINS
    assert bunches(far) == []

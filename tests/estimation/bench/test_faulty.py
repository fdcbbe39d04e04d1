"""Faulty pixels before steps of the light: hot ones keep their own rate, dead ones are told."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.benches import CYCLES, bench, cameras

from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.rests import find_rests
from evflow.types import Events, Recording

HOT, DEAD = (3, 2), (slice(4, 6), slice(4, 7))  # y, x


def with_faults(recording: Recording, hz: float) -> Recording:
    """The recording with a hot pixel of ON events, and some without any."""
    events, rng = recording.events, np.random.default_rng(0)
    silent = np.zeros(events.size[::-1], bool)
    silent[DEAD] = True
    kept = ~silent[events.y, events.x]
    span = int(recording.frame_times[-1])
    n = int(hz * span * 1e-6)
    more = np.full(n, HOT[1]), np.full(n, HOT[0]), rng.integers(0, span, n), np.ones(n, bool)
    x, y, t, p = (np.concatenate([a[kept], b]) for a, b in zip(
        (events.x, events.y, events.t, events.p), more, strict=True))
    order = np.argsort(t, kind="stable")
    return dataclasses.replace(
        recording, events=Events(x[order], y[order], t[order], p[order], events.size))


@pytest.mark.parametrize("hz", [30.0, 300.0])
def test_a_hot_pixel_has_its_own_rate_and_dead_ones_are_told(hz: float) -> None:
    camera = cameras(0.03, "eq12")
    recording = bench(camera, CYCLES)
    assert find_rests(recording)
    plain, found = (calibrate_step(r, fresh=True) for r in (recording, with_faults(recording, hz)))
    assert found.hot[HOT]
    eta, std = (float(m.eta_on[HOT]) for m in (found.camera, found.std))
    assert std == pytest.approx(np.sqrt(hz / 0.45), rel=0.5)
    assert abs(eta - hz) < 4 * std
    assert found.dead[DEAD].all()
    assert {"pixels.hot", "pixels.dead"} <= {note.code for note in found.notes}
    for name in ("eta_on", "eta_off"):
        usual, own = (float(getattr(f.summary, name)) for f in (plain, found))
        assert own == pytest.approx(usual, rel=0.1)
        np.testing.assert_allclose(getattr(found.camera, name)[DEAD], own, rtol=0.02)

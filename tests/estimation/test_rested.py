"""Noise where the light of the whole scene drifts: against pixels that are simulated here, without
the simulator."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from evflow import Events, Recording
from evflow.camera import Summary
from evflow.estimation.finish import without_drift
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.pooled import quiet_times
from evflow.estimation.refine import cut
from evflow.estimation.remarks import drift_notes
from evflow.estimation.rested import Rested
from evflow.estimation.state import State, windows_of
from evflow.recordings.windows import plan_windows
from evflow.simulator.photoreceptor import IDEAL

SHAPE, SECONDS, THETA, ETA = (48, 64), 4.0, np.array([0.25, 0.3]), 0.1
NONE_FAULTY = np.zeros(SHAPE, bool)
EVEN = np.full((2, *SHAPE), 4.0, np.float32)


def events_of(drift: float) -> Events:
    """Ideal pixels that have run for long, of light that changes by `drift` log units a second."""
    rng, step = np.random.default_rng(5), 2e-3
    memory, found = rng.uniform(-THETA[0], THETA[1], SHAPE), []
    for k in range(round(SECONDS / step)):
        light = drift * step * (k + 1)
        noise = rng.random((2, *SHAPE)) < ETA * step
        crossed = np.stack([light - memory >= THETA[0], memory - light >= THETA[1]])
        moved = memory + THETA[0] * crossed[0] - THETA[1] * crossed[1]
        memory = np.where(noise.any(0), light, moved)
        for on, fired in zip((True, False), noise | crossed, strict=True):
            y, x = np.nonzero(fired)
            found.append([x, y, np.full(len(x), 1e6 * step * (k + 1)), np.full(len(x), on)])
    x, y, t, on = np.concatenate(found, 1).astype(np.int64)
    return Events(x, y, t, on > 0, SHAPE[::-1])


def filmed(events: Events, drift: float) -> Recording:
    rng, times = np.random.default_rng(6), np.arange(0.0, SECONDS, 0.04)
    dn = rng.uniform(60.0, 160.0, SHAPE) * np.exp(drift * times)[:, None, None]
    frames = np.rint(dn + rng.normal(0.0, 1.0, dn.shape)).astype(np.uint8)
    return Recording(events, frames, (1e6 * times).astype(np.int64))


def rates(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noise of all quiet pixels, that without drift, and its maps (2, 2, H, W)."""
    state = State({}, FrontEnd(), read=cut(recording, plan_windows(recording), path=False))

    def summary(eta: np.ndarray) -> Summary:
        return Summary(*(jnp.float32(v) for v in (*THETA, *eta, 0.01, 0.01)))

    quiet = quiet_times(windows_of(state.read), summary(THETA), NONE_FAULTY, IDEAL)
    seen = quiet.maps[:, 0].sum((1, 2)) / quiet.maps[:, 1].sum((1, 2))
    found, std, used, by_drift = without_drift(
        state, NONE_FAULTY, (), summary(seen), summary(0.05 * seen), quiet)
    hz = np.array([found.eta_on, found.eta_off])
    np.testing.assert_allclose(seen - hz, by_drift, atol=1e-6)
    assert (np.array([std.eta_on, std.eta_off]) > 0.049 * hz).all()
    assert len(drift_notes(quiet.drift, by_drift)) == (by_drift > 0).sum()
    return seen, hz, used.maps


@pytest.mark.parametrize(("drift", "side"), [(0.08, 0), (-0.08, 1)])
def test_drift_of_the_light_is_not_counted_as_noise(drift: float, side: int) -> None:
    recording = filmed(events_of(drift), drift)
    seen, hz, maps = rates(recording)
    assert seen[side] > 1.8 * ETA
    assert hz[side] == pytest.approx(ETA, rel=0.2)
    assert hz[1 - side] == np.float32(seen[1 - side])
    assert maps[side, 0].sum() / maps[side, 1].sum() == pytest.approx(hz[side], rel=0.02)


@pytest.mark.parametrize("exposure", [0.0, 0.1, -0.1], ids=["nothing", "rises", "falls"])
def test_noise_stays_as_it_is_where_the_light_is_steady(exposure: float) -> None:
    """An auto-exposure changes the frames, and no event shows it."""
    seen, hz, _ = rates(filmed(events_of(0.0), exposure))
    np.testing.assert_array_equal(hz, seen.astype(np.float32))
    np.testing.assert_allclose(hz, ETA, rtol=0.15)


def test_a_pixel_rests_from_its_own_event_until_its_light_has_changed() -> None:
    rested, fired = Rested(SHAPE, np.array([0.1, 0.05])), np.zeros((2, *SHAPE), bool)
    assert not rested.add((0, 1), np.stack([EVEN[0], EVEN[0]]), fired).any()
    fired[1, 20, 30] = True
    assert not rested.add((1, 2), EVEN, fired).any()
    for end, change, expected in ((3, 0.04, [1, 1]), (4, -0.02, [1, 0]), (5, 0.09, [0, 1])):
        found = rested.add((end - 1, end), EVEN + np.float32(change), 0 * fired)
        assert found.sum((1, 2)).tolist() == expected
        assert found[:, 20, 30].tolist() == [bool(n) for n in expected]


def test_what_happens_between_windows_is_not_known() -> None:
    rested, fired = Rested(SHAPE, np.array([0.1, 0.1])), np.ones((2, *SHAPE), bool)
    rested.add((0, 1), EVEN, fired)
    assert rested.add((1, 2), EVEN, fired).all()
    assert not rested.add((3, 4), EVEN, fired).any()
    assert rested.add((4, 5), EVEN, fired).all()

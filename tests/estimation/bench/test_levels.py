"""What the rests and steps of a bench say by their light: levels, durations, sizes, dead time."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.benches import CYCLES, SHAPE, STAIRS, bench, cameras

from evflow.errors import EvflowDataError
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.levels import Bench, _dead_time, few_sizes, lux_notes
from evflow.estimation.dead_time import DeadTime
from evflow.report.bench import _dead_time as said_of_dead_time
from evflow.types import Events


def test_levels_of_light_are_told_apart() -> None:
    """Noise and duration of the steps at each, with a light meter's values as with the frames'."""
    camera = cameras(0.03, "eq12")
    recording = bench(camera, STAIRS)
    found = calibrate_step(recording, fresh=True)
    assert "levels.few" not in [note.code for note in found.notes]
    assert found.bench is not None
    levels = found.bench.levels
    np.testing.assert_allclose([v.light for v in levels], sorted(set(STAIRS)), rtol=1e-3)
    assert [v.rests for v in levels] == [2, 2, 2, 2, 2, 1]
    for name in ("eta_on", "eta_off"):
        true = float(np.mean(getattr(camera, name)))
        off = [(getattr(v, name) - true) / getattr(v, f"{name}_std") for v in levels]
        assert np.abs(off).max() < 3.5
    assert all(v.up_s is None is v.down_s for v in levels)  # steps of two thresholds
    assert len(found.bench.steps) == len(STAIRS) - 1
    metered = calibrate_step(recording, lux=[0.3 * v for v in sorted(set(STAIRS))], fresh=True)
    assert metered.bench is not None
    assert metered.bench.unit == "lux"
    np.testing.assert_allclose(metered.camera.theta_on, found.camera.theta_on, atol=1e-4)
    for lux in ([1, 2], [6, 5, 4, 3, 2, 1], [0, 1, 2, 3, 4, 5]):
        with pytest.raises(EvflowDataError, match=r"EV020.*the frames rest at 6 levels"):
            calibrate_step(recording, lux=lux)


def test_how_long_steps_last() -> None:
    """Ramps of 20 ms, even in log: from half to nine tenths they take 8 ms, turned or not."""
    found = calibrate_step(bench(cameras(0.1), [25, 75, 225, 60, 225, 80, 25, 120, 25]))
    assert found.bench is not None
    lasting = [step.seconds for step in found.bench.steps]
    assert None not in lasting
    np.testing.assert_allclose(lasting, 0.008, rtol=0.2)
    assert np.median(lasting) == pytest.approx(0.008, rel=0.06)
    assert found.bench.levels[0].up_s is None


@pytest.mark.parametrize(("levels", "few"), [
    (CYCLES, True), ([25, 75, 225, 75, 25], True), ([25, 60, 225, 60, 25], False)])
def test_steps_of_one_size_are_told(levels: list[float], few: bool) -> None:
    changes = np.diff(np.log(levels))
    assert [note.code for note in few_sizes(changes)] == ["levels.few"] * few


@pytest.mark.parametrize(("lux", "said"), [
    ((12, 17, 31, 68), []), ((12, 17, 31, 680), ["from 31 to 680 lux"]),
    ((1.2, 17, 31, 68), ["from 1.2 to 17 lux"]), ((12**2.2, 17**2.2, 31**2.2, 68**2.2), [])])
def test_a_wrong_reading_of_the_light_meter_is_noted(
    lux: tuple[float, ...], said: list[str]
) -> None:
    notes = lux_notes(np.log([55, 40, 220, 100, 40]), lux)
    assert [note.text.partition(" light")[0] for note in notes] == said


@pytest.mark.parametrize(("small_us", "down_us", "changes", "measured"), [
    (1000, 1000, [1.5, -1.5, 1.0, -1.0], True), (1500, 1000, [1.5, -1.5, 1.0, -1.0], False),
    (1100, 1000, [1.5, -1.5, 1.0, -1.0], False), (1000, 1200, [1.5, -1.5, 1.0, -1.0], False),
    (1000, 1000, [1.5, -1.5, 1.5, -1.5], False)])
def test_an_edge_of_the_light_is_no_dead_time(
    small_us: int, down_us: int, changes: list[float], measured: bool
) -> None:
    """Pixels that wait do so alike in all steps, those that follow the light do not."""
    rng, n = np.random.default_rng(0), SHAPE[0] * SHAPE[1]
    during = []
    for k, us in enumerate([1000, down_us, small_us, down_us * small_us // 1000]):
        t = 1_000_000 * k + np.arange(6)[:, None] * us + rng.integers(0, 40, (6, n)).cumsum(0)
        order = np.argsort(t, axis=None, kind="stable")
        pixel = np.tile(np.arange(n), 6)[order]
        during.append(Events(pixel % SHAPE[1], pixel // SHAPE[1], t.ravel()[order],
                             np.full(t.size, k % 2 == 0), SHAPE[::-1]))
    found = _dead_time(Events.concatenate(during), np.array(changes), during)
    assert found.measured == measured
    assert (found.seconds if measured else found.below_s) == pytest.approx(1e-3, rel=0.05)


def test_the_report_bounds_a_dead_time_that_may_be_an_edge() -> None:
    bench = Bench("DN", (), (), DeadTime(below_s=1.5e-3))
    assert "is at most 1.50 ms" in said_of_dead_time(bench)
    assert (bench.as_dict()["dead_time_s"], bench.as_dict()["dead_time_s_below"]) == (None, 1.5e-3)

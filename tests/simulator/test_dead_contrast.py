"""Contrast that changes in a pixel's dead time: kept, dropped, or left out by a reset."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from helpers.recordings import equal
from helpers.videos import SHAPE, by_pixel, code_of, drifting, milliseconds

from evflow.camera import Camera
from evflow.camera.sensors import SecondOrder, SensorModel
from evflow.light.log_maps import lin_log, to_log
from evflow.simulator import active, circuits, simulate, simulate_counts, simulate_voxels
from evflow.voxel import voxelize

KEY = jax.random.key(0)
CAMERA = Camera.constant(SHAPE, 0.09, 0.12)
RESETS = SensorModel(refractory_s=2.5e-3, dead_contrast="resets")
DROPS = dataclasses.replace(RESETS, dead_contrast="drops")


def followed(log: np.ndarray, dead_us: float) -> list[float]:
    """Times in us, negative for OFF, of the events of one pixel that begins anew after its dead
    time; log (T,): at frames 1 ms apart, with straight lines between."""
    knots = 1e3 * np.arange(len(log))
    now, base, found = 0.0, float(log[0]), []
    while now < knots[-1]:
        k = int(np.searchsorted(knots, now, side="right"))  # the line's end
        here = float(np.interp(now, knots, log))
        slope = (log[k] - here) / (knots[k] - now)
        target = base + (0.09 if slope > 0 else -0.12)
        if slope == 0 or (at := now + (target - here) / slope) > knots[k]:
            now = float(knots[k])
            continue
        found.append(at if slope > 0 else -at)
        now = at + dead_us
        base = float(np.interp(now, knots, log))
    return found


@pytest.mark.parametrize("dead_s", [3e-4, 2.5e-3])
def test_a_pixel_held_in_reset_follows_its_light_from_reset_to_reset(dead_s: float) -> None:
    frames = drifting(40, speed=2.0)
    log = np.asarray(to_log(frames), np.float64).reshape(len(frames), -1)
    expected = [followed(path, 1e6 * dead_s) for path in log.T]
    model = dataclasses.replace(RESETS, refractory_s=dead_s)
    pixel, t, p = by_pixel(simulate(KEY, frames, milliseconds(40), CAMERA, model=model))
    total = sum(map(len, expected))
    free = simulate(KEY, frames, milliseconds(40), CAMERA)
    assert 500 < total < 0.95 * len(free)
    same = 0
    for number, times in enumerate(expected):
        ours = np.where(p, t, -t)[pixel == number]
        same += len(ours) == len(times) and np.abs(ours - times).max(initial=0) < 4
    assert same > 0.98 * len(expected)  # float32 decides others' ties
    assert len(t) == pytest.approx(total, rel=5e-3)


def test_dropped_events_are_those_of_the_free_pixel_that_fall_into_a_dead_time() -> None:
    frames, times = drifting(60, speed=2.0), milliseconds(60)
    theirs = simulate(KEY, frames, times, CAMERA, model=SensorModel(
        kind="esim", refractory_s=2.5e-3))
    ours = simulate(KEY, frames, times, CAMERA, model=dataclasses.replace(
        DROPS, log_map="log_eps"))
    assert len(ours) == pytest.approx(len(theirs), rel=2e-3)  # ESIM's thresholds are rounded


def test_a_fast_second_order_pixel_is_nearly_one_that_begins_anew() -> None:
    receptor = SecondOrder(follower_s=0.0, amplifier_s=1e-7).at(1e5)
    fast = SensorModel(photoreceptor=receptor, refractory_s=2.5e-3)
    frames, times = drifting(40, speed=2.0), milliseconds(40)
    theirs, ours = (simulate(KEY, frames, times, CAMERA, model=m) for m in (fast, RESETS))
    assert len(ours) == pytest.approx(len(theirs), rel=0.01)
    np.testing.assert_allclose(ours.count_map().sum((1, 2)), theirs.count_map().sum((1, 2)),
                               rtol=0.01)


def test_what_is_kept_fires_most_and_a_reset_least() -> None:
    """Each pixel that loses some has fewer events, and what it loses is lost for good."""
    frames = np.concatenate([drifting(40, speed=2.0), np.repeat(drifting(40, speed=2.0)[-1:], 20,
                                                                axis=0)])
    times = np.concatenate([milliseconds(40), 39_000 + 10_000 * np.arange(1, 21)])
    kept, dropped, reset = (
        len(simulate(KEY, frames, times, CAMERA, model=dataclasses.replace(
            RESETS, dead_contrast=law))) for law in ("keeps", "drops", "resets"))
    assert kept > 1.1 * dropped > 1.1 * reset


NOISY = dataclasses.replace(RESETS, cutoff_hz=200.0, leak_hz=9.0, leak_jitter=0.1, shot_hz=20.0,
                            noise_resets_memory=True)


@pytest.mark.parametrize("model", [RESETS, DROPS, NOISY,
                                   dataclasses.replace(NOISY, dead_contrast="drops")])
def test_all_exits_have_the_same_events(
    model: SensorModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that pass over still pixels, and those that do not."""
    frames, times = drifting(33), milliseconds(33)
    events = simulate(KEY, frames, times, CAMERA, model=model)
    assert len(events) > 500
    counts = simulate_counts(KEY, lin_log(frames), CAMERA, frame_dt_s=1e-3, model=model)
    np.testing.assert_array_equal(np.moveaxis(np.asarray(counts), -1, 0), events.count_map())
    voxels = simulate_voxels(KEY, lin_log(frames), CAMERA, frame_dt_s=1e-3, model=model)
    ours = voxelize(events, 0, 32_000)
    assert float(np.abs(ours - np.asarray(voxels)).mean()) < 2e-3
    pieces = circuits._Thresholds.pieces

    def all_pieces(pixels: circuits._Thresholds, _: np.ndarray, block: active.Block) -> Any:
        return pieces(pixels, np.arange(frames[0].size), block)

    monkeypatch.setattr(circuits._Thresholds, "pieces", all_pieces)
    equal(events, simulate(KEY, frames, times, CAMERA, model=model))


def test_leak_begins_anew_too() -> None:
    """A still pixel leaks a threshold after each dead time: 1 / (dead time + its time to leak)."""
    times = np.arange(0, 4_000_001, 10_000)
    still = np.full((len(times), 2, 2), 100, np.uint8)
    model = SensorModel(leak_hz=20.0, refractory_s=0.05, dead_contrast="resets")
    events = simulate(KEY, still, times, Camera.constant((2, 2), 0.2, 0.2), model=model)
    assert events.p.all()
    np.testing.assert_allclose(events.count_map()[0], 4.0 / (0.05 + 1 / 20.0), atol=1)


def test_the_choice_is_that_of_pixels_that_have_one() -> None:
    for options in ({"kind": "esim", "dead_contrast": "keeps"},
                    {"timestamps": "v2e", "dead_contrast": "drops"},
                    {"photoreceptor": SecondOrder(), "dead_contrast": "keeps"},
                    {"kind": "paper", "dead_contrast": "resets"}, {"dead_contrast": "lost"}):
        assert code_of(lambda options=options: SensorModel(**options)) == "EV020", options
    assert SensorModel(kind="esim").in_dead_time == "drops"
    assert SensorModel(photoreceptor=SecondOrder()).in_dead_time == "resets"
    assert SensorModel().in_dead_time == "keeps"
    assert RESETS.in_dead_time == "resets"
    assert repr(RESETS) == "SensorModel(refractory_s=0.0025, dead_contrast='resets')"


def test_without_a_dead_time_nothing_is_lost() -> None:
    frames = drifting(20)
    none = SensorModel(dead_contrast="resets")
    equal(simulate(KEY, frames, milliseconds(20), CAMERA),
          simulate(KEY, frames, milliseconds(20), CAMERA, model=none))

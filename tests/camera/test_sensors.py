"""Sensor models: known ones by name, what their events are, and what a kind refuses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers.recordings import equal
from helpers.videos import SHAPE, by_pixel, drifting, milliseconds

from evflow.camera import Camera
from evflow.camera.sensors import SENSORS, SensorModel, Voltmeter, known_sensor
from evflow.errors import EvflowDataError
from evflow.light.log_maps import to_log
from evflow.simulator import simulate, simulate_voxels
from evflow.types import Events
from evflow.voxel import voxelize

pytestmark = pytest.mark.usefixtures("optimised")

KEY = jax.random.key(0)
QUIET = Camera.constant(SHAPE, 0.15, 0.2)
NOISY = Camera.constant(SHAPE, 0.15, 0.2, 30.0, 15.0)
# Events of goldens/bench_video.npz by the published programs.
PUBLISHED = {"esim": 1_005_123, "dvs346": 625_344, "dvs240": 557_458}
WITHIN = {"esim": 1e-3, "dvs346": 1e-2, "dvs240": 1e-2}


@pytest.mark.parametrize("name", [
    "esim", "dvs240", pytest.param("dvs346", marks=pytest.mark.slow)])
def test_counts_are_those_of_the_published_programs(
    name: str, data_file: Callable[[str], Path]
) -> None:
    known = SENSORS[name]
    with np.load(data_file("goldens/bench_video.npz")) as source:
        frames = source["frames"]
    camera = Camera.constant(frames.shape[1:], known.theta, known.theta)
    events = simulate(KEY, frames, 1000 * np.arange(len(frames)), camera, model=known.model)
    assert len(events) == pytest.approx(PUBLISHED[name], rel=WITHIN[name])
    assert len(np.unique(events.t)) > 0.8 * 299_000  # no pillars of equal time stamps


@pytest.mark.parametrize("name", SENSORS)
def test_every_known_sensor_simulates(name: str) -> None:
    known = known_sensor(name)
    camera = Camera.constant(SHAPE, known.theta, known.theta, 2.0, 1.0)
    frames, times = drifting(40), milliseconds(40)
    events = simulate(KEY, frames, times, camera, model=known.model)
    assert len(events) > 300
    equal(events, simulate(KEY, frames, times, camera, model=known.model))
    Events(events.x, events.y, events.t, events.p, (SHAPE[1], SHAPE[0]))  # raises if not sorted
    assert known.source


def lost_when_early(events: Events, refractory_us: int) -> np.ndarray:
    """Which events (by pixel, then time) ESIM keeps: those no sooner than the dead time after
    the last one kept."""
    pixel, t, _ = by_pixel(events)
    kept = np.zeros(len(t), bool)
    last: dict[int, int] = {}
    for i, (where, when) in enumerate(zip(pixel, t, strict=True)):
        kept[i] = when - last.get(where, -(10**9)) >= refractory_us
        if kept[i]:
            last[where] = when
    return kept


def test_repr_shows_what_differs_from_the_default() -> None:
    assert repr(SensorModel()) == "SensorModel()"
    assert repr(SensorModel(cutoff_hz=60, cutoff_by_light=False)) == (
        "SensorModel(cutoff_hz=60.0, cutoff_by_light=False)")
    assert repr(SENSORS["dvs346"].model).startswith("SensorModel(kind='voltmeter', ")
    assert "k1=5.265" in repr(SENSORS["dvs346"].model)


def test_esim_loses_the_events_of_its_dead_time() -> None:
    """Against a loop over the events of the free pixel; whole microseconds may decide one in
    two hundred the other way."""
    frames, times = drifting(60, speed=2.0), 1000 * np.arange(60)
    free = simulate(KEY, frames, times, Camera.constant(SHAPE, 0.05, 0.07),
                    model=SensorModel(kind="esim"))
    for dead_us in (300, 2500):
        model = SensorModel(kind="esim", refractory_s=dead_us * 1e-6)
        late = simulate(KEY, frames, times, Camera.constant(SHAPE, 0.05, 0.07), model=model)
        kept = lost_when_early(free, dead_us)
        assert 0.02 * len(free) < len(late) < 0.95 * len(free)
        assert len(late) == pytest.approx(kept.sum(), rel=5e-3)
        pixel, t, _ = by_pixel(late)
        gaps = np.diff(t)[np.diff(pixel) == 0]
        assert gaps.min() >= dead_us - 1


def test_labels_tell_signal_from_noise() -> None:
    """Noise that leaves the memory alone is added: without it, the silent camera's events."""
    frames, times = drifting(40), milliseconds(40)
    events, noise = simulate(KEY, frames, times, NOISY, labels=True)
    signal = Events(*(getattr(events, n)[~noise] for n in ("x", "y", "t", "p")), events.size)
    equal(signal, simulate(KEY, frames, times, QUIET))
    rate = noise.sum() / (np.prod(SHAPE) * 0.039)
    assert rate == pytest.approx(45.0, rel=0.25)  # 337 events: sd 5 %
    equal(events, simulate(KEY, frames, times, NOISY))
    still = np.broadcast_to(frames[:1], frames.shape)
    assert simulate(KEY, still, times, NOISY, labels=True)[1].all()
    leaking = SensorModel(leak_hz=200.0)  # crosses the threshold as light does
    assert not simulate(KEY, still, times, QUIET, model=leaking, labels=True)[1].any()


@pytest.mark.parametrize("camera", [QUIET, NOISY])
def test_voltmeter_voxels_are_those_of_its_events(camera: Camera) -> None:
    model, frames = SENSORS["dvs240"].model, drifting(33)
    events = simulate(KEY, frames, milliseconds(33), camera, model=model)
    events = dataclasses.replace(events, t=events.t - 1)
    direct = np.asarray(simulate_voxels(
        KEY, to_log(frames), camera, frame_dt_s=1e-3, model=model))
    ours = voxelize(events, 0, 32_000)
    assert len(events) > 1000
    # Light from its logarithm rounds differently: a draw in 10^5 may fall on the other side.
    assert np.abs(direct - ours).sum() < 0.01 * len(events)


@pytest.mark.parametrize("value", [None, "3", 1j, float("nan"), -0.1])
def test_what_is_no_rate_is_refused(value: Any) -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*leak_hz"):
        SensorModel(leak_hz=value)


@pytest.mark.parametrize(("name", "value"), [
    ("voltmeter", 3), ("voltmeter", None), ("photoreceptor", True), ("eta_is_all", "no"),
    ("cutoff_by_light", 2), ("eta_intensity", None), ("noise_resets_memory", np.ones(2, bool))])
def test_fields_of_another_type_are_refused(name: str, value: Any) -> None:
    with pytest.raises(EvflowDataError, match=rf"EV020.*SensorModel\({name}="):
        SensorModel(**{name: value})


def test_switches_may_be_of_numpy() -> None:
    assert SensorModel(eta_is_all=np.bool_(True), cutoff_by_light=0) == SensorModel(
        eta_is_all=True, cutoff_by_light=False)


@pytest.mark.parametrize("options", [
    {"kind": "dvs"}, {"kind": "esim", "leak_hz": 0.1}, {"kind": "esim", "timestamps": "v2e"},
    {"kind": "paper", "shot_hz": 1.0}, {"kind": "paper", "noise_resets_memory": True},
    {"kind": "voltmeter", "cutoff_hz": 30.0}, {"kind": "voltmeter", "refractory_s": 1e-3}])
def test_kinds_refuse_what_they_have_no_part_for(options: dict[str, Any]) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        SensorModel(**options)


def test_a_kind_has_its_own_log_map() -> None:
    assert SensorModel().log_map == "linlog"
    assert SensorModel(kind="esim").log_map == "log_eps"
    assert SensorModel(kind="esim", log_map="linlog").log_map == "linlog"
    with pytest.raises(EvflowDataError, match=r"EV020.*clean"):
        known_sensor("davis")
    with pytest.raises(EvflowDataError, match="EV020"):
        Voltmeter(5.0, -20.0, 1e-4, 1e-7, 5e-9, 1e-5)

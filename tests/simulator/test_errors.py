"""What the simulator refuses, with the code and the words that help."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import code_of

from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.light.log_maps import to_log
from evflow.simulator import simulate, simulate_counts, simulate_stream, simulate_voxels
from evflow.simulator.pack import Keys

SHAPE = (4, 6)
KEY = jax.random.key(0)
CAMERA = Camera.constant(SHAPE)


def frames(count: int = 3, dtype: Any = np.uint8) -> np.ndarray:
    return np.full((count, *SHAPE), 100, dtype)


def with_value(value: float, at: tuple[int, int, int] = (1, 2, 3)) -> np.ndarray:
    made = frames(dtype=np.float32)
    made[at] = value
    return made


TIMES = np.array([0, 1000, 2000])


@pytest.mark.parametrize(("changed", "code", "seen"), [
    ({"frames": frames()[0]}, "EV002", "(T, H, W)"),
    ({"frames": np.zeros((3, *SHAPE, 3), np.uint8)}, "EV002", "Colour? evflow.light"),
    ({"times_us": TIMES[:2]}, "EV002", "(2,)"),
    ({"times_us": 5}, "EV002", "()"),
    ({"frames": frames(0), "times_us": TIMES[:0]}, "EV001", "no frames"),
    ({"frames": frames(1), "times_us": TIMES[:1]}, "EV001", "one frame"),
    ({"frames": np.ma.masked_equal(frames(), frames()[1, 1, 1])}, "EV003", "masked"),
    ({"times_us": np.ma.masked_equal(TIMES, TIMES[1])}, "EV003", "times_us has 1 masked"),
    ({"times_us": TIMES.astype("m8[us]")}, "EV003", "astype('timedelta64[us]').astype(np.int64)"),
    ({"times_us": TIMES.astype("M8[us]")}, "EV003", ": t.astype('datetime64[us]').astype(np.int64"),
    ({"frames": with_value(np.nan)}, "EV007", "1 values of the frames are not finite, first in "
                                              "frame 1 at y=2, x=3"),
    ({"frames": with_value(-np.inf)}, "EV007", "frame 1"),
    ({"frames": with_value(300.0)}, "EV003", "to 300"),
    ({"frames": with_value(-1.0)}, "EV003", "from -1"),
    ({"frames": frames(dtype=np.float32) * 50}, "EV003", "to_dn"),
    ({"frames": frames(dtype=np.float32) / 255}, "EV003", "on 0..1"),
    ({"frames": frames(dtype=np.uint16) * 16, "full_scale": 1023}, "EV003",
     "frame 0 reaches 1600, beyond white at full_scale=1023"),
    ({"full_scale": 99.5}, "EV020", "full_scale=99.5 with uint8 frames"),
    ({"full_scale": 1}, "EV020", "Leave it out"),
    ({"full_scale": -255}, "EV020", "Give the value of white"),
    ({"full_scale": "a"}, "EV020", "full_scale='a'"),
    ({"frames": frames(dtype=np.int32)}, "EV003", "int32"),
    ({"frames": frames(dtype=bool)}, "EV003", "bool"),
    ({"frames": frames().astype(object)}, "EV003", "object"),
    ({"times_us": TIMES / 1000.0}, "EV003", "float64"),
    ({"times_us": np.array([0, 1000, 2**64 - 1], np.uint64)}, "EV003", "more than int64"),
    ({"times_us": np.array([0, 1000, 1000])}, "EV004", "frame 2 is at 1000 us"),
    ({"times_us": np.array([0, 2000, 1000])}, "EV004", "the one before at 2000 us"),
    ({"camera": Camera.constant((6, 4))}, "EV015", "(4, 6)"),
    ({"camera": Camera.constant((2, *SHAPE))}, "EV002", "one camera at a time"),
    ({"camera": Camera.constant((1, 70_000)), "frames": np.zeros((3, 1, 70_000), np.uint8)},
     "EV002", "a sensor of 70,000x1 pixels"),
    ({"camera": dataclasses.replace(CAMERA, theta_on=CAMERA.theta_on.at[1, 1].set(0))}, "EV014",
     "theta_on is 0 at index (1, 1)"),
    ({"camera": dataclasses.replace(CAMERA, theta_off=-CAMERA.theta_off)}, "EV014", "theta_off"),
    ({"camera": Camera.constant(SHAPE, theta_off=1e-6)}, "EV014", "theta_off is 1e-06 at index"),
    ({"camera": Camera.constant(SHAPE, theta_on=1e-44)}, "EV014", "below 0.0001"),
    ({"camera": dataclasses.replace(CAMERA, eta_on=CAMERA.eta_on - 1)}, "EV014", ">= 0"),
    ({"camera": dataclasses.replace(CAMERA, eta_off=jnp.zeros((2, 2)))}, "EV015", "eta_off"),
    ({"camera": Camera.constant(SHAPE, eta_on=1e6)}, "EV014", "1e+03 events per pixel"),
    ({"camera": Camera.constant(SHAPE, eta_off=2e4),
      "model": SensorModel(eta_intensity=True)}, "EV014", "8e+04 Hz"),
    ({"model": SensorModel(shot_hz=1e6)}, "EV014", "shot_hz"),
    ({"camera": {"theta_on": 0.2}}, "EV020", "Camera.constant("),
    ({"camera": 0.2}, "EV020", "camera is of type float"),
    ({"model": "v2e"}, "EV020", "SensorModel(cutoff_hz=100.0)"),
    ({"key": 0}, "EV020", "key is 0. Give a key of jax.random"),
    ({"key": None}, "EV020", "key is None"),
    ({"key": np.random.default_rng(0)}, "EV020", "jax.random.key(0)"),
    ({"key": jax.random.split(KEY)}, "EV020", "keys of shape (2,)"),
    ({"key": jax.random.split(jax.random.PRNGKey(0))}, "EV020", "keys of shape (2, 2)"),
    ({"key": np.zeros(3, np.uint32)}, "EV020", "key is array([0, 0, 0]"),
])
def test_bad_input_says_what_was_seen(changed: dict[str, Any], code: str, seen: str) -> None:
    given = {"key": KEY, "frames": frames(), "times_us": TIMES, "camera": CAMERA} | changed
    with pytest.raises(EvflowDataError) as raised:
        simulate(**given)
    assert raised.value.code == code
    assert seen in str(raised.value)


def test_more_events_than_memory_holds_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    flash = np.stack([np.zeros(SHAPE), np.full(SHAPE, 255.0), np.zeros(SHAPE)]).astype(np.uint8)
    camera = Camera.constant(SHAPE, theta_on=0.001, theta_off=0.001)
    events = len(simulate(KEY, flash, TIMES, camera))
    monkeypatch.setattr("evflow.simulator.pack.MOST_EVENTS", events - 1)
    with pytest.raises(EvflowDataError, match=r"EV014.* events between 3 frames, up to 5\.54e\+03"):
        simulate(KEY, flash, TIMES, camera)


def test_a_block_that_is_too_long_for_its_times_is_refused() -> None:
    year_us = 365 * 86_400_000_000
    assert len(Keys.of(1280 * 720, 50 * 86_400_000_000)(np.zeros(1), np.zeros(1))) == 1
    with pytest.raises(EvflowDataError, match=r"EV004.*lasts 365 days.*921,600 pixels"):
        Keys.of(1280 * 720, year_us)


def test_simulate_cannot_be_traced() -> None:
    """How many events there are is known at the end alone."""
    def events(on: jax.Array) -> jax.Array:
        return jnp.asarray(simulate(KEY, frames(), TIMES, dataclasses.replace(CAMERA, theta_on=on)))

    for transform in (jax.jit, jax.vmap, jax.jacfwd):
        with pytest.raises(EvflowDataError, match=r"EV020.*take simulate_voxels"):
            transform(events)(CAMERA.theta_on)


def test_the_same_input_unharmed_is_accepted() -> None:
    """So that none of the refusals above is for another reason."""
    for dtype in (np.uint8, np.uint16, np.float32, np.float64, np.float16):
        scale = 257 if dtype == np.uint16 else 1
        assert len(simulate(KEY, scale * frames(dtype=dtype), TIMES, CAMERA)) == 0
    assert len(simulate(KEY, with_value(255.0), TIMES.astype(np.uint32), CAMERA)) > 0
    assert len(simulate(jax.random.PRNGKey(0), with_value(255.0), TIMES, CAMERA)) > 0


@pytest.mark.parametrize(("blocks", "times", "code", "seen"), [
    ([frames(), frames()], [TIMES], "EV002", "the times end after 3 frames"),
    ([frames()], [TIMES, TIMES + 5000], "EV002", "the frames end after 3 frames"),
    ([frames()], [TIMES[:2]], "EV002", "(2,)"),
    ([frames(), frames(dtype=np.float32)], [TIMES, TIMES + 5000], "EV003", "frame 3 is float32"),
    ([frames(), frames()], [TIMES, TIMES + 2000], "EV004", "frame 3 is at 2000 us"),
    ([frames(), frames()[:, :2]], [TIMES, TIMES + 5000], "EV015", "(2, 6)"),
    ([frames(dtype=np.float32), with_value(np.nan)], [TIMES, TIMES + 5000], "EV007", "frame 4"),
    ([], [], "EV001", "no frames"),
    ([frames(0), frames(1)], [TIMES[:0], TIMES[:1]], "EV001", "one frame"),
])
def test_bad_streams_are_refused_where_they_turn_bad(
    blocks: list, times: list, code: str, seen: str
) -> None:
    with pytest.raises(EvflowDataError) as raised:
        list(simulate_stream(KEY, blocks, times, CAMERA))
    assert raised.value.code == code
    assert seen in str(raised.value)


LOG = jnp.full((3, *SHAPE), 4.0)


@pytest.mark.parametrize(("changed", "code"), [
    ({"log_frames": LOG[0]}, "EV002"),
    ({"log_frames": LOG[:1]}, "EV002"),
    ({"frame_dt_s": 0.0}, "EV020"),
    ({"frame_dt_s": -1e-3}, "EV020"),
    ({"frame_dt_s": float("nan")}, "EV020"),
    ({"frame_dt_s": float("inf")}, "EV020"),
    ({"frame_dt_s": np.array([1e-3, 2e-3])}, "EV020"),
    ({"frame_dt_s": None}, "EV020"),
    ({"frame_dt_s": "1e-3"}, "EV020"),
    ({"bins": 1}, "EV020"),
    ({"bins": 5.0}, "EV020"),
    ({"camera": Camera.constant((6, 4))}, "EV015"),
    ({"camera": Camera.constant((2, *SHAPE))}, "EV015"),
    ({"camera": Camera.constant((2, *SHAPE)), "log_frames": jnp.stack([LOG] * 3)}, "EV015"),
    ({"camera": dataclasses.replace(CAMERA, theta_on=-CAMERA.theta_on)}, "EV014"),
    ({"camera": Camera.constant(SHAPE, eta_on=1e6)}, "EV014"),
    ({"model": SensorModel(shot_hz=1e6)}, "EV014"),
])
def test_simulate_voxels_refuses_bad_input(changed: dict[str, Any], code: str) -> None:
    given = {"log_frames": LOG, "camera": CAMERA, "frame_dt_s": 1e-3} | changed
    assert code_of(lambda: simulate_voxels(KEY, **given)) == code


def test_nan_log_frames_are_refused() -> None:
    frames = np.zeros((3, 4, 5), np.float32)
    frames[1, 2, 3] = np.nan
    with pytest.raises(EvflowDataError, match="EV007"):
        simulate_voxels(jax.random.key(0), frames, Camera.constant((4, 5)), frame_dt_s=1e-3)


@pytest.mark.parametrize("simulated", [simulate_voxels, simulate_counts])
def test_logarithms_of_another_map_are_refused(simulated: Callable[..., jax.Array]) -> None:
    """Each map's own pass, from black to white; within jit values are not known."""
    dn = np.linspace(0, 255, 3 * SHAPE[0] * SHAPE[1]).reshape(3, *SHAPE)

    def of(log_map: str, model: SensorModel | None) -> jax.Array:
        return simulated(KEY, to_log(dn, log_map), CAMERA, frame_dt_s=1e-3, model=model)

    assert float(of("linlog", None).sum()) > 0
    assert float(of("log_eps", SensorModel(kind="esim")).sum()) > 0
    assert float(of("log_eps", SensorModel(log_map="log_eps")).sum()) > 0
    with pytest.raises(EvflowDataError, match=r"EV003.*down to -6\.9.*log_map='log_eps'"):
        of("log_eps", None)
    with pytest.raises(EvflowDataError, match=r"EV003.*log_map is 'log_eps'.*, 'log_eps'\)"):
        of("linlog", SensorModel(kind="esim"))
    jax.jit(lambda log: simulated(KEY, log, CAMERA, frame_dt_s=1e-3))(to_log(dn, "log_eps"))


def test_brightness_in_place_of_logarithms_is_refused() -> None:
    with pytest.raises(EvflowDataError, match=r"EV003.*mean of 100"):
        simulate_voxels(KEY, np.full((3, *SHAPE), 100.0, np.float32), CAMERA, frame_dt_s=1e-3)


@pytest.mark.parametrize("which", [0, 1])
def test_a_stream_is_of_iterables(which: int) -> None:
    given: list[Any] = [[], []]
    given[which] = 3
    with pytest.raises(EvflowDataError, match=r"EV020.*is of type int"):
        simulate_stream(jax.random.key(0), *given, Camera.constant((4, 5)))

"""The simulator against v2e itself: per-pixel event counts, polarity by polarity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.camera import Camera
from evflow.camera.sensors import SENSORS, SensorModel
from evflow.simulator import simulate
from evflow.types import Events

pytestmark = pytest.mark.usefixtures("optimised")

SMALL = Path(__file__).parents[1] / "data" / "small_v2e.npz"
TOLERANCE = 0.005  # of the total: what exact threshold ties of 8-bit video may move
CASES: dict[str, tuple[float, float, dict[str, Any]]] = {
    "base": (0.2, 0.2, {}),
    "asym": (0.3, 0.15, {}),
    "theta05": (0.5, 0.5, {}),
    "cutoff100": (0.2, 0.2, {"cutoff_hz": 100.0}),
    "refractory2ms": (0.2, 0.2, {"refractory_s": 2e-3}),
    "leak5": (0.2, 0.2, {"leak_hz": 5.0}),
}
BIG_CASES: dict[str, tuple[float, float, dict[str, Any]]] = {
    "base": (0.2, 0.2, {}),
    "th0.1": (0.1, 0.1, {}),
    "cutoff300": (0.2, 0.2, {"cutoff_hz": 300.0}),
    "refr0.5ms": (0.2, 0.2, {"refractory_s": 0.5e-3}),
    "leak1_nojit": (0.2, 0.2, {"leak_hz": 1.0}),
}


def run(frames: np.ndarray, times: np.ndarray, case: tuple, timestamps: str) -> Events:
    on, off, options = case
    model = SensorModel(timestamps=timestamps, **options)  # type: ignore[arg-type]
    nothing = jnp.zeros(frames.shape[1:])
    camera = Camera(on + nothing, off + nothing, nothing, nothing)
    return simulate(jax.random.key(0), frames, times, camera, model=model)


def compare(events: Events, golden: Any, name: str) -> None:
    """Sum of |per-pixel difference| within TOLERANCE of the golden total, ON and OFF apart."""
    for ours, side in zip(events.count_map().astype(int), ("on", "off"), strict=True):
        theirs = golden[f"{name}_{side}"]
        difference = np.abs(ours - theirs)
        assert difference.sum() <= TOLERANCE * theirs.sum(), (
            f"{name} {side}: {difference.sum()} of {theirs.sum()} events differ, on "
            f"{np.count_nonzero(difference)} pixels")


@pytest.mark.parametrize("name", CASES)
def test_counts_are_v2es(name: str) -> None:
    with np.load(SMALL) as golden:
        events = run(golden["frames"], golden["times_us"], CASES[name], "v2e")
        compare(events, golden, name)


@pytest.mark.parametrize("name", ["base", "asym", "theta05"])
def test_crossing_times_move_no_event_to_another_frame(name: str) -> None:
    """Without a refractory period the counts do not depend on how events are stamped, where no
    contrast is a multiple of a threshold."""
    with np.load(SMALL) as golden:
        frames, times = golden["frames"], golden["times_us"]
        compare(run(frames, times, CASES[name], "crossing"), golden, name)
    on, off, options = CASES[name]
    spread = 1.0 + 0.03 * np.random.default_rng(0).standard_normal((2, *frames.shape[1:]))
    maps = on * spread[0], off * spread[1]
    crossing, slots = (run(frames, times, (*maps, options), stamps) for stamps in (
        "crossing", "v2e"))
    np.testing.assert_array_equal(crossing.count_map(), slots.count_map())
    edges = times + 1  # events of a frame lie in (t_prev, t_now]
    moved = np.histogram(crossing.t, edges)[0] - np.histogram(slots.t, edges)[0]
    assert np.abs(moved).sum() <= 1e-4 * len(slots)  # those within 1e-6 of a threshold
    assert len(np.unique(crossing.t)) > 20 * len(np.unique(slots.t))


@pytest.mark.parametrize("theta", [0.1, 0.2, 0.25, 0.35])
@pytest.mark.parametrize("model", ["clean", "esim"])
def test_a_pixel_that_returns_to_its_value_returns_all_its_events(theta: float, model: str) -> None:
    """Twice as bright and back, ten times: a contrast of k thresholds crosses k times."""
    dark = np.arange(21, 128)
    frames = np.stack([dark] + [2 * dark, 2 * dark, dark, dark] * 10)[:, None].astype(np.uint8)
    camera = Camera.constant(frames.shape[1:], theta, theta)
    events = simulate(jax.random.key(0), frames, 1000 * np.arange(len(frames)), camera,
                      model=SENSORS[model].model)
    np.testing.assert_array_equal(events.count_map(), 10 * int(np.log(2.0) / theta))


@pytest.mark.slow
@pytest.mark.parametrize("name", BIG_CASES)
def test_counts_are_v2es_on_a_sensor_sized_video(
    name: str, data_file: Callable[[str], Path]
) -> None:
    video = data_file("goldens/bench_video.npz")
    with np.load(data_file("goldens/v2e_counts.npz")) as golden, np.load(video) as source:
        frames = source["frames"]
        times = 1000 * np.arange(len(frames))
        events = run(frames, times, BIG_CASES[name], "v2e")
        compare(events, golden, name)
        per_frame = golden[f"{name}_per_frame"]
    ours = np.histogram(events.t, times + 1)[0]  # the golden's first entry is the silent frame 0
    assert np.abs(ours - per_frame[1:]).sum() <= TOLERANCE * per_frame.sum()

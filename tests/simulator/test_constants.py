"""The pixel circuit's numbers are leaves: one program serves all cameras, gradients reach them."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import SHAPE, code_of, drifting, milliseconds

from evflow.camera import Camera
from evflow.camera.sensors import NUMBERS, SecondOrder, SensorModel
from evflow.light.log_maps import to_log
from evflow.simulator import simulate, simulate_counts, simulate_voxels
from evflow.simulator.constants import Constants

KEY = jax.random.key(0)
CAMERA = Camera.constant(SHAPE, 0.15, 0.2, 30.0, 15.0)
QUIET = Camera.constant(SHAPE, 0.15, 0.2)
FRAMES = drifting(33)
LOG = to_log(FRAMES)
ALL = SensorModel(cutoff_hz=200.0, leak_hz=20.0, leak_fpn_decades=0.2, leak_jitter=0.1,
                  shot_hz=40.0, noise_resets_memory=True, refractory_s=3e-4)
VOLTMETER = SensorModel(kind="voltmeter")


def scaled(model: SensorModel, by: float) -> SensorModel:
    return jax.tree.map(lambda number: by * number, model)


def events(model: SensorModel) -> float:
    return len(simulate(KEY, FRAMES, milliseconds(33), CAMERA, model=model))


def voxels(model: SensorModel) -> float:
    return float(simulate_voxels(KEY, LOG, CAMERA, frame_dt_s=1e-3, model=model).sum())


def counts(model: SensorModel) -> float:
    return float(simulate_counts(KEY, LOG, CAMERA, frame_dt_s=1e-3, model=model).sum())


@pytest.mark.parametrize(("made", "model"), [
    (events, ALL), (events, SensorModel(refractory_s=1e-3)), (events, VOLTMETER), (voxels, ALL),
    (counts, ALL)])
def test_three_cameras_share_their_programs(
    made: Callable[[SensorModel], float], model: SensorModel, caplog: pytest.LogCaptureFixture
) -> None:
    first = made(model)
    with jax.log_compiles(), caplog.at_level(logging.WARNING, "jax"):
        others = [made(scaled(model, by)) for by in (0.8, 1.5)]
    compiled = [r.getMessage() for r in caplog.records if "ompiling" in r.getMessage()]
    assert not compiled
    assert len({first, *others}) == 3  # the numbers matter
    with jax.log_compiles(), caplog.at_level(logging.WARNING, "jax"):
        jax.jit(lambda x: x + 1.5)(1.0)
    assert any("ompiling" in r.getMessage() for r in caplog.records)  # or nothing would be counted


def test_a_model_is_a_tree_of_the_numbers_that_are_on() -> None:
    model = SensorModel(cutoff_hz=100, shot_hz=np.float32(2.0), eta_intensity=True)
    names = [path[0].name for path, _ in jax.tree_util.tree_leaves_with_path(model)]
    assert names == ["cutoff_hz", "shot_hz"]
    assert jax.tree.map(lambda number: number, model) == model
    assert jax.tree.structure(model) == jax.tree.structure(dataclasses.replace(model, shot_hz=5.0))
    assert jax.tree.structure(model) != jax.tree.structure(dataclasses.replace(model, leak_hz=1.0))
    assert hash(model) == hash(SensorModel(cutoff_hz=100.0, shot_hz=2.0, eta_intensity=True))
    assert len(jax.tree.leaves(VOLTMETER)) == 6
    jax.tree.map(lambda a, b: None, model, jax.eval_shape(lambda m: m, model))


def test_a_traced_number_counts_as_on_and_0_gives_what_0_gives() -> None:
    """Two models at once, of the same program: one with nothing on, one with everything."""
    numbers = {name: getattr(ALL, name) for name in NUMBERS}

    def made(share: jax.Array) -> jax.Array:
        model = SensorModel(**{n: share * v for n, v in numbers.items()}, noise_resets_memory=True)
        return simulate_counts(KEY, LOG, CAMERA, frame_dt_s=1e-3, model=model)

    off, on = jax.vmap(made)(jnp.array([0.0, 1.0]))
    silent = SensorModel(noise_resets_memory=True)
    for found, model in ((off, silent), (on, ALL)):
        expected = simulate_counts(KEY, LOG, CAMERA, frame_dt_s=1e-3, model=model)
        assert float((found != expected).mean()) < 0.01  # rounding decides ties
        assert float(jnp.abs(found - expected).max()) <= 1


@pytest.mark.parametrize(("model", "names"), [
    (SensorModel(cutoff_hz=150.0), ("cutoff_hz",)),
    pytest.param(SensorModel(photoreceptor=SecondOrder(amplifier_s=1e-3)),
                 ("input_s", "amplifier_s"), marks=pytest.mark.slow)])
def test_gradients_reach_what_is_slow_through_times_of_events(
    model: SensorModel, names: tuple[str, ...]
) -> None:
    """A brighter and brighter pixel: its events come later the slower it follows."""
    log = jnp.broadcast_to(jnp.linspace(3.1, 5.3, 21)[:, None, None], (21, *SHAPE))
    when = jnp.arange(16.0)

    def mean_time(model: SensorModel) -> jax.Array:
        on = simulate_voxels(KEY, log, QUIET, frame_dt_s=1e-3, model=model)[..., :16]
        return jnp.vdot(on.sum((0, 1)), when) / jnp.sum(on)

    by_name = {path[-1].name: (float(value), float(slope)) for (path, value), slope in zip(
        jax.tree_util.tree_leaves_with_path(model), jax.tree.leaves(jax.grad(mean_time)(model)),
        strict=True)}
    for name in names:
        ahead, behind = (float(mean_time(jax.tree_util.tree_map_with_path(
            lambda path, value: value * by if path[-1].name == name else value,  # noqa: B023
            model))) for by in (1.005, 0.995))
        value, slope = by_name[name]
        assert value * slope == pytest.approx(100 * (ahead - behind), rel=0.02)
        assert abs(value * slope) > 0.1


@pytest.mark.parametrize("bad", [
    lambda: scaled(ALL, -1.0), lambda: scaled(ALL, np.nan),
    lambda: jax.tree.map(lambda number: jnp.full(3, number), ALL)])
def test_numbers_that_no_model_has_are_refused_where_it_is_used(
    bad: Callable[[], SensorModel]
) -> None:
    for use in (events, voxels, counts):
        assert code_of(partial(use, bad())) == "EV020"


@pytest.mark.parametrize(("simulation", "model"), [
    (simulate_voxels, ALL), (simulate_counts, ALL), (simulate_voxels, VOLTMETER),
    (simulate_voxels, SensorModel(photoreceptor=SecondOrder()))])
def test_impossible_numbers_give_nan_where_nothing_can_be_refused(
    simulation: Callable[..., jax.Array], model: SensorModel
) -> None:
    run = jax.jit(lambda m, dt: simulation(KEY, LOG[:3], CAMERA, frame_dt_s=dt, model=m))
    assert np.isfinite(run(model, 1e-3)).all()
    assert np.isnan(run(model, -1e-3)).all()
    leaves, made = jax.tree.flatten(model)
    for at in range(len(leaves)):
        wrong = np.nan if model.kind == "voltmeter" and at in (3, 4) else -1.0  # leak of any sign
        altered = jax.tree.unflatten(made, [*leaves[:at], wrong, *leaves[at + 1:]])
        assert np.isnan(run(altered, 1e-3)).all()


def test_a_traced_model_has_no_list_of_events() -> None:
    assert code_of(lambda: jax.jit(events)(ALL)) == "EV020"
    assert code_of(
        lambda: jax.jit(lambda hz: SensorModel(kind="esim", cutoff_hz=hz))(1.0)) == "EV020"
    assert Constants.of(ALL).corner == 2 * np.pi * 200.0

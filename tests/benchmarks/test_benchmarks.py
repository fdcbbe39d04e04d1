"""Every benchmark runs on tiny inputs and yields complete records; the peers compute what evflow
computes. Nothing here looks at a time."""

from __future__ import annotations

import functools
import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("tyro")

from benchmarks import bench_estimate, bench_simulator, bench_voxels
from benchmarks.__main__ import SUBJECTS, Options, main, select
from benchmarks.harness import Case, Record, Setting, Workload, absent, compare, facts, measure
from benchmarks.tables import table
from benchmarks.turns import by_task, in_turn
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.light.log_maps import uint8_table
from evflow.network import flow
from evflow.network.api import estimate_y
from evflow.network.architecture import config_of
from evflow.network.coordinates import unsquash_summary
from evflow.simulator import simulate, simulate_voxels
from evflow.voxel import voxelize

QUICK = Setting(quick=True)
RUN_FACTS = {"time", "platform", "python", "cpu", "cpus", "memory_gb", "load_before", "versions",
             "quick"}
UNITS = {"simulator": {"frames", "events", "GB"}, "voxels": {"events", "GB"},
         "io": {"events", "GB"}, "estimate": {"frames", "GFLOP"}, "train": set(),
         "networks": {"steps", "pixels"}}


@pytest.mark.parametrize("subject", ["simulator", "voxels", "io",
                                     pytest.param("estimate", marks=pytest.mark.slow),
                                     pytest.param("train", marks=pytest.mark.slow),
                                     pytest.param("networks", marks=pytest.mark.slow)])
def test_subject_yields_complete_records(subject: str, tmp_path: Path) -> None:
    out = tmp_path / "new" / "results.jsonl"
    assert main(Options(only=(subject,), quick=True, out=out)) == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    names = [(r["subject"], r["task"], r["implementation"]) for r in lines]
    assert names == [(c.subject, c.task, c.implementation) for c in select((subject,))]
    for r in lines:
        assert r["run"].keys() >= RUN_FACTS
        assert r["run"]["versions"].keys() >= {"evflow", "jax", "numpy"}
        assert not r["failed"]
        if r["skipped"]:
            assert "is not installed" in r["skipped"]
            continue
        assert r["seconds"] >= r["fastest"] > 0
        assert r["cpu"] > 0
        assert len(r["times"]) == 1
        assert r["relative"] > 0
        assert r["rates"].keys() == r["work"].keys() >= UNITS.get(r["subject"], set())
        for unit, amount in r["work"].items():
            assert r["rates"][unit] == pytest.approx(amount / r["seconds"])
        for task, unit in (("sgemm", "GFLOP"), ("copy", "GB")):
            assert (task in r["of_limit"]) == (unit in r["work"])
    assert {r["subject"] for r in lines if not r["skipped"]} == {"limits", subject}


def test_existing_results_are_kept(tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    out.write_text("mine")
    with pytest.raises(EvflowDataError, match="EV013"):
        main(Options(quick=True, out=out))
    assert out.read_text() == "mine"


def test_unknown_subject_is_named() -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*'speed'.*simulator"):
        select(("speed",))


def test_every_subject_has_limits_and_no_case_twice() -> None:
    cases = select(())
    names = [(c.subject, c.task, c.implementation) for c in cases]
    assert len(set(names)) == len(names)
    assert {c.task for c in SUBJECTS["limits"]} == {"sgemm", "copy"}


def _broken(_: Setting) -> Workload:
    raise ValueError("no such thing")


def _killed(_: Setting) -> Workload:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def _whole(_: Setting) -> Workload:
    return Workload(lambda: time.sleep(1e-3), lambda _: {"calls": 1.0})


def test_absent_package_skips_and_error_fails() -> None:
    missing = Case("voxels", "task", "peer", _broken, needs="no_such_package")
    assert "no_such_package is not installed" in measure(missing, QUICK).skipped


@pytest.mark.parametrize(("package", "extra"), [("torch", "bench"), ("h5py", "io")])
def test_an_absent_package_is_installed_by_its_extra(
    package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    record = absent(Case("io", "task", "peer", _broken, needs=package))
    assert record is not None
    assert f"evflow-jax[{extra}]" in record.skipped


def test_a_run_names_its_device_and_what_tunes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NPROC", "1")
    run = facts()
    assert run["environment"]["NPROC"] == "1"
    shown = table([Record("io", "task", "peer")], run | {"device": "a GPU"})
    assert str(shown.title).startswith(f"a GPU, {run['cpu']}, ")


def test_cases_of_a_task_take_turns_and_a_broken_one_costs_no_other() -> None:
    cases = [Case("voxels", "task", name, prepare) for name, prepare in
             (("evflow", _whole), ("broken", _broken), ("killed", _killed), ("peer", _whole))]
    ours, broken, killed, peer = compare(in_turn(cases, QUICK))
    assert broken.failed
    assert broken.skipped == "ValueError: no such thing"
    assert killed.failed
    assert killed.skipped == "its process ended with code -9"
    assert len(ours.times) == len(peer.times) >= 5
    assert peer.relative == np.median(np.array(peer.times) / np.array(ours.times))
    assert broken.relative is None


def test_tasks_are_kept_together() -> None:
    tasks = [[case.name[:2] for case in task] for task in by_task(select(()))]
    assert all(len(set(names)) == 1 for names in tasks)
    assert len({names[0] for names in tasks}) == len(tasks)


def test_compare_takes_the_best_limit_and_the_first_case() -> None:
    def record(subject: str, task: str, seconds: float | None, **work: float) -> Record:
        rates = {k: v / seconds for k, v in work.items()} if seconds else {}
        times = () if seconds is None else (seconds, seconds)
        return Record(subject, task, "x", seconds=seconds, times=times, work=work, rates=rates)

    *_, ours, peer, absent = compare([
        record("limits", "sgemm", 1.0, GFLOP=100.0), record("limits", "sgemm", 1.0, GFLOP=200.0),
        record("limits", "copy", 1.0, GB=8.0), record("estimate", "a", 2.0, GFLOP=100.0, GB=4.0),
        record("estimate", "a", 5.0, GFLOP=100.0), record("estimate", "a", None)])
    assert ours.of_limit == {"sgemm": 0.25, "copy": 0.25}
    assert (ours.relative, peer.relative, absent.relative) == (1.0, 2.5, None)
    assert peer.of_limit == {"sgemm": 0.1}


def test_video_has_the_events_it_promises() -> None:
    frames = bench_simulator.video(Setting(), 11)
    assert frames.shape == (11, 260, 346)
    assert frames.dtype == np.uint8
    changed = np.mean(frames[1:] != frames[:-1])
    assert 0.2 < changed < 0.95  # textured, and moving by a fraction of a pixel per frame


def test_numba_peer_sends_the_same_events() -> None:
    pytest.importorskip("numba")
    from benchmarks import peer_numba

    frames, table = bench_simulator.video(QUICK, 20), uint8_table("linlog")
    camera = Camera.sample(jax.random.key(1), frames.shape[1:], bench_simulator.PRIOR)
    pixels = peer_numba.Pixels.of(camera, SensorModel(), 1e-3)
    events = simulate(jax.random.key(0), frames, np.arange(20) * 1000, camera)
    x, y, t, p = peer_numba.simulate(frames, table, pixels)
    assert len(events) > 100
    assert (np.diff(t) >= 0).all()

    def rows(*columns: np.ndarray) -> np.ndarray:
        table = np.stack([c.astype(np.int64) for c in columns], 1)
        return table[np.lexsort(table.T)]

    theirs, ours = rows(x, y, p, t), rows(events.x, events.y, events.p, events.t)
    np.testing.assert_array_equal(theirs[:, :3], ours[:, :3])
    assert np.abs(theirs[:, 3] - ours[:, 3]).max() <= 1  # us, the rounding of a crossing
    log_frames = jnp.asarray(table)[frames]
    grid = simulate_voxels(jax.random.key(0), log_frames, camera, frame_dt_s=1e-3)
    np.testing.assert_allclose(
        peer_numba.simulate_voxels(frames, table, pixels, 16), grid, atol=2e-3)


def test_numba_peer_is_as_noisy() -> None:
    pytest.importorskip("numba")
    from benchmarks import peer_numba

    frames, table = np.full((401, 36, 48), 128, np.uint8), uint8_table("linlog")
    model = SensorModel(shot_hz=5.0, leak_hz=5.0, leak_jitter=0.1, noise_resets_memory=True)
    pixels = peer_numba.Pixels.of(Camera.constant(frames.shape[1:]), model, 1e-3)
    *_, p = peer_numba.simulate(frames, table, pixels)
    ours = simulate(jax.random.key(0), frames, np.arange(401) * 1000,
                    Camera.constant(frames.shape[1:]), model=model)
    for theirs, mine in ((p.sum(), ours.p.sum()), ((~p).sum(), (~ours.p).sum())):
        assert theirs > 900
        assert abs(int(theirs) - int(mine)) < 5 * (theirs + mine) ** 0.5
    grid = peer_numba.simulate_voxels(frames, table, pixels, 16)
    assert grid.sum() == pytest.approx(len(p), rel=1e-4)


def _scattered(params: Any) -> Any:
    """Every leaf moved, so that layers which start at zero count."""
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(0)
    return jax.tree.unflatten(
        tree, [leaf + 0.05 * rng.standard_normal(leaf.shape).astype(np.float32) for leaf in leaves])


def test_torch_peer_is_the_same_network() -> None:
    torch = pytest.importorskip("torch")
    from benchmarks import peer_torch

    params = _scattered(bench_estimate.network(QUICK)[0])
    config, net = config_of(params), peer_torch.weights(params["default"])
    voxels, dlogI = bench_estimate.window(QUICK)
    summary = bench_estimate.known_summary()
    ours = estimate_y(params, voxels, dlogI, window_s=0.05, summary=summary)
    n = dlogI.size
    y6 = torch.tensor(np.tile(np.asarray(unsquash_summary(summary)), (n, 1)))
    rows = torch.tensor(np.asarray(voxels)).reshape(n, -1)
    inputs = [rows, torch.tensor(np.asarray(dlogI)).reshape(n), torch.zeros(n, 3), y6]
    for run in (peer_torch.in_chunks, functools.partial(peer_torch.on_each_core, cores=3)):
        theirs = run(functools.partial(peer_torch.estimate, config=config), net, inputs, 100)
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(a.reshape(n, 4), b, rtol=2e-4, atol=2e-4)
    u = jax.random.normal(jax.random.key(1), (n, config.flow.condition))
    exact = jax.jit(flow.forward, static_argnums=3)(
        params["default"]["flow"], voxels.reshape(n, -1), u, config.flow)
    peer = peer_torch.flow(net["flow"], rows, torch.tensor(np.asarray(u)), config.flow)
    for a, b in zip(exact, peer, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-4)


def test_add_at_peer_fills_the_same_grid() -> None:
    events = bench_voxels.random_events(QUICK)
    ours = voxelize(events, 0, bench_voxels.WINDOW_US)
    np.testing.assert_allclose(bench_voxels.add_at(events), ours, atol=1e-5)


def test_dense_flop_counts_the_layers() -> None:
    params, _ = bench_estimate.network(QUICK)
    hidden, condition = 16, 41
    steps = sum(2 * (c // 2 * hidden + condition * hidden + hidden**2 + hidden * c // 2)
                for c in (32, 16, 8, 4)) * 2
    injectors = sum(2 * (condition * hidden + hidden * 2 * c) for c in (32, 16, 8, 4))
    assert bench_estimate.dense_flop(params, "flow") == steps + injectors

"""One program on any devices: same batches, same gradients, and a run that survives.

Processes are real, on this machine's loopback; their devices are shares of its CPU. They compile
without LLVM's optimisations (three times faster) into one cache.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.processes import PATIENCE_S, TESTS, Processes, free_port

from evflow.errors import EvflowDataError
from evflow.network.weights import load_weights
from evflow.process import devices
from evflow.process.terminal import INTERRUPTED
from evflow.training.checkpoint import Checkpoints
from evflow.training.log import Log
from evflow.training.options import TrainOptions
from evflow.training.run import configuration

pytestmark = pytest.mark.timeout(1500)
Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    started = Processes(tmp_path_factory.mktemp("processes"))
    yield started
    started.stop()


# One process, no other devices: nothing is joined, nothing is split.


def test_only_a_launcher_of_several_processes_is_joined() -> None:
    slurm = {name: "1" for name in devices.LAUNCHERS[0]}
    mpi = {name: "1" for name in devices.LAUNCHERS[1]}
    assert not devices.launched({})
    assert not devices.launched(slurm)
    assert devices.launched(slurm | {"SLURM_NTASKS": "2"})
    assert devices.launched(mpi | {"OMPI_COMM_WORLD_SIZE": "4"})
    # sbatch without srun, salloc: a single process in a larger allocation.
    assert not devices.launched({"SLURM_JOB_ID": "1", "SLURM_NTASKS": "2"})


@pytest.mark.parametrize("options", [
    ("127.0.0.1:1234", 2, None), (None, 2, 0), ("127.0.0.1", 2, 0), ("127.0.0.1:1234", 2, 2)])
def test_options_that_name_no_place_among_the_processes(options: tuple) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        devices.initialise(*options)


@pytest.mark.parametrize("vote", [True, False])
def test_alone_one_agrees_with_oneself(vote: bool) -> None:
    assert devices.agree(vote) is vote
    assert devices.is_main()


def test_without_a_mesh_nothing_is_split() -> None:
    def f(common: jax.Array, shard: jax.Array) -> jax.Array:
        return common + shard

    assert devices.by_shard(f) is f
    mesh = devices.make_mesh()
    step = devices.parallel(lambda x: devices.by_shard(f)(jnp.ones(()), x), mesh)
    np.testing.assert_array_equal(step(jnp.zeros(3)), np.ones(3))


def test_replicated_arrays_and_keys_are_themselves() -> None:
    tree = {"key": jax.random.key(3), "array": jnp.arange(3.0), "host": np.ones((2, 2))}
    same = devices.replicate(tree, devices.make_mesh())
    assert all(leaf.is_fully_replicated for leaf in jax.tree.leaves(same))
    np.testing.assert_array_equal(*(jax.random.key_data(t["key"]) for t in (tree, same)))
    np.testing.assert_array_equal(tree["array"], same["array"])


def test_scenes_must_divide_among_devices(tmp_path: Path) -> None:
    options = TrainOptions(out=tmp_path, preset="debug", scenes=3)
    assert configuration(options, 3).scenes == 3
    with pytest.raises(EvflowDataError, match=r"EV020.*--scenes 4"):
        configuration(options, 2)


def test_another_configuration_is_named(tmp_path: Path) -> None:
    saved = {"seed": 0, "steps": 20, "model": {"flow": {"levels": (1, 2)}}}
    with Checkpoints(tmp_path) as checkpoints:
        with pytest.raises(EvflowDataError, match="EV016"):
            checkpoints.check_config(saved)
        checkpoints.write_config(saved)
        checkpoints.check_config(saved)
        other = saved | {"steps": 30, "model": {"flow": {"levels": (1, 3)}}}
        with pytest.raises(EvflowDataError, match=r"EV013.*steps: 20 there, 30 here") as error:
            checkpoints.check_config(other)
    assert "model.flow.levels: [1, 2] there, [1, 3] here" in str(error.value)
    assert "seed" not in str(error.value)


def test_the_log_goes_on_from_the_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    for steps, cut in ((range(1, 5), '{"step": 5, "lo'), (range(3, 5), "")):
        with Log(path, 4, steps[0] - 1, lambda _: "training") as log:
            for step in steps:
                assert log.add(step, {"loss": jnp.float32(step)}) == ""
            log.flush()
        with path.open("a") as file:
            file.write(cut)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    assert log.figures == {"loss": 2.5}  # of all four steps, of whichever process


# One device, four devices, two processes of two devices.


@pytest.fixture(scope="module")
def probes(processes: Processes) -> dict[str, Path]:
    """What distributed_worker saw on each topology."""
    worker, out = TESTS / "helpers" / "distributed_worker.py", processes.folder
    processes.run(worker, out / "one", 10)
    processes.run(worker, out / "four", 10, devices=4)
    address = f"127.0.0.1:{free_port(20000, 30000)}"
    processes.end_well(*[
        processes.start(worker, out / "two", 10, address, 2, i, devices=2) for i in range(2)])
    return {name: out / name for name in ("one", "four", "two")}


def arrays(probe: Path, prefix: str) -> Arrays:
    """The arrays of a run, the shards of all processes put together."""
    shards: dict[str, dict[int, np.ndarray]] = {}
    for path in probe.parent.glob(f"{probe.name}.*.npz"):
        with np.load(path) as file:
            for key in (k for k in file if k.startswith(prefix)):
                name, _, row = key.partition("/")
                shards.setdefault(name, {})[int(row)] = file[key]
    return {name: np.concatenate([parts[row] for row in sorted(parts)])
            for name, parts in shards.items()}


@pytest.mark.slow
@pytest.mark.parametrize("topology", ["four", "two"])
def test_batches_are_bitwise_the_same(probes: dict[str, Path], topology: str) -> None:
    one, other = (arrays(probes[name], "batch") for name in ("one", topology))
    assert one.keys() == other.keys()
    assert one["batch.voxels"].shape[0] == 8
    for name in one:
        np.testing.assert_array_equal(other[name], one[name], err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("topology", ["four", "two"])
@pytest.mark.parametrize("what", ["gradients", "params"])
def test_steps_agree_to_rounding(probes: dict[str, Path], topology: str, what: str) -> None:
    """Measured: gradients of the first step within 1.0e-6 of each leaf's largest value, parameters
    after ten steps within 1.1e-6."""
    one, other = (arrays(probes[name], what) for name in ("one", topology))
    assert one.keys() == other.keys()
    assert len(one) > 20
    for name in one:
        scale = max(float(np.abs(one[name]).max()), 1e-30)
        np.testing.assert_allclose(other[name], one[name], rtol=0, atol=1e-5 * scale, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("topology", ["four", "two"])
def test_no_device_sees_the_whole_batch(probes: dict[str, Path], topology: str) -> None:
    """Each device's program holds voxels of 2 of the 8 sequences, and exchanges sums alone."""
    one, other = (Path(f"{probes[name]}.0.txt").read_text() for name in ("one", topology))
    assert "f32[8,2,16,16,32]" in one
    assert "f32[8,2,16,16,32]" not in other
    assert "f32[2,2,16,16,32]" in other
    assert "all-reduce(" in other
    for gather in ("all-gather", "all-to-all", "collective-permute"):
        assert gather not in other


# A run that stops, moves and goes on.

TRAIN = ("-m", "experiments.train", "--preset", "debug", "--scenes", 4)
ONE_STEP = ("--max-seconds", 0.1)  # less than the first takes, with its compilation
QUICK = (*TRAIN, "--parts", "summary", "--steps", 5000)  # half the compilation; ends by a signal


def steps_logged(out: Path) -> list[int]:
    path = out / "metrics.jsonl"
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [json.loads(line)["step"] for line in lines]


def wait_for(condition: Callable[[], bool], alive: list[subprocess.Popen[str]]) -> None:
    limit = time.monotonic() + PATIENCE_S
    while not condition():
        assert all(p.poll() is None for p in alive), "a process ended early"
        assert time.monotonic() < limit, "nothing happened"
        time.sleep(0.05)


def goes_on_alone(processes: Processes, out: Path) -> None:
    """One more step on one device: from the last checkpoint, no step logged twice."""
    with Checkpoints(out) as checkpoints:
        latest = checkpoints.latest
    assert latest is not None
    processes.run(*QUICK, "--out", out, "--resume", "must", *ONE_STEP)
    assert steps_logged(out) == list(range(1, latest + 2))


@pytest.mark.slow
def test_sigterm_to_one_process_saves_and_stops_all(processes: Processes) -> None:
    out = processes.folder / "stopped"
    address = f"127.0.0.1:{free_port(30000, 40000)}"
    both = [processes.start(*QUICK, "--out", out, "--coordinator", address, "--processes", 2,
                            "--process-id", i, devices=2) for i in range(2)]
    wait_for(lambda: len(steps_logged(out)) >= 3, both)
    both[1].send_signal(signal.SIGTERM)
    processes.end_well(*both, code=INTERRUPTED)
    with Checkpoints(out) as checkpoints:
        assert checkpoints.latest == len(steps_logged(out)) >= 3
    goes_on_alone(processes, out)


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_dead_process_ends_the_run(processes: Processes, victim: int) -> None:
    """Process 0 coordinates; both save after every step, so death comes while they write. Started
    as Slurm would."""
    out = processes.folder / f"died{victim}"
    job = free_port(61440, 65535) - 61440  # Slurm's coordinator port is 61440 + job mod 4096
    both = [processes.start(
        *QUICK, "--out", out, "--save-every", 1, devices=2, SLURM_JOB_ID=str(job),
        SLURM_STEP_NODELIST="127.0.0.1", SLURM_NTASKS="2", SLURM_PROCID=str(i),
        SLURM_LOCALID=str(i), SLURM_STEP_NUM_NODES="1") for i in range(2)]
    wait_for(lambda: len(steps_logged(out)) >= 3, both)
    both[victim].kill()
    assert both[1 - victim].wait(30) != 0
    goes_on_alone(processes, out)


@pytest.mark.slow
def test_resume_is_exact_on_as_many_devices_and_close_on_others(processes: Processes) -> None:
    weights: dict[str, Arrays] = {}
    three = (*TRAIN, "--steps", 3)
    for first, then in ((4, 4), (4, 1), (1, 4)):
        out = processes.folder / f"from{first}to{then}"
        start = processes.folder / f"start{first}"
        if not start.exists():
            processes.run(*three, "--out", start, *ONE_STEP, devices=first)
            assert steps_logged(start) == [1]
        shutil.copytree(start, out)
        processes.run(*three, "--out", out, "--resume", "must", devices=then)
        assert steps_logged(out) == [1, 2, 3]
        weights[f"{first}{then}"] = flat(out)
    straight = processes.folder / "straight"
    processes.run(*three, "--out", straight, devices=4)
    expected = flat(straight)
    for name, leaf in expected.items():
        np.testing.assert_array_equal(weights["44"][name], leaf, err_msg=name)
        for moved in ("41", "14"):
            # Gradients differ by the order of sums, 1e-6 of a leaf's largest. Adam divides each
            # by its own size: where that is a hundredth of the largest, a step differs by 1e-4.
            scale = max(float(np.abs(leaf).max()), 1e-30)
            np.testing.assert_allclose(weights[moved][name], leaf, rtol=0, atol=1e-4 * scale)
            off = np.linalg.norm(weights[moved][name] - leaf) / max(np.linalg.norm(leaf), 1e-30)
            assert off <= 1e-5, name  # all elements together do not


def flat(out: Path) -> Arrays:
    params = load_weights(out / "weights.safetensors")
    return {jax.tree_util.keystr(path): np.asarray(leaf)
            for path, leaf in jax.tree_util.tree_leaves_with_path(params)}

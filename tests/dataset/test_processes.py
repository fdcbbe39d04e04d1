"""Makers of data sets that are killed or told to stop, in real processes."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.datasets import assert_tidy, cached_compilation, contents
from helpers.processes import PATIENCE_S, Processes

from evflow.dataset import verify
from evflow.dataset.manifest import Manifests
from evflow.process.terminal import INTERRUPTED

COMMAND = ("-m", "experiments.make_dataset", "--preset", "debug")


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """They share what they have compiled."""
    with cached_compilation():
        started = Processes(tmp_path_factory.mktemp("processes"))
        yield started
        started.stop()


def recorded(folder: Path) -> int:
    return sum(map(len, (json.loads(p.read_text())["sequences"]
                         for p in (folder / "manifests").glob("*.json"))))


def when_some_are_made(process: subprocess.Popen[str], folder: Path) -> None:
    """Wait until the process is in the midst of its sequences."""
    give_up = time.monotonic() + PATIENCE_S
    while recorded(folder) < 3:
        assert process.poll() is None
        assert time.monotonic() < give_up
        time.sleep(0.01)


@pytest.mark.slow
def test_a_killed_shard_is_made_good(tmp_path: Path, processes: Processes) -> None:
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    command = (*COMMAND, "--train", 100, "--test", 20)
    processes.run(*command, "--out", straight)
    victim = processes.start(*command, "--out", killed, "--shard", "2/4")
    when_some_are_made(victim, killed)
    victim.kill()
    victim.wait()
    assert 0 < recorded(killed) < 30
    found = Manifests.read(killed)
    for path in killed.glob("t*/*.h5"):
        assert found.fault(f"{path.parent.name}/{path.stem}", "dsec") is None
    processes.end_well(*[processes.start(*command, "--out", killed, "--shard", f"{i}/4")
                         for i in (0, 1, 3)])
    verdict = processes.start(*COMMAND, "--out", killed, "--verify")
    assert verdict.wait(PATIENCE_S) == 1
    processes.run(*command, "--out", killed, "--only-missing")
    assert contents(killed) == contents(straight)
    assert len(contents(killed)) == 120
    assert verify(killed) == {}
    assert_tidy(killed)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "workers"), [
    (signal.SIGTERM, 1), (signal.SIGINT, 2), (signal.SIGKILL, 2)])
def test_signals_leave_nothing_half_done(
    tmp_path: Path, processes: Processes, number: signal.Signals, workers: int
) -> None:
    folder = tmp_path / "set"
    command = (*COMMAND, "--train", 60, "--test", 0, "--out", folder, "--workers", workers)
    process = processes.start(*command)
    when_some_are_made(process, folder)
    family = children(process.pid)
    assert (len(family) >= 2) == (workers == 2)
    process.send_signal(number)
    assert process.wait(PATIENCE_S) == (-9 if number == signal.SIGKILL else INTERRUPTED)
    if number != signal.SIGKILL:
        assert_tidy(folder)
    give_up = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() for pid in family):
        assert time.monotonic() < give_up
        time.sleep(0.05)
    assert 0 < len(contents(folder)) < 60
    processes.run(*command)
    assert verify(folder) == {}
    assert_tidy(folder)


def children(pid: int) -> list[int]:
    """The processes that it started, by /proc; none where that is absent."""
    lists = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for path in lists for child in path.read_text().split()]

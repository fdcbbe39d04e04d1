"""Worker processes do not outlive their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from evflow.process.workers import worker_pool

PARENT = """
import multiprocessing, time
from evflow.process.workers import worker_pool

if __name__ == "__main__":
    with worker_pool(2, time.sleep, 0.01) as pool:
        naps = [pool.submit(time.sleep, 300) for _ in range(2)]
        while not all(nap.running() for nap in naps):
            time.sleep(0.05)
        print(*(child.pid for child in multiprocessing.active_children()), flush=True)
        time.sleep(300)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_parent(tmp_path: Path, number: signal.Signals) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(workers) == 2
        assert all(map(lives, workers))
        parent.send_signal(number)
        assert parent.wait(30) == -number
    give_up = time.monotonic() + 30
    while any(map(lives, workers)):
        assert time.monotonic() < give_up
        time.sleep(0.05)


def test_workers_are_prepared_and_end_with_the_block() -> None:
    with worker_pool(1, os.putenv, "EVFLOW_TEST", "prepared") as pool:
        assert pool.submit(subprocess.check_output, ["printenv", "EVFLOW_TEST"]).result(
            30) == b"prepared\n"
        others = multiprocessing.active_children()
        pool.submit(time.sleep, 300)
    assert not any(worker.is_alive() for worker in others)


def lives(pid: int) -> bool:
    """Whether a process is there, and is more than a zombie that nobody has waited for."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"

"""Memory that is free."""

from __future__ import annotations

import subprocess
import sys

import pytest

from evflow.process import memory
from evflow.process.memory import _of_c

WORK = """
import resource
from evflow.process import memory
{}
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def work():
    for _ in range(4):
        held = [bytearray(4 << 20) for _ in range(4)]
        del held
work()
before = faults()
work()
print(faults() - before)
"""


@pytest.mark.skipif(_of_c("mallopt") is None, reason="not glibc")
def test_freed_memory_is_kept_for_what_comes() -> None:
    def faults(line: str) -> int:
        return int(subprocess.run([sys.executable, "-c", WORK.format(line)], check=True,
                                  capture_output=True, text=True).stdout)

    pages = 16 * (4 << 20) // 4096
    assert faults("") > pages // 2
    assert faults("memory.keep()") < pages // 4


def test_a_small_process_gives_nothing_back(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(memory, "_of_c", lambda name: asked.append)
    assert memory.held() > 1 << 20
    for least, times in ((float("inf"), 0), (0, 1)):
        monkeypatch.setattr(memory, "SMALL", least)
        memory.give_back()
        assert len(asked) == times

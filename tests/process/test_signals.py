"""Signals that wait for the end of a step, and processes that are surely dead."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from evflow.process import alive
from evflow.process.alive import is_dead, mark
from evflow.process.signals import STOPPING, uninterrupted
from evflow.process.terminal import stoppable


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    before = [signal.getsignal(number) for number in STOPPING]
    yield
    assert [signal.getsignal(number) for number in STOPPING] == before


def interrupted(number: int, steps: list[str]) -> None:
    with uninterrupted():
        signal.raise_signal(number)
        signal.raise_signal(number)
        steps.append("whole")
    steps.append("after")


def test_a_signal_waits_for_the_end_of_the_block() -> None:
    steps: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted(signal.SIGINT, steps)
    assert steps == ["whole"]
    with pytest.raises(KeyboardInterrupt), stoppable():
        interrupted(signal.SIGTERM, steps)
    assert steps == ["whole", "whole"]


def test_blocks_within_blocks_wait_for_the_outermost() -> None:
    steps: list[str] = []

    def nested() -> None:
        with uninterrupted():
            interrupted(signal.SIGINT, steps)
            steps.append("outer")
        steps.append("after both")

    with pytest.raises(KeyboardInterrupt):
        nested()
    assert steps == ["whole", "after", "outer"]


def test_errors_of_the_block_come_out_beneath_the_signal() -> None:
    def wrong() -> None:
        with uninterrupted():
            raise ValueError("in the block")

    def both() -> None:
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            raise ValueError("in the block")

    with pytest.raises(ValueError, match="in the block"):
        wrong()
    with pytest.raises(KeyboardInterrupt) as raised:
        both()
    assert isinstance(raised.value.__context__, ValueError)


def test_what_the_system_does_itself_is_left_alone() -> None:
    with uninterrupted():
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with uninterrupted():
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def test_other_threads_have_no_handlers() -> None:
    ran = []

    def work() -> None:
        with uninterrupted():
            ran.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert ran


@pytest.mark.skipif(not os.path.exists("/proc/self/ns/pid"), reason="needs Linux's /proc")
def test_only_who_is_surely_dead_is_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_dead(mark())
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    here = mark().partition("-")[0]
    gone = f"{here}-{child.pid:x}"
    assert is_dead(gone)
    elsewhere = f"{int(here, 16) ^ 1:08x}-{child.pid:x}"  # another host, container or boot
    for text in (elsewhere, f"00000000-{child.pid:x}", f"{here}-{os.getppid():x}", f"{here}-1",
                 here, "", f"{here}-{'f' * 20}", f"{here}-0"):
        assert not is_dead(text), text
    monkeypatch.setattr(alive, "_here", lambda: "")
    assert not is_dead(gone)
    assert not is_dead(mark())

"""Reading ahead and writing behind: the order of one thread, its errors, and no thread left."""

from __future__ import annotations

import contextlib
import dis
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import cv2
import pytest

from evflow.process.threads import SWITCH_S, ahead, behind, beside, prompt


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = len(sys._current_frames())
    yield
    assert wait_for(before) <= before


def wait_for(threads: int) -> int:
    """Wait until so few threads run, or ten seconds. Returns their number."""
    deadline = time.monotonic() + 10
    while (now := len(sys._current_frames())) > threads and time.monotonic() < deadline:
        time.sleep(1e-3)
    return now


def counted(log: list[str], wrong_at: int = -1) -> Iterator[int]:
    try:
        for i in range(1000):
            if i == wrong_at:
                raise ValueError("no such frame")
            log.append(f"made {i}")
            yield i
    finally:
        log.append("closed by " + ("main" if threading.current_thread() is threading.main_thread()
                                   else "a thread"))


def test_items_come_in_order_from_a_thread() -> None:
    log: list[str] = []
    with ahead(counted(log), 3) as items:
        assert list(items) == list(range(1000))
    assert log[-1] == "closed by a thread"


def test_only_so_many_are_made_ahead_and_the_rest_never() -> None:
    log: list[str] = []
    with ahead(counted(log), 3) as items:
        assert [next(items), next(items)] == [0, 1]
    assert len(log) <= 2 + 3 + 1 + 1  # taken, ahead, in hand, closed
    assert log[-1] == "closed by a thread"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_comes_after_the_items_before_it(error: type[BaseException]) -> None:
    def items() -> Iterator[int]:
        yield from range(5)
        raise error("no such frame")

    got: list[int] = []
    with pytest.raises(error, match="no such frame"), ahead(items(), 2) as made:
        got.extend(made)
    assert got == list(range(5))


def test_calls_are_made_in_order_and_all_by_the_end() -> None:
    done: list[int] = []
    with behind(2) as later:
        for i in range(100):
            later(done.append, i)
            assert len(done) >= i - 3
    assert done == list(range(100))


def test_what_a_call_raises_ends_them_and_comes_out() -> None:
    done: list[int] = []

    def write(i: int) -> None:
        if i == 3:
            raise OSError("disk full")
        done.append(i)

    def written(last: int) -> None:
        with behind(2) as later:
            for i in range(last + 1):
                later(write, i)

    for last in (3, 99):  # at the end of the block; in the middle of it
        done.clear()
        with pytest.raises(OSError, match="disk full"):
            written(last)
        assert done == [0, 1, 2]


def test_calls_that_wait_are_dropped_where_the_block_raises() -> None:
    done: list[int] = []
    begun, go = threading.Event(), threading.Event()

    def slow() -> None:
        begun.set()
        go.wait(10)
        done.append(0)

    def interrupted() -> None:
        with behind(5) as later:
            later(slow)
            later(done.append, 1)
            begun.wait(10)
            threading.Timer(0.02, go.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert done == [0]  # what was under way was finished


def ahead_of_it() -> None:
    with ahead(range(5), 1) as items:
        assert list(items) == list(range(5))


def behind_it() -> None:
    with behind(1) as later:
        for _ in range(3):
            later(int)


@pytest.mark.parametrize("block", [ahead_of_it, behind_it])
def test_a_signal_at_any_point_ends_the_block_and_its_thread(block: Callable[[], None]) -> None:
    """As Ctrl-C in the main thread, at each point where Python looks for signals."""
    points = interrupted_at(block, 10**9)
    assert points > 30
    for point in range(points):
        before = len(sys._current_frames())
        with contextlib.suppress(KeyboardInterrupt):
            interrupted_at(block, point)
        assert wait_for(before) <= before, f"a thread is left after point {point}"


def interrupted_at(block: Callable[[], None], point: int) -> int:
    """Call it with a KeyboardInterrupt at this point. Returns the number of points passed."""
    passed = 0
    last: dict[FrameType, str] = {}

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal passed
        frame.f_trace_opcodes = True
        if event == "opcode":
            before = last.get(frame, "")
            last[frame] = dis.opname[frame.f_code.co_code[frame.f_lasti]]
            if before.startswith(("RESUME", "CALL", "JUMP_BACKWARD")):
                passed += 1
                if passed > point:
                    sys.settrace(None)
                    raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        block()
    finally:
        sys.settrace(before)
        last.clear()
    return passed


def test_threads_are_prompt_in_a_block_and_as_before_after_it() -> None:
    before = sys.getswitchinterval()
    with contextlib.suppress(KeyError), prompt():
        assert sys.getswitchinterval() == pytest.approx(SWITCH_S) != before
        raise KeyError
    assert sys.getswitchinterval() == before


@pytest.mark.parametrize(("cores", "steps", "left"), [(2, 3, 1), (1, 3, 1), (9, 3, 6)])
def test_opencv_takes_the_cores_that_are_left_in_a_block(
    cores: int, steps: int, left: int
) -> None:
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(cores)
        with contextlib.suppress(KeyError), beside(steps):
            assert cv2.getNumThreads() == left
            raise KeyError
        assert cv2.getNumThreads() == cores
    finally:
        cv2.setNumThreads(before)

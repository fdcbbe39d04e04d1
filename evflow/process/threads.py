"""Overlapping the steps of long work in threads: reading ahead and writing behind.

For steps that release the GIL: OpenCV, XLA, HDF5. Order and results are those of one thread.
Signals reach the main thread only, at any point, so the queues are of a kind that a signal cannot
leave locked, and each block ends its thread, also one whose start was interrupted.
"""

from __future__ import annotations

import _thread
import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar

T = TypeVar("T")

SWITCH_S = 5e-4


@contextlib.contextmanager
def ahead(items: Iterable[T], depth: int) -> Iterator[Iterator[T]]:
    """The same items, produced by a thread up to `depth` + 1 ahead of the reader. An exception is
    raised to the reader in place of the item."""
    made: SimpleQueue[tuple[T] | BaseException | None] = SimpleQueue()
    room = _room(depth)
    stopped = False

    def make() -> None:
        end: BaseException | None = None
        try:
            source = iter(items)
            with contextlib.ExitStack() as closing:
                closing.callback(getattr(source, "close", lambda: None))
                for item in source:
                    room.get()
                    if stopped:
                        break
                    made.put((item,))
        except BaseException as e:
            end = e
        made.put(end)

    def read() -> Iterator[T]:
        while isinstance(one := made.get(), tuple):
            room.put(None)
            yield one[0]
        if one is not None:
            raise one

    def end() -> None:
        nonlocal stopped
        stopped = True
        room.put(None)
        maker.end()

    maker = _Worker(make)
    try:
        maker.start()
        yield read()
        end()
    finally:
        end()


@contextlib.contextmanager
def behind(depth: int) -> Iterator[Callable[..., None]]:
    """A function later(do, *arguments): a thread makes these calls in order, up to `depth` behind.
    The block ends when all are made; if it raises, waiting calls are dropped. An exception in a
    call stops them and is raised by the next `later` or at the end of the block."""
    calls: SimpleQueue[Callable[[], Any] | None] = SimpleQueue()
    room = _room(depth)
    dropped = False
    failed: list[BaseException] = []

    def work() -> None:
        while (call := calls.get()) is not None:
            try:
                if not (failed or dropped):
                    call()
            except BaseException as e:
                failed.append(e)
            room.put(None)

    def later(do: Callable[..., Any], *arguments: Any) -> None:
        room.get()
        if failed:
            raise failed[0]
        calls.put(partial(do, *arguments))

    worker = _Worker(work)
    try:
        worker.start()
        yield later
        calls.put(None)
        worker.wait()
    except BaseException:
        dropped = True
        raise
    finally:
        calls.put(None)
        worker.end()
    if failed:
        raise failed[0]


@contextlib.contextmanager
def prompt() -> Iterator[None]:
    """Shorten the time that threads wait for Python after a short call of OpenCV or HDF5 to that of
    such a call; Python's default is ten times as long."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextlib.contextmanager
def beside(steps: int) -> Iterator[None]:
    """Limit OpenCV to the cores left by `steps` other threads, at least one: its threads spin while
    they wait for each other, often with small images."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(max(1, before - steps))
    try:
        yield
    finally:
        cv2.setNumThreads(before)


class _Worker:
    """A thread that a signal can interrupt at any point of its start and end. `threading.Thread` is
    not one: in `start`, a signal may leave its lock taken or released twice, and `join` raises if
    the start was interrupted."""

    def __init__(self, work: Callable[[], None]) -> None:
        self._work = work
        self._begun = self._cancelled = self._ended = False
        self._woken: SimpleQueue[None] = SimpleQueue()

    def start(self) -> None:
        _thread.start_new_thread(self._run, ())

    def wait(self) -> None:
        """Until the work has ended."""
        while not self._ended:  # a signal may take what wakes, but not the state
            self._woken.get()

    def end(self) -> None:
        """As wait; but work that has not begun never will."""
        self._cancelled = True
        if self._begun:
            self.wait()

    def _run(self) -> None:
        self._begun = True
        try:
            if not self._cancelled:
                self._work()
        finally:
            self._ended = True
            self._woken.put(None)


def _room(depth: int) -> SimpleQueue[None]:
    """A queue with `depth` slots."""
    room: SimpleQueue[None] = SimpleQueue()
    for _ in range(depth):
        room.put(None)
    return room

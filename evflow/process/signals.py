"""Signals that wait: for the end of a step that nothing may break off, or for a loop to look."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back while the block runs; their handlers run at its end.

    For code that calls Python back from C and drops what the call raises, as HDF5 does: a
    KeyboardInterrupt would be lost there, and a part of the file with it. What the system does
    itself (a handler of SIG_DFL or SIG_IGN) is left alone, and other threads have no handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {int(n): h for n in STOPPING if callable(h := signal.getsignal(n))}
    came: list[int] = []
    held = True

    def hold(number: int, frame: FrameType | None) -> None:
        if held:
            came.append(number)
        else:  # between the end of the block and `restore`, or where that was broken off
            before[number](number, frame)

    try:
        for number in before:
            signal.signal(number, hold)
        yield
    finally:
        held = False
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """A list that SIGINT and SIGTERM add themselves to; a second signal acts as usual."""
    requests: list[int] = []

    def ask(number: int, _: FrameType | None) -> None:
        requests.append(number)
        signal.signal(number, before[signal.Signals(number)])

    before = {n: signal.signal(n, ask) for n in STOPPING}
    try:
        yield requests
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""Deferred signals: until the end of a step that must not be interrupted, or until a loop
checks."""

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

    For C code that calls Python and drops exceptions, as HDF5 does: a KeyboardInterrupt would be
    lost there, and part of the file with it. Signals with the system's own handling (SIG_DFL,
    SIG_IGN) are unaffected; in threads other than the main one this does nothing.
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
        else:  # the block has ended, or `restore` itself was interrupted
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
    """A list to which SIGINT and SIGTERM append themselves; a second signal acts as usual."""
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

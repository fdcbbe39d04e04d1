"""One way to stop: a signal ends the block, wherever it comes."""

from __future__ import annotations

import signal
import sys
import time

import pytest

from evflow.progress import stoppable


def test_a_signal_ends_the_block_through_its_cleaning_up() -> None:
    cleaned = []

    def work() -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
            time.sleep(10)
        finally:
            cleaned.append(True)

    with pytest.raises(KeyboardInterrupt), stoppable():
        work()
    assert cleaned


def test_a_signal_where_exceptions_are_ignored_comes_again() -> None:
    class Collected:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)
            sys.getsizeof(self)  # the handler runs here at the latest, and raises

    def endless() -> None:
        Collected()
        for _ in range(1000):
            time.sleep(0.01)

    hook, handler = sys.unraisablehook, signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), stoppable():
        endless()
    assert (sys.unraisablehook, signal.getsignal(signal.SIGTERM)) == (hook, handler)

"""One way to stop: a signal ends the block, wherever it comes."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path

import pytest

from evflow.errors import EvflowDataError
from evflow.progress import INTERRUPTED, stoppable
from experiments import common


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


def test_scripts_end_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def left(code: int) -> None:
        raise SystemExit(code)

    def told() -> None:
        raise KeyboardInterrupt("stopped after step 3.")

    def wrong() -> None:
        raise EvflowDataError("EV001", "nothing.")

    monkeypatch.setattr(common, "leave", left)
    for work, code, line in (
        (lambda: signal.raise_signal(signal.SIGTERM), INTERRUPTED, "interrupted; no half-"),
        (told, INTERRUPTED, "stopped after step 3."), (wrong, "EV001 empty input: nothing.", ""),
        (lambda: 1, 1, ""), (lambda: {"figure": 2.0}, 0, ""),
    ):
        with pytest.raises(SystemExit) as end:
            common.end_with(work)
        assert end.value.code == code
        assert capsys.readouterr().err.startswith(line)


def test_all_scripts_end_alike() -> None:
    for path in Path(common.__file__).parent.glob("*.py"):
        _, main, last = path.read_text().partition('if __name__ == "__main__":\n')
        assert not main or last.startswith(("    run_script(main, ", "    end_with(")), path.name

"""One way to stop: a signal ends the block, wherever it comes."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from evflow.errors import EvflowDataError
from evflow.process import terminal
from evflow.process.terminal import INTERRUPTED, stoppable
from experiments.shared import common

TREE = Path(common.__file__).parents[2]


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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_that_is_lost_comes_again(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """As where compiled code calls Python and drops its exceptions."""
    monkeypatch.setattr(terminal, "LOST_S", 0.1)

    def endless() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        for _ in range(1000):
            time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt), stoppable():
        endless()


def test_cleaning_up_takes_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "LOST_S", 0.02)
    cleaned = []

    @contextlib.contextmanager
    def written() -> Iterator[None]:
        try:
            yield
        finally:
            with contextlib.suppress(ValueError):
                raise ValueError
            time.sleep(0.3)
            cleaned.append(True)

    def work() -> None:
        with written():
            signal.raise_signal(signal.SIGTERM)
            time.sleep(10)

    with pytest.raises(KeyboardInterrupt), stoppable():
        work()
    assert cleaned


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_amid_an_import_waits_for_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    for name in ("interrupted_import", "running_import"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "interrupted_import.py").write_text(
        f"import signal\nsignal.raise_signal({int(number)})\nwhole = True\n")
    monkeypatch.syspath_prepend(tmp_path)

    def work() -> None:
        import interrupted_import

        assert interrupted_import.whole
        time.sleep(10)

    with pytest.raises(KeyboardInterrupt), stoppable():
        work()
    # Of a block that is itself run by an import, no end of that import is waited for.
    (tmp_path / "running_import.py").write_text(
        "import signal, time\nfrom evflow.process.terminal import stoppable\n"
        f"with stoppable():\n    signal.raise_signal({int(number)})\n    time.sleep(10)\n")
    with pytest.raises(KeyboardInterrupt):
        import running_import  # noqa: F401


LOADING = """
import builtins, signal
import evflow.__main__

def loading(name, *rest, load=builtins.__import__):
    if name == "evflow.cli":
        signal.raise_signal(signal.SIGINT)
    return load(name, *rest)

builtins.__import__ = loading
evflow.__main__.run()
"""


def test_ctrl_c_while_modules_are_loaded_ends_quietly() -> None:
    run = subprocess.run([sys.executable, "-c", LOADING], capture_output=True, text=True,
                         timeout=60, env=os.environ | {"PYTHONPATH": str(TREE)})
    assert (run.returncode, run.stdout, run.stderr) == (INTERRUPTED, "", "")


def test_closed_standard_streams_lead_nowhere() -> None:
    run = subprocess.run(f"{sys.executable} -m evflow version >&- <&-", shell=True, timeout=60,
                         capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(TREE)})
    assert (run.returncode, run.stderr) == (0, "")


def test_scripts_whose_output_nobody_reads_end_quietly(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("from experiments.shared import common\n"
                      "common.end_with(lambda: print('line\\n' * 100_000))\n")
    run = subprocess.run(f"{sys.executable} {script} | head -n 1", shell=True, timeout=60,
                         capture_output=True, text=True, cwd=Path(common.__file__).parents[2],
                         env=os.environ | {"PYTHONPATH": str(Path(common.__file__).parents[2])})
    assert (run.stdout, run.stderr) == ("line\n", "")


def test_scripts_end_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def left(code: int) -> None:
        raise SystemExit(code)

    def ended() -> None:
        raise KeyboardInterrupt("stopped after step 3.")

    def wrong() -> None:
        raise EvflowDataError("EV001", "nothing.")

    monkeypatch.setattr(common, "leave", left)
    for work, code, line in (
        (lambda: signal.raise_signal(signal.SIGTERM), INTERRUPTED, "interrupted; no half-"),
        (ended, INTERRUPTED, "stopped after step 3."), (wrong, "EV001 empty input: nothing.", ""),
        (lambda: 1, 1, ""), (lambda: {"figure": 2.0}, 0, ""),
    ):
        with pytest.raises(SystemExit) as end:
            common.end_with(work)
        assert end.value.code == code
        assert capsys.readouterr().err.startswith(line)


def test_all_scripts_end_alike() -> None:
    for path in Path(common.__file__).parents[1].glob("*.py"):
        _, main, last = path.read_text().partition('if __name__ == "__main__":\n')
        assert not main or last.startswith(("    run_script(main, ", "    end_with(")), path.name

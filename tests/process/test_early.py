"""Ctrl-C before there is anything to clean: exit code 130 and no traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from evflow.process import early

ROOT = Path(early.__file__).parents[2]


@pytest.mark.parametrize(("given", "seen", "is_it"), [
    (["python", "-m", "evflow", "info"], ["-m", "info"], True),
    (["python", "-E", "/usr/bin/evflow", "info"], ["/usr/bin/evflow", "info"], True),
    (["evflow.exe"], ["evflow.exe"], True),
    (["python", "evflow.py"], ["evflow.py"], False),
    (["python", "-m", "mine", "evflow"], ["-m", "evflow"], False),
    (["python", "-m", "evflow.other"], ["-m"], False),
    (["python", "-c", "import evflow"], ["-c"], False),
    (["python", "-c", "from multiprocessing..."], ["/usr/bin/evflow", "info", "a.h5"], False),
    (["python"], [""], False), ([], [], False)])
def test_only_the_command_ends_at_once(
    monkeypatch: pytest.MonkeyPatch, given: list[str], seen: list[str], is_it: bool
) -> None:
    monkeypatch.setattr(sys, "orig_argv", given)
    monkeypatch.setattr(sys, "argv", seen)
    assert early.is_command() == is_it


def test_interrupted_by_the_first_module_that_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "lazy_loader.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    done = subprocess.run(
        [sys.executable, "-m", "evflow", "version"], capture_output=True, text=True, timeout=60,
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"})
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("ignored", [False, True])
def test_afterwards_it_is_as_usual(monkeypatch: pytest.MonkeyPatch, ignored: bool) -> None:
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    before = signal.getsignal(signal.SIGINT)
    usual = signal.SIG_IGN if ignored else signal.default_int_handler
    signal.signal(signal.SIGINT, usual)
    try:
        early.end_on_interrupt()
        signal.raise_signal(signal.SIGINT)
        early.interrupt_as_usual()
        assert signal.getsignal(signal.SIGINT) == usual
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended == [130] * (not ignored)

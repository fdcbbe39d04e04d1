"""Long work: a bar with an estimate of the time left, silent where stderr is no terminal, and one
way to stop."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

INTERRUPTED = 130  # the shell's exit code of Ctrl-C


@contextlib.contextmanager
def bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Yield progress(done, total)."""
    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as shown:
        task = shown.add_task(title, total=None)
        yield lambda done, total: shown.update(task, completed=done, total=total)


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """SIGTERM, as schedulers send it, ends the block as Ctrl-C does: through every `finally`, so
    that nothing half-written is left. A signal that comes while Python collects garbage, where
    exceptions are ignored, comes again."""
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers belong to the main thread
        return

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    def ignored(lost: Any) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt):
            again.append(threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGTERM)))
            again[-1].start()
        else:
            hook(lost)

    again: list[threading.Timer] = []
    before, hook = signal.signal(signal.SIGTERM, stop), sys.unraisablehook
    sys.unraisablehook = ignored
    try:
        yield
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, before)


def leave(code: int) -> NoReturn:
    """End the process after Ctrl-C: nothing is waited for, as a compilation in another thread does
    not survive the usual end."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)

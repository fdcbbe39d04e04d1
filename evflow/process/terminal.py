"""Long work in a terminal: a progress bar with the time left (silent if stderr is no terminal), one
way to stop, and output that nobody reads any more."""

from __future__ import annotations

import _thread
import contextlib
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any, NoReturn, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from evflow.process.compilation import announced

INTERRUPTED = 130  # the shell's exit code of Ctrl-C
SOON_S, LOST_S = 0.05, 2.0  # until a signal that cannot be raised, or that was lost, comes again


def print_anything() -> None:
    """Print characters that standard output cannot encode, such as bytes of a file name, as \\x..,
    so that printing a message never ends the work."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


class Report(Protocol):
    """progress(done, total): how far the work is; an optional title replaces the bar's."""

    def __call__(self, done: int, total: int, title: str | None = None) -> None: ...


class Stages:
    """A bar's title that names the current stage and what is known so far."""

    def __init__(self, report: Report) -> None:
        self._report, self._at, self._known, self._done = report, "", "", (0, 1)

    def stage(self, name: str) -> None:
        """Start another stage."""
        self._at = name
        self._show()

    def count(self, done: int, total: int) -> None:
        """Report progress."""
        self._done = done, total
        self._show()

    def know(self, text: str) -> None:
        """Add a result that is known by now."""
        self._known = f": {text}"
        self._show()

    def _show(self) -> None:
        self._report(*self._done, f"{self._at}{self._known}")


@contextlib.contextmanager
def bar(title: str, shown: bool = True, *, compiles: bool = False) -> Iterator[Report]:
    """Yield progress(done, total). shown: False if another process shows the bar; compiles: whether
    the work compiles programs, which the title then says."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
               TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not (shown and console.is_terminal)) as live:
        task = live.add_task(title, total=None)

        label = title

        def report(done: int, total: int, title: str | None = None) -> None:
            nonlocal label
            label = title or label
            live.update(task, completed=done, total=total, description=label)

        def compiling(begins: bool) -> None:
            live.update(task, description=f"{label} (compiling)" if begins else label)

        with announced(compiling) if compiles and not live.disable else contextlib.nullcontext():
            yield report


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """SIGTERM, which schedulers send, ends the block like Ctrl-C: through every `finally`, so that
    nothing half-written is left.

    A signal during garbage collection, which ignores exceptions, or during an import, which
    compiled modules do not survive or swallow, comes again soon. So does one that is lost
    elsewhere, as where compiled code calls Python, after a while in which nothing ends.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return

    def again(number: int, after_s: float) -> None:
        def send() -> None:
            time.sleep(after_s)
            if within:
                sent.append(number)
                os.kill(os.getpid(), number)

        _thread.start_new_thread(send, ())

    def stop(number: int, frame: FrameType | None) -> None:
        repeated = number in sent
        if repeated:
            sent.remove(number)
        if repeated and _is_ending():
            again(number, LOST_S)
        elif _imports(frame) > outside:
            again(number, SOON_S)
        else:
            again(number, LOST_S)
            raise KeyboardInterrupt

    def ignored(lost: Any) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt):
            again(signal.SIGTERM, SOON_S)
        else:
            hook(lost)

    within, sent = True, list[int]()
    outside = _imports(sys._getframe())  # import frames that surround the block itself
    before, hook = signal.signal(signal.SIGTERM, stop), sys.unraisablehook
    keyboard = signal.getsignal(signal.SIGINT)
    if keyboard is signal.default_int_handler:  # not where a shell has it ignored
        signal.signal(signal.SIGINT, stop)
    sys.unraisablehook = ignored
    try:
        yield
    finally:
        within = False
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGINT, keyboard)


def _is_ending() -> bool:
    """Whether the main thread cleans up after a KeyboardInterrupt."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _imports(frame: FrameType | None) -> int:
    """The number of import-machinery frames on the stack."""
    count = 0
    while frame is not None:
        count += frame.f_code.co_filename.startswith("<frozen importlib")
        frame = frame.f_back
    return count


def open_closed() -> None:
    """Reopen closed standard streams (`evflow ... >&-`) on the null device: otherwise the next file
    to be opened would take their place."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is not None:
            continue
        nowhere = os.open(os.devnull, os.O_RDWR)
        with contextlib.suppress(OSError):
            os.fstat(number)  # already taken by another file, or this very stream
            setattr(sys, name, open(nowhere, mode, closefd=False))  # noqa: SIM115 (to the end)
            continue
        os.dup2(nowhere, number)
        setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115


def unread() -> None:
    """After BrokenPipeError (`evflow info ... | head`): the reader is gone, which is no error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def leave(code: int) -> NoReturn:
    """End the process after Ctrl-C without waiting: a compilation in another thread does not
    survive the usual exit."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)

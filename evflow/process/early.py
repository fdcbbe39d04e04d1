"""Ctrl-C while modules load, which takes a second and which they do not all survive, and while the
process ends: nothing is begun yet, or all is done, so that it ends at once and without a traceback.

This is the first module of evflow that is loaded, so it loads nothing itself.
"""

import os
import sys


def is_command() -> bool:
    """Whether this process is the command `evflow`, or `python -m evflow`, and no other program
    that imports evflow, nor a worker."""
    program = sys.orig_argv[-len(sys.argv):][:1]  # -m hides it in sys.argv while it is looked for
    return os.path.basename("".join(program)) in ("evflow", "evflow.exe")


def end_on_interrupt() -> None:
    """Let Ctrl-C end the process, exit code 130; not where a shell has it ignored."""
    try:
        import signal

        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _end)
    except KeyboardInterrupt:
        _end()


def interrupt_as_usual() -> None:
    """Ctrl-C raises KeyboardInterrupt again, after `end_on_interrupt`."""
    import signal

    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(*_: object) -> None:
    os._exit(130)

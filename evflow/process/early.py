"""Before modules load. Ctrl-C while they do, which takes a second and which they do not all
survive, and while the process ends: nothing is begun yet, or all is done, so that it ends at once
and without a traceback. And what a process can only be told before they are there.

This is the first module of evflow that is loaded, so it loads nothing itself.
"""

import gc
import os
import sys

GARBAGE = 20_000  # new objects after which it is looked for


def is_command() -> bool:
    """Whether this process is the command `evflow`, or `python -m evflow`, and no other program
    that imports evflow, nor a worker."""
    program = sys.orig_argv[-len(sys.argv):][:1]  # -m hides it in sys.argv while it is looked for
    return os.path.basename("".join(program)) in ("evflow", "evflow.exe")


def save_time() -> None:
    """Let the process do less beside its work. NumPy's threads for linear algebra wait for each
    other, spinning, longer than products of a few numbers take; an environment that says how many
    there are is obeyed. And Python looks for garbage among all objects after every 700 new ones,
    which is hundreds of times while modules load and programs are traced."""
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(GARBAGE, *gc.get_threshold()[1:])


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

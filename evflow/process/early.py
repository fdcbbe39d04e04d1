"""What must happen before other modules load: settings that only work at the start of a process,
and Ctrl-C during the second that loading takes or while the process ends. At these times there is
no work to save, so the process ends at once, without a traceback (some modules do not survive an
interrupted import).

This is the first module of evflow to be loaded, so it loads nothing itself.
"""

import gc
import os
import sys

GARBAGE = 50_000  # new objects before Python collects garbage


def is_command() -> bool:
    """Whether this process is the command `evflow` or `python -m evflow`, rather than a worker or
    another program that imports evflow."""
    program = sys.orig_argv[-len(sys.argv):][:1]  # sys.argv hides -m while modules are located
    return os.path.basename("".join(program)) in ("evflow", "evflow.exe")


def save_time() -> None:
    """Reduce overhead: one linear-algebra thread for NumPy, whose threads spin while they wait for
    each other, longer than small products take (settings in the environment come first); and no
    garbage collection until `settle`, which by default runs hundreds of times while modules load
    and programs are traced."""
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(GARBAGE, *gc.get_threshold()[1:])
    gc.disable()


def settle() -> None:
    """Collect garbage from here on, but not among the objects that exist, mostly modules."""
    gc.freeze()
    gc.enable()


def end_on_interrupt() -> None:
    """Let Ctrl-C end the process with exit code 130, unless the shell has it ignored."""
    try:
        import signal

        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _end)
    except KeyboardInterrupt:
        _end()


def interrupt_as_usual() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again, after `end_on_interrupt`."""
    import signal

    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(*_: object) -> None:
    os._exit(130)

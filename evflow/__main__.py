"""`python -m evflow` and the command `evflow`: what is done before anything else is loaded."""

import os
import signal
import sys
from typing import NoReturn


def run() -> NoReturn:
    """The process `evflow`. Ctrl-C ends it at once while modules are loaded, which takes a second
    and which they do not all survive: nothing is begun yet."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # not where a shell has it ignored
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from evflow.cli import run
    from evflow.process.terminal import open_closed

    open_closed()
    signal.signal(signal.SIGINT, before)
    run()
    sys.exit()


if __name__ == "__main__":
    run()

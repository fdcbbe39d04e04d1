"""`python -m evflow` and the command `evflow`: what is done before anything else is loaded."""

import gc
import sys
from typing import NoReturn

from evflow.process import early

YOUNG = 20_000  # objects between two searches for garbage; after 700, as Python begins, these are a
# tenth of the time in which a command's modules load


def run() -> NoReturn:
    """The process `evflow`; `main` of cli.py takes Ctrl-C over."""
    early.end_on_interrupt()
    gc.set_threshold(YOUNG)
    from evflow.cli import run
    from evflow.process.terminal import open_closed

    open_closed()
    run()
    sys.exit()


if __name__ == "__main__":
    run()

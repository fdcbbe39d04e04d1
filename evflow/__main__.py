"""`python -m evflow` and the command `evflow`: what is done before anything else is loaded."""

import sys
from typing import NoReturn

from evflow.process import early


def run() -> NoReturn:
    """The process `evflow`; `main` of cli.py takes Ctrl-C over."""
    early.end_on_interrupt()
    from evflow.cli import run
    from evflow.process.terminal import open_closed

    open_closed()
    run()
    sys.exit()


if __name__ == "__main__":
    run()

"""Entry point of `python -m evflow` and of the command `evflow`."""

import sys
from typing import NoReturn

from evflow.process import early


def run() -> NoReturn:
    """Run the command; from `main` of cli.py on, Ctrl-C is handled there."""
    early.end_on_interrupt()
    from evflow.cli import run
    from evflow.process.terminal import open_closed

    open_closed()
    run()
    sys.exit()


if __name__ == "__main__":
    run()

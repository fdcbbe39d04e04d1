"""Train the network: `evflow train`, with all its options, as a script of the source tree.

    python -m experiments.train --preset default --out runs/default --max-seconds 2400
    srun python -m experiments.train --out runs/default      # every device of every process
    python -m experiments.train --out runs/default --coordinator HOST:PORT --processes 2 \
        --process-id 0                                       # and so on, one command a process
"""

from __future__ import annotations

import sys

import tyro

from evflow.commands.train import Train as Options
from evflow.commands.train import with_configuration
from experiments.shared.common import end_with


def main(options: Options) -> None:
    """One run, as the command's."""
    options.run()


if __name__ == "__main__":
    end_with(lambda: main(tyro.cli(with_configuration(sys.argv[1:]), description=__doc__)))

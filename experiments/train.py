"""Train the network: `evflow train`, as a script of the source tree.

    python -m experiments.train --preset default --out runs/default --max-seconds 2400
    srun python -m experiments.train --out runs/default      # every device of every process
    python -m experiments.train --out runs/default --coordinator HOST:PORT --processes 2 \
        --process-id 0                                       # and so on, one command a process
"""

from __future__ import annotations

from evflow.commands.train import Train as Options
from evflow.training.run import train_network as main
from experiments.shared.common import run_script

if __name__ == "__main__":
    run_script(main, Options, __doc__)

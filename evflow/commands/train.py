"""`evflow train`: the training of the network, on every device of every process."""

from __future__ import annotations

import dataclasses

from evflow.training.options import TrainOptions


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train(TrainOptions):
    """Train the network on simulated cameras; writes checkpoints, metrics.jsonl, and
    weights.safetensors at the end.

    Ctrl-C saves a checkpoint and stops; the same command goes on, bit for bit on as many devices.
    All devices there are share the work, also those of several processes (srun, mpirun, or
    --coordinator), which see the same global batches; --out is a folder that they share. Where a
    process dies, the others end with an error within half a minute, and the last complete
    checkpoint counts.

    Example: evflow train --preset default --out runs/default --max-seconds 2400

    Example: evflow train --out runs/default --coordinator HOST:PORT --processes 2 --process-id 0
    """

    def run(self) -> None:
        from evflow.training.run import train_network

        train_network(self)

"""`evflow train`: the training of the network, in the source tree."""

from __future__ import annotations

import dataclasses

import tyro

from evflow.commands.source_tree import run_module


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the network on simulated cameras (python -m experiments.train of the source tree).

    Example: evflow train --preset default --out runs/default
    """

    options: tyro.conf.Positional[tuple[str, ...]] = ()
    """Those of experiments.train: evflow train --help."""

    def run(self) -> None:
        run_module("experiments.train", self.options, "evflow train")

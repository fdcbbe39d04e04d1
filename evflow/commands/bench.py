"""`evflow bench`: the benchmarks, in the source tree."""

from __future__ import annotations

import dataclasses

import tyro

from evflow.commands.source_tree import run_module


@dataclasses.dataclass(frozen=True)
class Bench:
    """Time evflow on this machine, beside peers (python -m benchmarks of the source tree).

    Example: evflow bench --only simulator voxels
    """

    options: tyro.conf.Positional[tuple[str, ...]] = ()
    """Those of benchmarks: evflow bench --help."""

    def run(self) -> None:
        run_module("benchmarks.__main__", self.options, "evflow bench")

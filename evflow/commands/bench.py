"""`evflow bench`: the benchmarks, which lie beside the package in its source tree; offered where
they do."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from pathlib import Path

import tyro

import evflow


@dataclasses.dataclass(frozen=True)
class Bench:
    """Time evflow on this machine, beside peers.

    Example: evflow bench --only simulator voxels
    """

    options: tyro.conf.Positional[tuple[str, ...]] = ()
    """Those of the benchmarks: evflow bench --help."""

    def run(self) -> None:
        """Signals, terminal and exit code are the benchmarks' own."""
        path = sys.path[:]
        sys.path.insert(0, str(tree()))
        try:
            importlib.import_module("benchmarks.__main__").command(self.options, "evflow bench")
        finally:
            sys.path[:] = path


def tree() -> Path:
    """The folder that evflow lies in."""
    return Path(evflow.__file__).resolve().parents[1]


def at_hand() -> bool:
    """Whether that is evflow's source tree, with the benchmarks."""
    return (tree() / "pyproject.toml").is_file() and (tree() / "benchmarks/harness.py").is_file()


def forwarded(arguments: list[str]) -> list[str]:
    """The command line with all that follows `bench` kept for the benchmarks, --help too."""
    if arguments[:1] == ["bench"] and arguments[1:2] != ["--"]:
        return ["bench", "--", *arguments[1:]]
    return arguments

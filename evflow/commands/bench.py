"""`evflow bench`: runs the benchmarks, which lie beside the package in the source tree; offered
only there."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from pathlib import Path

import tyro

import evflow


@dataclasses.dataclass(frozen=True)
class Bench:
    """Time evflow on this machine, next to other tools.

    Example: evflow bench --only simulator voxels
    """

    options: tyro.conf.Positional[tuple[str, ...]] = ()
    """Options of the benchmarks: see evflow bench --help."""

    def run(self) -> None:
        """The benchmarks handle signals, terminal and exit code themselves."""
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
    """Whether that folder is evflow's source tree, with the benchmarks."""
    return (tree() / "pyproject.toml").is_file() and (tree() / "benchmarks/harness.py").is_file()


def forwarded(arguments: list[str]) -> list[str]:
    """The command line with everything after `bench` passed to the benchmarks, including --help."""
    if arguments[:1] == ["bench"] and arguments[1:2] != ["--"]:
        return ["bench", "--", *arguments[1:]]
    return arguments

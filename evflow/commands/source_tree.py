"""What trains and times evflow lies beside the package, in its source tree: such a command runs a
module of the tree that this evflow comes from, as `python -m MODULE` would."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import evflow
from evflow.errors import EvflowDataError

FORWARDED = ("train", "bench")  # their options are the module's own


def forwarded(arguments: list[str]) -> list[str]:
    """The command line with all that follows such a command kept for its module, --help too."""
    if arguments[:1] and arguments[0] in FORWARDED and arguments[1:2] != ["--"]:
        return [arguments[0], "--", *arguments[1:]]
    return arguments


def run_module(name: str, options: tuple[str, ...]) -> None:
    """Run module `name` as the program, in this process: signals, terminal and exit code are its
    own. EV016 where evflow was installed without its source tree."""
    root = Path(evflow.__file__).resolve().parents[1]
    if not ((root / "pyproject.toml").is_file() and (root / name.split(".")[0]).is_dir()):
        raise EvflowDataError(
            "EV016", f"{name} is not in {root}: it belongs to evflow's source tree, not to the "
            "installed package.",
            "Get the source tree, run `pip install -e .` in it, then this command again.")
    argv, path = sys.argv, sys.path[:]
    sys.argv, sys.path[:0] = [name, *options], [str(root)]
    try:
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    finally:
        sys.argv, sys.path[:] = argv, path

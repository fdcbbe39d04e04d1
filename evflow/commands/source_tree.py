"""What trains and times evflow lies beside the package, in its source tree: such a command calls a
module of the tree that this evflow comes from."""

from __future__ import annotations

import importlib
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


def run_module(name: str, options: tuple[str, ...], prog: str) -> None:
    """Call `command(options, prog)` of module `name`: signals, terminal and exit code are its own.
    EV016 where evflow was installed without its source tree."""
    root = Path(evflow.__file__).resolve().parents[1]
    if not ((root / "pyproject.toml").is_file() and (root / name.split(".")[0]).is_dir()):
        raise EvflowDataError(
            "EV016", f"{name} is not in {root}: it belongs to evflow's source tree, not to the "
            "installed package.",
            "Get the source tree, run `pip install -e .` in it, then this command again.")
    path = sys.path[:]
    sys.path.insert(0, str(root))
    try:
        importlib.import_module(name).command(options, prog)
    finally:
        sys.path[:] = path

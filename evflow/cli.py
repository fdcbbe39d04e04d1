"""The command line: parse, run, exit. Results go to stdout, progress and errors to stderr.

Exit codes: 0 done, 1 something about the data, 2 usage, 3 disk or memory, 130 interrupted.
"""

from __future__ import annotations

import difflib
import gc
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, Union

import tyro

from evflow.commands.arguments import check_options, check_rest, reflowed
from evflow.commands.check import Check
from evflow.commands.compare import Compare
from evflow.commands.convert import Convert
from evflow.commands.estimate import Estimate
from evflow.commands.export import Export
from evflow.commands.flow import Flow
from evflow.commands.info import Info
from evflow.commands.options import Compiling
from evflow.commands.reconstruct import Reconstruct
from evflow.commands.render import Render
from evflow.commands.simulate import Simulate
from evflow.commands.train import Train, with_configuration
from evflow.commands.version import Version
from evflow.commands.voxel import Voxel
from evflow.errors import EvflowDataError
from evflow.files.atomic import REASONS
from evflow.process import early
from evflow.process.compilation import remember
from evflow.process.terminal import INTERRUPTED, leave, print_anything, stoppable, unread

EXITS = {"EV019": 3, "EV020": 2}  # exit codes other than 1

COMMANDS: dict[str, type] = {
    "info": Info, "check": Check, "estimate": Estimate, "compare": Compare, "render": Render,
    "reconstruct": Reconstruct, "flow": Flow, "simulate": Simulate, "convert": Convert,
    "voxel": Voxel, "export": Export, "train": Train, "version": Version}


def command_type(arguments: Sequence[str] = ()) -> Any:
    """The type that tyro parses: one of the commands by its name. The options of `train` are built
    only when `train` is called, and help is reflowed only to be shown, as both take time. Raises
    EV020 for options that the called command lacks."""
    found, verb = dict(COMMANDS), next(iter(arguments), "")
    if verb == "train":
        found["train"] = with_configuration(arguments)
    if verb in found:
        check_options(verb, found[verb], arguments[1:])
        if {"-h", "--help"} & set(arguments):
            found[verb] = reflowed(found[verb])
    named = tuple(Annotated[command, tyro.conf.subcommand(name)] for name, command in found.items())
    return Union[named]  # noqa: UP007 - built at run time


def in_parsing_order(arguments: list[str]) -> list[str]:
    """The arguments in the order the parser expects; raises EV020 for an unknown command, or
    options before it."""
    first = arguments[0] if arguments else ""
    if first == "--version":
        return ["version", *arguments[1:]]
    if first == "help":
        return [*arguments[1:2], "--help"]
    verb = next((word for word in arguments if word in COMMANDS), "")
    if first.startswith("--") and first != "--help" and verb:
        rest = list(arguments)
        rest.remove(verb)
        raise EvflowDataError("EV020", f"{first} stands before the command.", "Options follow it: "
                              f"{shlex.join(['evflow', verb, *rest])}.")
    if first and not first.startswith("-") and first not in COMMANDS:
        near = difflib.get_close_matches(first, COMMANDS, n=1)
        fix = f"Did you mean: evflow {near[0]}?" if near else (
            "To measure a recording: evflow estimate RECORDING -o cam/."
            if Path(first).exists() else f"Commands: {', '.join(COMMANDS)}.")
        raise EvflowDataError("EV020", f"evflow has no command {first!r}.", fix)
    return arguments


def main(argv: list[str] | None = None) -> int:
    """Entry point of the `evflow` command."""
    try:
        early.interrupt_as_usual()
        with stoppable():
            arguments = in_parsing_order(sys.argv[1:] if argv is None else argv)
            command, rest = tyro.cli(
                command_type(arguments), args=arguments, prog="evflow", return_unknown_args=True,
                description="Measure an event camera from its recording; simulate any video as it "
                "would see it.\n\nExample: evflow estimate flight.aedat4 -o cam/")
            check_rest(arguments[0], rest)
            if isinstance(command, Compiling) and command.compile_cache:
                remember()
            early.settle()
            command.run()
            sys.stdout.flush()
    except EvflowDataError as e:
        print(e, file=sys.stderr)
        return EXITS.get(e.code, 1)
    except MemoryError as e:
        print(f"out of memory: {e}", file=sys.stderr)
        return 3
    except BrokenPipeError:
        unread()
        return 0
    except OSError as e:
        error = _unusable(e)
        print(error, file=sys.stderr)
        return EXITS.get(error.code, 1)
    except KeyboardInterrupt as e:
        print(str(e) or "interrupted; no half-written file is left.", file=sys.stderr)
        return INTERRUPTED
    return 0


def _unusable(error: OSError) -> EvflowDataError:
    """What to say of an input that may not be read, or of an output that cannot be written."""
    name, why = error.filename, REASONS.get(error.errno or 0, error.strerror or str(error))
    if name and os.path.exists(name) and not os.access(name, os.R_OK):
        return EvflowDataError("EV016", f"{name} cannot be opened ({why}).",
                               "Check its permissions.")
    return EvflowDataError("EV019", f"{name or 'the output'} cannot be used ({why}).",
                           "Choose another output.")


def run() -> NoReturn:
    """Run `main` and end the process with its exit code."""
    print_anything()
    code = main()
    early.end_on_interrupt()
    gc.freeze()  # a search for garbage among all loaded objects takes a third of a second
    if code == INTERRUPTED:
        leave(code)
    sys.exit(code)


if __name__ == "__main__":
    run()

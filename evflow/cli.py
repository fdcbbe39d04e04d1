"""The command line: parse, run, exit. Results go to stdout, progress and errors to stderr.

Exit codes: 0 done, 1 something about the data, 2 usage, 3 disk or memory, 130 interrupted.
"""

from __future__ import annotations

import sys
from typing import Annotated, NoReturn, Union

import tyro

from evflow.commands.bench import Bench
from evflow.commands.check import Check
from evflow.commands.compare import Compare
from evflow.commands.convert import Convert
from evflow.commands.estimate import Estimate
from evflow.commands.export import Export
from evflow.commands.flow import Flow
from evflow.commands.info import Info
from evflow.commands.reconstruct import Reconstruct
from evflow.commands.render import Render
from evflow.commands.simulate import Simulate
from evflow.commands.source_tree import forwarded
from evflow.commands.train import Train
from evflow.commands.version import Version
from evflow.commands.voxel import Voxel
from evflow.errors import EvflowDataError
from evflow.process.terminal import INTERRUPTED, leave, print_anything, stoppable, unread

EXITS = {"EV019": 3, "EV020": 2}  # codes of resources and of usage

Command = Union[  # noqa: UP007 - tyro reads the subcommand names from these annotations
    Annotated[Info, tyro.conf.subcommand("info")],
    Annotated[Check, tyro.conf.subcommand("check")],
    Annotated[Estimate, tyro.conf.subcommand("estimate")],
    Annotated[Compare, tyro.conf.subcommand("compare")],
    Annotated[Render, tyro.conf.subcommand("render")],
    Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")],
    Annotated[Flow, tyro.conf.subcommand("flow")],
    Annotated[Simulate, tyro.conf.subcommand("simulate")],
    Annotated[Convert, tyro.conf.subcommand("convert")],
    Annotated[Voxel, tyro.conf.subcommand("voxel")],
    Annotated[Export, tyro.conf.subcommand("export")],
    Annotated[Train, tyro.conf.subcommand("train")],
    Annotated[Bench, tyro.conf.subcommand("bench")],
    Annotated[Version, tyro.conf.subcommand("version")],
]


def main(argv: list[str] | None = None) -> int:
    """Entry point of the `evflow` command."""
    try:
        with stoppable():
            arguments = forwarded(sys.argv[1:] if argv is None else argv)
            tyro.cli(
                Command, args=arguments, prog="evflow",
                description="Measure an event camera from its recording; simulate any video as it "
                "would see it.\n\nExample: evflow estimate flight.aedat4 -o cam/").run()
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
        print(f"the output cannot be written: {e}", file=sys.stderr)
        return 3
    except KeyboardInterrupt:
        print("interrupted; no half-written file is left.", file=sys.stderr)
        return INTERRUPTED
    return 0


def run() -> NoReturn:
    """The process `evflow`: `main`, and its exit code."""
    print_anything()
    code = main()
    if code == INTERRUPTED:
        leave(code)
    sys.exit(code)


if __name__ == "__main__":
    run()

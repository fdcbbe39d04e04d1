"""`evflow train`: trains the network, on every device of every process.

Every number of a run's configuration is an option, e.g. `--loss.flow 0.1`, with the type from its
dataclass and the preset's value as default. These options are built from `TrainConfig` only when a
command line begins with `train`: it imports JAX, which other commands do without.
"""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import tyro

from evflow.commands.arguments import attributes
from evflow.errors import EvflowDataError
from evflow.training.options import TrainOptions

PYTHON = ("sensors",)  # fields of a configuration that are too large for a command line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train(TrainOptions):
    """Train the network on simulated cameras; writes checkpoints, metrics.jsonl, and
    weights.safetensors at the end.

    Ctrl-C saves a checkpoint and stops; the same command continues, bit for bit on the same number
    of devices. All available devices share the work, also those of several processes (srun, mpirun,
    or --coordinator), which see the same global batches and share the folder --out. If a process
    dies, the others end with an error within half a minute; the last complete checkpoint is kept.

    Example: evflow train --preset default --out runs/default --max-seconds 2400

    Example: evflow train --preset debug --loss.flow 0.1 --model.flow.steps 4 --out runs/try

    Example: evflow train --preset literal --images coco/instances.json --out runs/literal

    Example: evflow train --out runs/default --coordinator HOST:PORT --processes 2 --process-id 0
    """

    def run(self) -> None:
        from evflow.process import devices
        from evflow.training.run import train_network

        train_network(self)
        if devices.is_main():
            print(f"written to {self.out}/: metrics.jsonl, and weights.safetensors for evflow "
                  "estimate --weights")


def with_configuration(arguments: Sequence[str]) -> type[Train]:
    """`Train` with an option for every field of the preset named in the command line."""
    from evflow.training.config import PRESETS, TrainConfig

    named = re.search(r"(?:^|\0)--preset[=\0]([^\0]+)", "\0".join(arguments))
    config = PRESETS.get(named[1] if named else "default", PRESETS["default"])
    _check_names(arguments, config)
    hints, own = typing.get_type_hints(TrainConfig), {f.name for f in dataclasses.fields(Train)}
    preset = next(f for f in dataclasses.fields(Train) if f.name == "preset")
    explained = tyro.conf.arg(help="default: all parts; pixels: networks that see pixels one by "
                              "one, on many small scenes; paper: the paper's network and losses; "
                              "literal: everything as printed there; debug: tiny, to see that it "
                              "runs.")
    fields: list[tuple[str, Any, Any]] = [
        ("preset", Annotated[Literal[tuple(PRESETS)], explained],  # type: ignore[misc]
         dataclasses.field(default=preset.default))]
    explained_by = attributes(TrainConfig)
    fields += [(f.name, Annotated[hints[f.name], tyro.conf.arg(help=explained_by.get(f.name))],
                dataclasses.field(default=getattr(config, f.name)))
               for f in dataclasses.fields(TrainConfig)
               if f.name not in own and f.name not in PYTHON]
    return dataclasses.make_dataclass(
        "Train", fields, bases=(Train,), frozen=True, kw_only=True,
        namespace={"__doc__": Train.__doc__})


def _check_names(arguments: Sequence[str], config: Any) -> None:
    """Raise EV020 if a dotted option is not a field of the configuration, and list the fields."""
    for word in arguments:
        name = word.removeprefix("--").partition("=")[0].replace("-", "_")
        if not word.startswith("--") or "." not in name:
            continue
        *groups, last = name.removeprefix("no_").split(".")
        held: Any = config
        for i, group in enumerate([*groups, last]):
            known = {} if not dataclasses.is_dataclass(held) else {
                f.name: getattr(held, f.name) for f in dataclasses.fields(held)}
            if (key := group.removeprefix("no_")) not in known:
                where = ".".join(groups[:i])
                raise EvflowDataError(
                    "EV020", f"a training has no option {word.partition('=')[0]}.",
                    f"{where or 'A configuration'} has {', '.join(known) or 'no fields'}.")
            held = known[key]

"""What every experiment shares: how a result is saved, where results go, names of files, how a
script runs and ends."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
import tyro

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_text
from evflow.files.folders import need_writable
from evflow.network.architecture import config_of
from evflow.network.weights import load_weights, weights_hash
from evflow.process.provenance import provenance
from evflow.process.terminal import INTERRUPTED, leave, print_anything, stoppable, unread

STARTED = time.monotonic()
HOW = ("out", "workers", "max_seconds", "rows")  # options that change nothing in a result


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Options of a study over hidden recordings."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path
    seed: int
    workers: int = 1
    """Processes side by side."""

    def count(self, given: int | None, debug: int, full: int) -> int:
        """How many recordings: as many as were asked for, else the preset's."""
        return given or {"debug": debug, "full": full}[self.preset]


def write_result(path: Path, result: dict[str, Any], config: dict[str, Any]) -> None:
    """Save a result with its configuration, the hashes of the weights that this names, what it
    took and provenance as JSON."""
    record = {"result": result, "config": config, "weights_sha256": hashes(config),
              "took": took(), **provenance()}
    atomic_text(path, json.dumps(record, indent=2, default=str) + "\n", overwrite=True)


def saved(path: Path, part: Literal["result", "config"]) -> dict[str, Any]:
    """A part of what `write_result` saved; EV009 where the file holds none."""
    try:
        held = json.loads(path.read_text())[part]
        if not isinstance(held, dict):
            raise TypeError(f"{part} is no object")
    except (ValueError, KeyError, TypeError, OSError) as e:
        raise EvflowDataError("EV009", f"{path} holds no result of these scripts ({e}).",
                              "Remove it, or choose another --out.") from e
    return held


def plain(value: Any) -> Any:
    """A result with lists in place of arrays."""
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    return value.tolist() if isinstance(value, np.ndarray) else value


def took() -> dict[str, float]:
    """Seconds of this process so far, and of the processes that it has ended: by the clock, and of
    CPU. Rows that an earlier run had kept are not in them."""
    cpu_s = sum(os.times()[:4])
    return {"wall_s": round(time.monotonic() - STARTED, 1), "cpu_s": round(cpu_s, 1)}


def write_text(path: Path, text: str) -> None:
    """Save a table, whole or not at all."""
    atomic_text(path, text + "\n", overwrite=True)


def conclude(options: Any, name: str, result: dict[str, Any], text: str) -> None:
    """Print a script's table, and write NAME.json and NAME.md into options.out."""
    print(text)
    write_result(options.out / f"{name}.json", result, dataclasses.asdict(options))
    write_text(options.out / f"{name}.md", text)


def markdown(heads: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of cells under `heads`."""
    lines = (f"| {' | '.join(cells)} |" for cells in rows)
    return "\n".join((f"| {' | '.join(heads)} |", "|" + "---|" * len(heads), *lines))


def hashes(config: dict[str, Any]) -> dict[str, str]:
    """SHA-256 of the released or other weights under "weights" in a configuration."""
    named = config.get("weights") or ()
    found = {}
    for name in named if isinstance(named, list | tuple) else (named,):
        with contextlib.suppress(EvflowDataError, OSError):  # made by the experiment itself
            found[str(name)] = weights_hash(name)
    return found


def slug(name: str) -> str:
    """A name that is a file name everywhere."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", name)


def begin(options: Any, name: str) -> None:
    """Before the work of a script that will write NAME.json into options.out: EV020 where a count
    among its options is less than 1, or its seed less than 0, EV013 where that file is the result
    of other options, EV009 where it is no result, EV019 where it cannot be written."""
    at_least(1, **{field.name: value for field in dataclasses.fields(options)
                   if type(value := getattr(options, field.name)) is int and field.name != "seed"})
    at_least(0, seed=getattr(options, "seed", None))
    path = options.out / f"{name}.json"
    need_writable(options.out)
    if not path.is_file():
        return
    before = saved(path, "config")
    wanted = json.loads(json.dumps(dataclasses.asdict(options), default=str))
    differ = [k for k, v in wanted.items() if k not in HOW and before.get(k) != v]
    if differ:
        raise EvflowDataError("EV013", f"{path} is a result of other options "
                              f"({', '.join(differ)}).", "Choose another --out.")


def estimator(weights: str | Path, *parts: str) -> tuple[str, dict[str, Any]]:
    """The name of the architecture in `weights`, and its network; EV018 for weights of anything
    but an estimator, or of one without the parts that are needed."""
    params = load_weights(weights)
    config_of(params)
    (name, net), = params.items()
    missing = [part for part in parts if part not in net]
    if missing == ["fusion"]:
        raise EvflowDataError("EV018", f"{weights} has no part fusion.",
                              "Fit it first: python -m experiments.fuse.")
    if missing:
        raise EvflowDataError(
            "EV018", f"{weights} has no part {' and '.join(missing)}: its network ({name}) sees "
            "every pixel alone, and estimates no errors.", "Take weights of the default network.")
    return name, net


def at_least(least: float, **options: float | None) -> None:
    """EV020 where an option that is given is less; by its name: `save_every` is --save-every."""
    for name, value in options.items():
        if value is not None and not value >= least:  # NaN is less than nothing
            raise EvflowDataError("EV020", f"--{name.replace('_', '-')} {value}.",
                                  f"Give {least} or more.")


def run_script(main: Callable[[Any], object], options: type, doc: str | None) -> NoReturn:
    """The process of an experiment: `main` of the options on its command line."""
    end_with(lambda: main(tyro.cli(options, description=doc)))


def end_with(work: Callable[[], object]) -> NoReturn:
    """Do the work and end the process: by the number that it returns, or 0; by one line and 1 on
    an error about the data; on Ctrl-C or SIGTERM by one line, that of the exception if it says
    anything, and 130."""
    print_anything()
    try:
        with stoppable():
            code = work()
            sys.stdout.flush()
    except EvflowDataError as e:
        raise SystemExit(str(e)) from None
    except KeyboardInterrupt as e:
        print(str(e) or "interrupted; no half-written file is left.", file=sys.stderr)
        leave(INTERRUPTED)
    except BrokenPipeError:
        unread()
        code = 0
    raise SystemExit(code if isinstance(code, int) else 0)

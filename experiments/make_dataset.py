"""Make a data set: events, frames, optical flow, intensity changes and camera maps.

    python -m experiments.make_dataset --out sets/full                    # 300 + 30 sequences
    python -m experiments.make_dataset --out sets/full --workers 8
    python -m experiments.make_dataset --out sets/full --shard 17/64      # any scheduler's array
    python -m experiments.make_dataset --out sets/full --verify           # exit code 1: damage
    python -m experiments.make_dataset --out sets/full --only-missing     # make that again

A sequence is a function of the configuration, the seed and its number: any number of shards and
workers makes the same files. Ctrl-C and SIGTERM leave nothing half-written; the same command goes
on. evflow.dataset.read_sequence and iter_sequences read the set as NumPy arrays.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Literal

from evflow.dataset.config import PRESETS, DatasetConfig
from evflow.dataset.manifest import MERGED, verify
from evflow.dataset.shards import build
from evflow.errors import EvflowDataError
from evflow.process.provenance import provenance
from evflow.process.terminal import bar
from experiments.shared.common import run_script


@dataclasses.dataclass(frozen=True)
class Options:
    """Make a data set of simulated cameras, or verify one."""

    out: Path
    """Folder of the set."""
    preset: Literal["full", "debug"] = "full"
    shard: str = "0/1"
    """i/N: every N-th sequence, from the i-th; i = 0 .. N-1."""
    workers: int = 1
    """Processes on this machine."""
    format: Literal["dsec", "npy"] = "dsec"
    """One HDF5 file a sequence, in the layout of DSEC, or a folder of .npy files."""
    seed: int = 0
    verify: bool = False
    """Make nothing: read every file again and compare it with its hash."""
    only_missing: bool = False
    """Compare hashes first; make what is missing or damaged."""
    train: int | None = None
    """Sequences to train on (default: the preset's, as all that follow)."""
    test: int | None = None
    width: int | None = None
    height: int | None = None
    seconds: float | None = None
    """Duration of every sequence."""
    frame_hz: int | None = None
    """Frames per second that are kept; a divisor of 1000."""


def main(options: Options) -> int:
    """The exit code: 0, or 1 where a set that was verified is not whole."""
    shard = parse_shard(options.shard)
    if options.verify:
        with bar("verified") as progress:
            faults = verify(options.out, shard, progress)
        for name, why in faults.items():
            print(f"{name}: {why}")
        print(f"{options.out}: {len(faults)} faults; --only-missing makes them good." if faults
              else f"{options.out}: whole.")
        return 1 if faults else 0
    with bar("sequences") as progress:
        made = build(
            options.out, configuration(options), options.seed, shard=shard,
            workers=options.workers, format=options.format, only_missing=options.only_missing,
            made_by=provenance(), progress=progress)
    total = json.loads((options.out / MERGED).read_text())["total"]
    print(f"{len(made)} sequences made; {options.out} holds {total['sequences']}: "
          f"{total['events_on'] + total['events_off']:,} events, {total['bytes'] / 1e6:,.0f} MB.")
    return 0


def configuration(options: Options) -> DatasetConfig:
    """The preset with the options' changes."""
    names = ("train", "test", "width", "height", "seconds", "frame_hz")
    changes = {k: getattr(options, k) for k in names if getattr(options, k) is not None}
    return dataclasses.replace(PRESETS[options.preset], **changes)


def parse_shard(text: str) -> tuple[int, int]:
    """ "17/64" -> (17, 64)."""
    index, slash, count = text.partition("/")
    if not (slash and index.isdecimal() and count.isdecimal() and int(index) < int(count)):
        raise EvflowDataError("EV020", f"--shard {text}.", "Give i/N, from 0/N to N-1/N.")
    return int(index), int(count)


if __name__ == "__main__":
    run_script(main, Options, __doc__)

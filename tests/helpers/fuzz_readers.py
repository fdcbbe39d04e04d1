"""Many damaged files of every format: does anything but an `EvflowDataError` come out?

    python tests/helpers/fuzz_readers.py --cases 10000 --out out/fuzz.json
    python tests/helpers/fuzz_readers.py --formats dsec npz --minutes 10 --out out/fuzz.json

A file at --out is gone on with where it stops, if its seed is the same. Exit code 1 where a case
crashed, hung, took too much memory, raised another exception or read data that cannot be right;
such cases are in the file, to be run again by --formats KIND --first INDEX --cases 1.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from helpers.fuzz import FREE, LIMIT_S, RATIO, Bench, Outcome
from helpers.fuzz_samples import SAMPLES
from rich.console import Console
from rich.table import Table

from evflow.files.atomic import atomic_write
from evflow.process.terminal import bar, stoppable

KEPT = 20  # bad cases of a format that are written in full
SHARE = 200  # cases of a format in turn, so that every format has its share of --minutes


@dataclasses.dataclass
class Tally:
    """What came of the cases of one format. peak, slowest: of the worst case."""

    cases: int = 0
    verdicts: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    bad: list[str] = dataclasses.field(default_factory=list)
    slowest_s: float = 0.0
    slowest_case: int | None = None
    peak_bytes: int = 0

    def add(self, outcome: Outcome) -> None:
        self.cases += 1
        self.verdicts[outcome.verdict] += 1
        if outcome.bad and len(self.bad) < KEPT:
            self.bad.append(str(outcome))
        if outcome.seconds > self.slowest_s:
            self.slowest_s, self.slowest_case = outcome.seconds, outcome.index
        self.peak_bytes = max(self.peak_bytes, outcome.peak)

    def record(self) -> dict[str, Any]:
        return {**dataclasses.asdict(self), "verdicts": dict(sorted(self.verdicts.items()))}


def options(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000, help="of each format")
    parser.add_argument("--formats", nargs="+", choices=SAMPLES, default=[*SAMPLES])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first case")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after them")
    parser.add_argument("--out", type=Path, required=True)
    return parser.parse_args(arguments)


def earlier(asked: argparse.Namespace) -> dict[str, Tally]:
    """What the file at --out holds already."""
    if not asked.out.exists():
        return {}
    data = json.loads(asked.out.read_text())
    if (data["seed"], data["first"]) != (asked.seed, asked.first):
        raise SystemExit(f"{asked.out} is of --seed {data['seed']} --first {data['first']}.")
    return {kind: Tally(**{**record, "verdicts": collections.Counter(record["verdicts"])})
            for kind, record in data["formats"].items()}


def save(asked: argparse.Namespace, tallies: dict[str, Tally]) -> None:
    record = {"seed": asked.seed, "first": asked.first, "limit_s": LIMIT_S,
              "memory": f"{FREE:,} bytes + {RATIO} x the file's size",
              "formats": {kind: tally.record() for kind, tally in tallies.items()}}
    with atomic_write(asked.out, overwrite=True) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n")


def fuzz(asked: argparse.Namespace, tallies: dict[str, Tally]) -> None:
    """Run the cases that are missing, in turns, until there are enough or the time is over."""
    end = time.monotonic() + 60 * asked.minutes
    total, done = asked.cases * len(asked.formats), sum(tallies[k].cases for k in asked.formats)
    with tempfile.TemporaryDirectory() as folder, Bench(Path(folder)) as bench, \
            bar("cases") as show:
        while open_kinds := [k for k in asked.formats if tallies[k].cases < asked.cases]:
            for kind in open_kinds:
                for _ in range(min(SHARE, asked.cases - tallies[kind].cases)):
                    case = asked.first + tallies[kind].cases
                    tallies[kind].add(bench.run(kind, asked.seed, case))
                    done += 1
                    show(done, total)
                save(asked, tallies)
                if time.monotonic() > end:
                    return


def table(tallies: dict[str, Tally]) -> Table:
    shown = Table("format", "cases", "read", "refused", "bad", "slowest s", "peak MiB", "codes")
    for kind, tally in tallies.items():
        codes = {k: n for k, n in tally.verdicts.items() if k.startswith("EV")}
        read = tally.verdicts["ok"]
        bad = tally.cases - read - sum(codes.values())
        seen = " ".join(f"{code}:{n}" for code, n in sorted(codes.items()))
        shown.add_row(
            kind, f"{tally.cases:,}", f"{read:,}", f"{sum(codes.values()):,}",
            f"[red]{bad:,}[/]" if bad else "0", f"{tally.slowest_s:.2f}",
            f"{tally.peak_bytes / 2**20:.0f}", seen)
    return shown


def main() -> int:
    asked = options()
    tallies = earlier(asked)
    tallies |= {kind: Tally() for kind in asked.formats if kind not in tallies}
    with stoppable():
        try:
            fuzz(asked, tallies)
        finally:
            save(asked, tallies)
    Console(width=160).print(table({kind: tallies[kind] for kind in asked.formats}))
    return int(any(tallies[kind].bad for kind in asked.formats))


if __name__ == "__main__":
    sys.exit(main())

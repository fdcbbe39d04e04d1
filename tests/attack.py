"""Kill commands while they write: does a wrong file ever get its final name?

    python -m tests.attack --kills 60
    python -m tests.attack --minutes 10 --only convert write_sequence
    python -m tests.attack --kills 60 --tree ../other    # the evflow of another source tree

By turns SIGINT, SIGTERM and SIGKILL, in the later half of the work. After each, an output must be
absent or hold what an undisturbed run writes; no run may end by a segmentation fault, and temporary
files must be gone after SIGINT and SIGTERM, or after the next run of the same command. Exit code 1
otherwise.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

TREE = Path(__file__).parents[1]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
BAD = ("wrong file", "wrong file that reads", "segmentation fault", "left after the signal",
       "left after the next run", "next run failed")
AGAIN = 0.17  # the share of kills after which the command is run again though nothing is left
SEQUENCE = """
import dataclasses, sys
import numpy as np
from evflow.dataset import read_sequence, write_sequence
from evflow.io import read_events
source = read_sequence(sys.argv[1])
events = read_events(sys.argv[2])
write_sequence(sys.argv[3], dataclasses.replace(source, events=events), sys.argv[4])
"""


@dataclasses.dataclass(frozen=True)
class Victim:
    """A command that writes `out`, with its arguments; `again`: what the next run adds. same(a, b):
    do two outputs agree. plain: Python's own handlers, by which SIGTERM ends without cleaning."""

    arguments: list[str]
    out: str
    same: Callable[[Path, Path], bool]
    again: tuple[str, ...] = ()
    plain: bool = False

    def command(self, folder: Path) -> list[str]:
        return [sys.executable, *(a.replace("OUT", str(folder / self.out))
                                  for a in self.arguments)]


def same_bytes(a: Path, b: Path) -> bool:
    return a.read_bytes() == b.read_bytes()


def same_recording(a: Path, b: Path) -> bool:
    """By content: zips hold times of day."""
    from evflow.io import read_recording

    first, second = read_recording(a), read_recording(b)
    return all(np.array_equal(getattr(first.events, name), getattr(second.events, name))
               for name in "xytp") and np.array_equal(first.frames, second.frames)


def same_folder(a: Path, b: Path) -> bool:
    """The same files, of the same bytes."""
    names = [{p.name for p in folder.iterdir()} for folder in (a, b)]
    return names[0] == names[1] and all(same_bytes(a / n, b / n) for n in names[0])


def same_camera(a: Path, b: Path) -> bool:
    """Folders of `evflow estimate`: only what is there, as the last step moves file by file."""
    hidden = {p.name for p in a.iterdir() if p.name.startswith(".")}
    for path in (p for p in a.iterdir() if p.name not in hidden):
        if path.suffix == ".npz":
            with np.load(path) as first, np.load(b / path.name) as second:
                if any(not np.array_equal(first[k], second[k], first[k].dtype.kind == "f")
                       for k in second.files):  # NaN where nothing was measured
                    return False
        elif not same_bytes(path, b / path.name):
            return False
    return True


def same_set(a: Path, b: Path) -> bool:
    """Every sequence in place, and no manifest that says otherwise."""
    from evflow.dataset.manifest import Manifests

    found = Manifests.read(a)
    places = [p for p in (a / "train").glob("*.h5")]
    return not found.damaged and all(
        same_bytes(p, b / "train" / p.name) and found.fault(f"train/{p.stem}", "dsec") is None
        for p in places)


def victims(folder: Path) -> dict[str, Victim]:
    """The commands, with their inputs made in `folder`."""
    from evflow.dataset import PRESETS, make_sequence, write_sequence
    from evflow.io import write_recording
    from evflow.types import Events, Recording

    rng = np.random.default_rng(0)

    def events(n: int, size: tuple[int, int], us: int) -> Events:
        return Events(rng.integers(0, size[0], n), rng.integers(0, size[1], n),
                      np.sort(rng.integers(0, us, n)), rng.integers(0, 2, n), size)

    truth = make_sequence(PRESETS["debug"], 0, 0)
    write_sequence(folder / "truth.h5", truth, "dsec")
    long = events(4_000_000, (346, 260), 10**7)
    inputs = {"long.npz": long, "dark.npz": events(60_000, (64, 48), 20_000_000),
              "many.npz": events(4_000_000, truth.events.size, int(truth.frame_times[-1]))}
    for name, content in inputs.items():
        write_recording(folder / name, Recording.of_events(content))
    np.save(folder / "video.npy", rng.integers(0, 255, (60, 96, 128)).astype(np.uint8))
    evflow, sequence = ["-m", "evflow"], ["-c", SEQUENCE, f"{folder}/truth.h5",
                                          f"{folder}/many.npz", "OUT"]
    convert = [*evflow, "convert", f"{folder}/long.npz", "OUT"]
    over = ("--overwrite",)
    return {
        "convert": Victim(convert, "out.h5", same_bytes, over),
        "convert_utils": Victim([*convert, "--format", "event_utils"], "out.h5", same_bytes, over),
        "convert_npz": Victim(convert, "out.npz", same_recording, over),
        "convert_aedat4": Victim(convert, "out.aedat4", same_bytes, over),
        "convert_folder": Victim(convert, "out", same_folder, over),
        "write_sequence": Victim([*sequence, "dsec"], "out.h5", same_bytes, plain=True),
        "write_sequence_npy": Victim([*sequence, "npy"], "out", same_folder, plain=True),
        "simulate": Victim([*evflow, "simulate", f"{folder}/video.npy", "-o", "OUT", "--fps", "100",
                            "--no-interpolate"], "out.h5", same_bytes, over),
        "make_dataset": Victim(["-m", "experiments.make_dataset", "--preset", "debug", "--train",
                                "12", "--test", "0", "--out", "OUT"], "out", same_set),
        "estimate": Victim([*evflow, "estimate", f"{folder}/dark.npz", "-o", "OUT", "--protocol",
                            "static", "--no-checks", "--no-plots", "--no-report"], "out",
                           same_camera, over),
    }


class Attack:
    """Kills and counts; the runs use the evflow of `tree`."""

    def __init__(self, tree: Path, work: Path, seed: int) -> None:
        self.work, self.rng = work, random.Random(seed)
        self.counts: dict[str, collections.Counter[str]] = {}  # by command and by signal
        self.window_s: dict[str, tuple[float, float]] = {}
        self._options: dict[str, Any] = {
            "cwd": tree, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL,
            "env": os.environ | {"PYTHONPATH": str(tree), "JAX_PLATFORMS": "cpu"}}

    def reference(self, name: str, victim: Victim) -> None:
        """Two undisturbed runs: the first may compile, the second tells when to kill: while it
        writes, in the later half of all."""
        for _ in range(2):
            folder, writes = self._fresh(f"{name}-reference"), None
            begin = time.monotonic()
            process = subprocess.Popen(victim.command(folder), **self._options)
            while process.poll() is None:
                if writes is None and any(folder.iterdir()):
                    writes = time.monotonic() - begin
                time.sleep(0.002)
            end = time.monotonic() - begin
            if process.returncode or writes is None:
                raise SystemExit(f"{name} failed undisturbed: {victim.command(folder)}")
            self.window_s[name] = max(writes, end / 2), end

    def kill(self, name: str, victim: Victim, number: signal.Signals) -> None:
        counts = collections.Counter[str]()
        folder, whole = self._fresh("killed"), self.work / f"{name}-reference" / victim.out
        process = subprocess.Popen(victim.command(folder), **self._options)
        time.sleep(self.rng.uniform(*self.window_s[name]))
        process.send_signal(number)
        code = process.wait()
        counts["kills"] += 1
        counts["ended before"] += code == 0
        counts["segmentation fault"] += -code in (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS)
        self._judge(counts, victim, folder, whole)
        cleans = number == signal.SIGINT or (number == signal.SIGTERM and not victim.plain)
        if cleans and code > 0:
            counts["left after the signal"] += bool(leftovers(folder))
        if leftovers(folder) or self.rng.random() < AGAIN:
            self._run_again(counts, victim, folder, whole)
        for which in (name, number.name):
            self.counts.setdefault(which, collections.Counter()).update(counts)

    def _judge(
        self, counts: collections.Counter[str], victim: Victim, folder: Path, whole: Path
    ) -> None:
        out = folder / victim.out
        if not out.exists():
            counts["absent"] += 1
            return
        try:
            right, reads = victim.same(out, whole), True
        except Exception:
            right = reads = False
        counts["whole" if right else "wrong file"] += 1
        if not right and reads and out.suffix == ".h5":
            counts["wrong file that reads"] += readable(out)

    def _run_again(
        self, counts: collections.Counter[str], victim: Victim, folder: Path, whole: Path
    ) -> None:
        if not victim.again and victim.out != "out":  # it refuses what is there
            (folder / victim.out).unlink(missing_ok=True)
        elif victim.plain:
            shutil.rmtree(folder / victim.out, ignore_errors=True)
        code = subprocess.run([*victim.command(folder), *victim.again], **self._options).returncode
        counts["next runs"] += 1
        counts["next run failed"] += code != 0 or not victim.same(folder / victim.out, whole)
        counts["left after the next run"] += bool(leftovers(folder))

    def _fresh(self, name: str) -> Path:
        shutil.rmtree(self.work / name, ignore_errors=True)
        (self.work / name).mkdir()
        return self.work / name


def leftovers(folder: Path) -> list[Path]:
    return [p for p in folder.rglob(".*")]


def readable(path: Path) -> bool:
    from evflow.errors import EvflowDataError
    from evflow.io import read_recording

    try:
        read_recording(path)
    except EvflowDataError:
        return False
    return True


def turns(told: argparse.Namespace) -> Iterator[tuple[str, signal.Signals]]:
    """Victims and signals by turns, until there are enough or the time is over."""
    end = time.monotonic() + 60 * told.minutes
    for index in range(told.kills):
        if time.monotonic() > end:
            return
        turn, which = divmod(index, len(told.only))
        yield told.only[which], SIGNALS[(turn + which) % len(SIGNALS)]


def table(attack: Attack) -> str:
    columns = ["kills", "absent", "whole", "ended before", "next runs", *BAD]
    signals = {number.name: attack.counts.pop(number.name) for number in SIGNALS
               if number.name in attack.counts}
    total: collections.Counter[str] = sum(signals.values(), collections.Counter())
    lines = ["".join(f"{text:>24}" for text in ("", *columns))]
    for name, counts in [*attack.counts.items(), *signals.items(), ("all", total)]:
        lines.append(f"{name:>24}" + "".join(f"{counts[column]:>24}" for column in columns))
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=10**9)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--only", nargs="+", default=[], help="of the commands")
    parser.add_argument("--tree", type=Path, default=TREE)
    parser.add_argument("--seed", type=int, default=0)
    told = parser.parse_args(arguments)
    if told.kills == 10**9 and told.minutes == float("inf"):
        parser.error("say --kills or --minutes")
    # What a shell runs in the background ignores Ctrl-C, and so would the commands.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as folder:
        attack = Attack(told.tree.resolve(), Path(folder), told.seed)
        known = victims(Path(folder))
        told.only = told.only or [*known]
        for name in told.only:
            attack.reference(name, known[name])
        for name, number in turns(told):
            attack.kill(name, known[name], number)
    print(table(attack))
    return int(any(counts[bad] for counts in attack.counts.values() for bad in BAD))


if __name__ == "__main__":
    sys.exit(main())

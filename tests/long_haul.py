"""Long work: is its memory flat in its length, and do kills change a byte of it?

    python -m tests.long_haul                          # an hour of one core
    python -m tests.long_haul --only stream convert --scale 0.1

stream: an hour of video through `simulate_stream`; convert: a thousand million events of a DAT file
to DSEC's layout, which takes 35 GB of disk; estimate: ten minutes of recording; train: a training
that is killed twenty times.
The first three are done at a tenth of their length, too: the whole may take MORE times its memory.
What a simulation makes of that tenth must be the same bytes, a conversion must hold the events of
its source, and the training end in the weights of an undisturbed one. Exit code 1 otherwise.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

TREE = Path(__file__).parents[1]
MORE, PARTS = 1.2, 10
KILLS, SIGNALS = 20, (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
LENGTHS = {"stream": 3600, "convert": 1000, "estimate": 600, "train": 4000}
UNITS = {"stream": "s", "convert": "million events", "estimate": "s", "train": "steps"}
FPS = 100
Size = tuple[int, int]
MILLION = 1_000_000
WITHOUT_REAPING = os.WEXITED | os.WNOHANG | os.WNOWAIT
Facts = dict[str, Any]


def python(*arguments: object, until: Callable[[], bool] | None = None, number: int = 0) -> Facts:
    """A Python process, sent the signal `number` as soon as `until` says so: its exit code, what it
    printed, CPU seconds, and the peak of its memory in MB."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as error:
        process = subprocess.Popen(
            [sys.executable, *map(str, arguments)], stdout=out, stderr=error, cwd=TREE,
            env=os.environ | {"PYTHONPATH": str(TREE), "JAX_PLATFORMS": "cpu"})
        while until is not None and os.waitid(os.P_PID, process.pid, WITHOUT_REAPING) is None:
            if until():
                process.send_signal(number)
                break
            time.sleep(0.02)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        error.seek(0)
        if process.returncode and until is None:
            raise SystemExit(f"failed undisturbed: {arguments}\n{error.read().decode()[-2000:]}")
        return {"code": process.returncode, "out": out.read().decode(),
                "cpu_s": round(usage.ru_utime + usage.ru_stime, 1),
                "peak_mb": round(usage.ru_maxrss / 1e3)}


def call(function: Callable[..., Any], *arguments: object) -> Facts:
    """A function of this file in a process of its own, and the facts that it returned."""
    facts = python("-c", "import json, sys; from tests import long_haul as haul\n"
                   f"print(json.dumps(haul.{function.__name__}(*sys.argv[1:])))", *arguments)
    return facts | json.loads(facts["out"])


# ------------------------------------------------------------------------------------ simulations


def film(seconds: int, size: Size) -> Iterator[np.ndarray]:
    """A second at a time, frames (FPS, H, W), uint8: a view that wanders over a blurred texture."""
    width, height = size
    rough = np.random.default_rng(0).integers(0, 256, (3 * height, 3 * width)).astype(np.float32)
    texture = sum(np.roll(rough, (i, j), (0, 1)) for i in range(6) for j in range(6)) / 36
    texture = np.clip(128 + 4 * (texture - 128), 20, 235).astype(np.uint8)
    for second in range(seconds):
        t = second + np.arange(FPS) / FPS
        rows, columns = height * (1 + np.sin(0.7 * t)), width * (1 + np.sin(0.31 * t))
        yield np.stack([texture[row : row + height, column : column + width] for row, column in
                        zip(rows.astype(int), columns.astype(int), strict=True)])


def events_of(seconds: int, size: Size) -> Iterator[Any]:
    """`simulate_stream` of the film."""
    import jax

    import evflow as ef

    camera = ef.Camera.sample(jax.random.key(0), size[::-1])
    times = (np.arange(FPS) * (MILLION // FPS) + second * MILLION for second in range(seconds))
    return ef.simulate_stream(jax.random.key(1), film(seconds, size), times, camera)


def stream(seconds: str, of: str) -> Facts:
    """Simulate `seconds`; the digest is that of the events of the first `of` seconds."""
    found, count = hashlib.sha256(), 0
    for part in events_of(int(seconds), (128, 96)):
        count += len(part)
        kept = part.slice(0, int(of) * MILLION - MILLION // FPS)  # the last frame of the shorter
        for column in (kept.x, kept.y, kept.t, kept.p):
            found.update(np.ascontiguousarray(column))
    return {"events": count, "digest": found.hexdigest()}


def try_stream(length: int, _: Path) -> Iterator[Facts]:
    for seconds in (length // PARTS, length):
        yield call(stream, seconds, length // PARTS)


# ------------------------------------------------------------------------------------- conversion


def block(million: int) -> tuple[np.ndarray, ...]:
    """x, y, t, p of one million events in the second `million`."""
    rng = np.random.default_rng(million)
    words = rng.integers(0, 1 << 32, MILLION, np.uint32)
    return ((words & 0xFFFF) % 346, (words >> 16 & 0x7FFF) % 260,
            million * MILLION + np.arange(MILLION), words >> 31)


def write_dat(path: Path, millions: int) -> None:
    with path.open("wb") as file:
        file.write(b"% Version 2\n% Width 346\n% Height 260\n\x0c\x08")
        for million in range(millions):
            x, y, t, p = block(million)
            file.write(np.stack([t, p << 28 | y << 14 | x], 1).astype("<u4").tobytes())


def same_events(path: Path, millions: int) -> bool:
    import h5py

    with h5py.File(path) as file:
        group, start = file["events"], int(file["t_offset"][()]) if "t_offset" in file else 0
        for million in range(millions):
            part = slice(million * MILLION, (million + 1) * MILLION)
            for name, made in zip("xytp", block(million), strict=True):
                if not np.array_equal(group[name][part] + (start if name == "t" else 0), made):
                    return False
        return len(group["t"]) == millions * MILLION


def try_convert(length: int, work: Path) -> Iterator[Facts]:
    for millions in (length // PARTS, length):
        source, out = work / "a.dat", work / "a.h5"
        write_dat(source, millions)
        facts = python("-m", "evflow", "convert", source, out)
        source.unlink()
        yield facts | {"digest": same_events(out, millions) or f"other events than {source} held"}
        out.unlink()


# --------------------------------------------------------------------------------- a camera's maps


def record(path: str, seconds: str) -> Facts:
    """Events and frames, 25 a second, of the film."""
    import evflow as ef

    size = 64, 48
    with ef.open_writer(path, size) as out:
        for second, frames in enumerate(film(int(seconds), size)):
            times = np.arange(0, FPS, FPS // 25) * (MILLION // FPS) + second * MILLION
            out.append_frames(frames[:: FPS // 25], times)
        for part in events_of(int(seconds), size):
            out.append(part)
    return {}


def try_estimate(length: int, work: Path) -> Iterator[Facts]:
    for seconds in (length // PARTS, length):
        path, out = work / "recording.h5", work / f"camera-{seconds}"
        call(record, path, seconds)
        yield python("-m", "evflow", "estimate", path, "-o", out, "--no-plots", "--no-report")
        path.unlink()


# ---------------------------------------------------------------------------------------- training


def weights(out: Path) -> str:
    """The digest of the numbers, which the model card beside them has."""
    from safetensors.numpy import load_file

    found = hashlib.sha256()
    for name, array in sorted(load_file(out / "weights.safetensors").items()):
        found.update(name.encode() + array.tobytes())
    return found.hexdigest()


def has_done(out: Path, steps: float) -> bool:
    """Whether a training has come so far."""
    log = out / "metrics.jsonl"
    lines = log.read_text().splitlines() if log.exists() else []
    return len(lines) > 1 and json.loads(lines[-2])["step"] >= steps  # the last may be cut off


def try_train(length: int, work: Path) -> Iterator[Facts]:
    options = ("-m", "evflow", "train", "--preset", "debug", "--steps", length, "--save-every",
               max(length // 50, 1), "--out")
    yield python(*options, work / "undisturbed") | {"digest": weights(work / "undisturbed")}
    rng, out, codes, cpu_s = random.Random(0), work / "killed", list[int](), 0.0
    for kill in range(KILLS):
        target = length * (kill + rng.random()) / (KILLS + 1)
        facts = python(*options, out, until=partial(has_done, out, target),
                       number=SIGNALS[kill % len(SIGNALS)])
        codes.append(facts["code"])
        cpu_s += facts["cpu_s"]
    facts = python(*options, out, "--resume", "must")
    yield facts | {"digest": weights(out), "cpu_s": round(cpu_s + facts["cpu_s"], 1),
                   "kills": sum(code != 0 for code in codes), "codes": sorted(set(codes))}


# --------------------------------------------------------------------------------------------- all


def wrong(name: str, runs: list[Facts]) -> list[str]:
    """What is not as it should be."""
    first, whole = runs
    found = []
    if whole["peak_mb"] > MORE * first["peak_mb"]:
        found.append(f"{name} takes {whole['peak_mb'] / first['peak_mb']:.2f} times the memory")
    if first.get("digest") != whole.get("digest"):
        found.append(f"{name} ends in other bytes")
    if whole.get("kills", KILLS) != KILLS:
        found.append(f"{KILLS - whole['kills']} runs of {name} ended before they were killed")
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=LENGTHS, default=[*LENGTHS])
    parser.add_argument("--scale", type=float, default=1.0, help="of every length")
    parser.add_argument("--work", type=Path, help="folder for the files, gigabytes of them")
    told = parser.parse_args(arguments)
    # What a shell runs in the background ignores Ctrl-C, and so would the commands.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    faults: list[str] = []
    with tempfile.TemporaryDirectory(dir=told.work) as folder:
        for name in told.only:
            length = max(round(told.scale * LENGTHS[name]), PARTS)
            runs = []
            for facts in globals()[f"try_{name}"](length, Path(folder)):
                facts.pop("out")
                runs.append(facts)
                print(f"{name} of {length} {UNITS[name]}, run {len(runs)}: {facts}", flush=True)
            faults += wrong(name, runs)
    print("\n".join(faults) or "memory flat, bytes the same")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())

"""Damaged files, read one by one in a process of its own, and what came of each.

`Bench` keeps that process: it makes the sample, damages it, reads it under a limit of time and
memory, and says how it went; where it dies or hangs it is started again. A case is named by its
kind, seed and index alone, so that any of them can be run again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import resource
import shutil
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from helpers.fuzz_hostile import HOSTILE
from helpers.fuzz_mutations import FOREIGN, mutate
from helpers.fuzz_samples import SAMPLES, Sample

from evflow.errors import EvflowDataError
from evflow.types import Events, Recording

LIMIT_S = 10.0  # for files of some kB, on a busy machine
FREE, RATIO = 256 << 20, 64  # a read may take FREE + RATIO * (size of the file) bytes
Makers = dict[str, Callable[[Path], Sample]]
BAD = ("crash", "hang", "memory", "foreign", "wrong", "pathless")
START_S = 120.0  # for a process to begin


@dataclasses.dataclass(frozen=True)
class Outcome:
    """verdict: "ok", the code of the error, or one of `BAD`: the process died, did not answer,
    took too much memory, raised another exception, returned data that cannot be right, or did not
    name the file. peak: bytes that the read added to the process."""

    kind: str
    index: int | None
    mutation: str
    verdict: str
    detail: str = ""
    seconds: float = 0.0
    peak: int = 0

    @property
    def bad(self) -> bool:
        return self.verdict in BAD

    def __str__(self) -> str:
        return f"{self.kind} {self.index} ({self.mutation}): {self.verdict} {self.detail}"


class Bench:
    """`run` one case after another; use as a context. extra: makers beside `SAMPLES` and
    `HOSTILE`, by name."""

    def __init__(self, folder: Path, extra: Makers | None = None) -> None:
        self.folder, self._extra = folder, extra or {}
        self._context = multiprocessing.get_context("spawn")
        self._process: Any = None

    def __enter__(self) -> Bench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, e: BaseException | None, tb: TracebackType | None
    ) -> None:
        self._stop()

    def _start(self) -> None:
        self._pipe, theirs = self._context.Pipe()
        self._process = self._context.Process(
            target=serve, args=(theirs, self.folder, self._extra), daemon=True)
        self._process.start()
        theirs.close()
        if not self._pipe.poll(START_S) or self._pipe.recv() != "ready":
            raise RuntimeError("the process that reads did not start")

    def _stop(self) -> int | None:
        """Ends the process; its exit code, negative where a signal ended it."""
        if self._process is None:
            return None
        self._process.join(0.2)
        code: int | None = self._process.exitcode
        self._process.kill()
        self._process.join()
        self._pipe.close()
        self._process = None
        return code

    def run(self, kind: str, seed: int = 0, index: int | None = None) -> Outcome:
        """Case `index` of a kind; None: the sample as it is."""
        if self._process is None:
            self._start()
        self._pipe.send((kind, seed, index))
        try:
            if self._pipe.poll(START_S) and self._pipe.recv() and self._pipe.poll(LIMIT_S):
                return Outcome(kind, index, *self._pipe.recv())
        except (EOFError, ConnectionResetError):
            return Outcome(kind, index, "?", "crash", f"exit code {self._stop()}")
        self._stop()
        return Outcome(kind, index, "?", "hang", f"more than {LIMIT_S:g} s", LIMIT_S)


def serve(pipe: Any, folder: Path, extra: Makers) -> None:
    """The process: (kind, seed, index) in; "reading", then the rest of an `Outcome` out."""
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    warnings.simplefilter("error")  # of readers they are a defect
    warnings.simplefilter("ignore", ResourceWarning)
    makers = SAMPLES | HOSTILE | extra
    ready: dict[str, tuple[Sample, Any, list[bytes]]] = {}
    pipe.send("ready")
    while True:
        try:
            kind, seed, index = pipe.recv()
        except EOFError:
            return
        if kind not in ready:
            place = folder / kind
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            made = makers[kind](place)
            whole = index is None  # nothing is damaged, so nothing is compared or put back
            ready[kind] = (made, None if whole else made.read(made.path),
                           [] if whole else [target.read_bytes() for target in made.targets])
        pipe.send(_case(pipe, *ready[kind], [seed, zlib.crc32(kind.encode())], index))


def _case(
    pipe: Any, made: Sample, want: Any, sound: list[bytes], seed: list[int], index: int | None
) -> tuple[str, str, str, float, int]:
    if index is None:
        pipe.send("reading")
        return ("as it is", *_judged(made, None, ""))
    rng = np.random.default_rng([*seed, index])
    which = 0 if rng.random() < 0.5 else int(rng.integers(len(sound)))
    name, data = mutate(rng, sound[which], made.text)
    made.targets[which].write_bytes(data)
    try:
        pipe.send("reading")
        return (name, *_judged(made, want, name))
    finally:
        made.targets[which].write_bytes(sound[which])


def _judged(made: Sample, want: Any, mutation: str) -> tuple[str, str, float, int]:
    size = sum(target.stat().st_size for target in made.targets)
    before, start = _memory("VmRSS"), time.perf_counter()
    verdict, detail = "ok", ""
    with _bounded(FREE + RATIO * size):
        try:
            got = made.read(made.path)
        except EvflowDataError as e:
            verdict, detail = e.code, str(e)
            if _without_path(e, made):
                verdict = "pathless"
            if _lacked_memory(e):
                verdict = "memory"
        except BaseException as e:  # Rust panics are no Exception
            verdict = "memory" if _lacked_memory(e) else "foreign"
            detail = "".join(traceback.format_exception(e)[-6:])
    seconds, peak = time.perf_counter() - start, max(_memory("VmHWM") - before, 0)
    if verdict == "ok":
        detail = wrong(got, want, made, mutation)
        verdict = "wrong" if detail else "ok"
    if peak > FREE + RATIO * size and verdict not in BAD:
        verdict, detail = "memory", f"{peak:,} bytes"
    return verdict, detail, seconds, peak


@contextlib.contextmanager
def _bounded(more: int) -> Iterator[None]:
    """The process may take `more` bytes of address space, and its peak begins anew."""
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + more, hard))
    Path("/proc/self/clear_refs").write_text("5")
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


def _memory(name: str) -> int:
    """A line of /proc/self/status in bytes."""
    text = Path("/proc/self/status").read_text()
    return int(text.split(f"{name}:")[1].split()[0]) * 1024


def _without_path(error: EvflowDataError, at: Sample) -> bool:
    """Whether the message leaves open which file it is about, or names it twice over."""
    named = [str(path) for path in (at.path, *at.targets) if str(path) in str(error)]
    return not named or any(f"{at.path}: {name}" in error.seen for name in named)


def _lacked_memory(e: BaseException | None) -> bool:
    """Whether any exception in the chain says that memory was refused."""
    while e is not None:
        text = str(e).lower()
        if isinstance(e, MemoryError) or "alloc" in text or "insufficient memory" in text:
            return True
        e = e.__cause__ or e.__context__
    return False


# ------------------------------------------------------------------------------ is it right?


def wrong(got: Any, want: Any, made: Sample, mutation: str) -> str:
    """What cannot be right in data that was read without complaint, "" where nothing is."""
    if isinstance(got, Recording):
        ev = got.events
        try:
            again = Recording(Events(ev.x, ev.y, ev.t, ev.p, ev.size), got.frames, got.frame_times)
        except EvflowDataError as e:
            return f"not a valid recording: {e}"
        kinds = [getattr(ev, name).dtype.str[1:] for name in "xytp"]
        if kinds != ["u2", "u2", "i8", "b1"] or got.frame_times.dtype != np.int64:
            return f"columns of {kinds}, {again!r}"
    if want is None or mutation in FOREIGN:
        return ""
    if made.sealed or (mutation == "cut" and made.counted):
        return "" if same(got, want) else "other data than was written"
    if mutation == "cut" and isinstance(got, Recording) and not begins(sure(got), want):
        return "not a beginning of what was written"
    return ""


def sure(got: Recording) -> Recording:
    """A recording without its last event where a note says that digits of it may be missing."""
    if all(note.code != "events.unended" for note in got.notes):
        return got
    x, y, t, p = (getattr(got.events, name)[:-1] for name in "xytp")
    return dataclasses.replace(got, events=Events(x, y, t, p, got.events.size))


def same(got: Any, want: Any) -> bool:
    a, b = flat(got), flat(want)
    return len(a) == len(b) and all(map(np.array_equal, a, b))


def begins(got: Recording, want: Recording) -> bool:
    """Whether a recording's events and frames are the first of another's."""
    n, k = len(got.events), len(got.frames)
    x, y, t, p = (getattr(want.events, c)[:n] for c in "xytp")
    first = Events(x, y, t, p, want.events.size)
    return same(got, Recording(first, want.frames[:k], want.frame_times[:k]))


def flat(value: Any) -> list[np.ndarray]:
    """The arrays of a recording, a camera, parameters or masks, one after another."""
    if isinstance(value, Recording):
        ev = value.events
        return [ev.x, ev.y, ev.t, ev.p, np.array(ev.size), value.frames, value.frame_times]
    if isinstance(value, list):
        return value
    import jax

    return [np.asarray(leaf) for leaf in jax.tree.leaves(value)]

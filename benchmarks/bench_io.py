"""Recordings from and to disk, one core: every binary format that is read, all that are written.

Two million events of 640x480 at 10 M events/s, in rows of four neighbours as an edge sends them
(EVT 3.0 is made for such); files lie in a temporary folder, in the page cache.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.harness import Case, Setting, Workload
from evflow.io import read_events, write_events
from evflow.types import Events

SIZE = (640, 480)
ROW = 4  # events that share a row and a microsecond
HEADER = b"% width 640\n% height 480\n"


def events(setting: Setting) -> Events:
    rng = np.random.default_rng(0)
    rows = 250 if setting.quick else 500_000
    x = (rng.integers(0, SIZE[0] - ROW, rows)[:, None] + np.arange(ROW)).ravel()
    y, t = rng.integers(0, SIZE[1], rows), np.sort(rng.integers(0, rows * ROW // 10, rows))
    return Events(x, np.repeat(y, ROW), np.repeat(t, ROW), np.repeat(rng.random(rows) < 0.5, ROW),
                  SIZE)


def changes(values: np.ndarray) -> np.ndarray:
    """(N,) bool: which values differ from the one before."""
    return np.diff(values, prepend=values[0] - 1) != 0


def evt2(e: Events) -> bytes:
    t, x, y = e.t.astype(np.uint32), e.x.astype(np.uint32), e.y.astype(np.uint32)
    words = np.stack([8 << 28 | t >> 6, e.p.astype(np.uint32) << 28 | (t & 63) << 22 | x << 11 | y],
                     1).astype("<u4")
    return b"% evt 2.0\n" + HEADER + words[np.stack(
        [changes(e.t >> 6), np.ones(len(e), bool)], 1)].tobytes()


def evt3(e: Events) -> bytes:
    """Time, row and single events: no vectors, which would be easier to read."""
    words = np.stack([8 << 12 | e.t >> 12, 6 << 12 | e.t & 0xFFF, e.y.astype(np.int64),
                      2 << 12 | e.p.astype(np.int64) << 11 | e.x], 1).astype("<u2")
    high, low = changes(e.t >> 12), changes(e.t)
    return b"% evt 3.0\n" + HEADER + words[np.stack(
        [high, low, low | changes(e.y.astype(int)), np.ones(len(e), bool)], 1)].tobytes()


def dat(e: Events) -> bytes:
    words = np.stack([e.t, e.p.astype(np.int64) << 28 | e.y.astype(np.int64) << 14 | e.x], 1)
    return b"% Version 2\n" + HEADER + b"\x0c\x08" + words.astype("<u4").tobytes()


def reading(setting: Setting, name: str, encode: Callable[[Events], bytes] | None) -> Workload:
    """encode: the file's bytes; None: what evflow itself writes."""
    path, made = Path(tempfile.mkdtemp()) / name, events(setting)
    if encode is None:
        write_events(path, made, name.partition(".")[0])
    else:
        path.write_bytes(encode(made))

    got = read_events(path)
    assert all(np.array_equal(getattr(got, n), getattr(made, n)) for n in "xytp")
    note = f"{_bytes(path) / len(made):.1f} B/event"
    return Workload(_until_dropped(lambda: read_events(path), path), partial(_work, path), note)


def writing(setting: Setting, name: str) -> Workload:
    path, made = Path(tempfile.mkdtemp()) / name, events(setting)

    def call() -> Events:
        write_events(path, made, name.partition(".")[0], overwrite=True)
        return made

    return Workload(_until_dropped(call, path), partial(_work, path))


def _until_dropped(call: Callable[[], Events], path: Path) -> Callable[[], Events]:
    """The call, with which the folder of its file goes."""
    weakref.finalize(call, shutil.rmtree, path.parent, ignore_errors=True)
    return call


def _bytes(path: Path) -> int:
    return sum(os.path.getsize(p) for p in path.iterdir()) if path.is_dir() else path.stat().st_size


def _work(path: Path, result: Events) -> dict[str, float]:
    return {"events": len(result), "GB": 1e-9 * (13 * len(result) + _bytes(path))}


CASES = (
    *(Case("io", "read", f"evflow, {name}", partial(reading, name=name, encode=encode), needs)
      for name, encode, needs in (
          ("dat.dat", dat, ""), ("evt2.raw", evt2, ""), ("evt3.raw", evt3, ""),
          ("dsec.h5", None, "h5py"), ("npz.npz", None, ""), ("evreal", None, ""),
          ("event_utils.h5", None, "h5py"), ("aedat4.aedat4", None, "aedat"),
          ("e2vid.zip", None, ""))),
    *(Case("io", "write", f"evflow, {name}", partial(writing, name=name), needs)
      for name, needs in (
          ("dsec.h5", "h5py"), ("npz.npz", ""), ("evreal", ""), ("event_utils.h5", "h5py"),
          ("aedat4.aedat4", ""), ("e2vid.zip", ""))),
)

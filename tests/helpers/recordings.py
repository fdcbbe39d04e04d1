"""Small recordings in every format that can be made here, for the tests of evflow.io."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.io import read_recording
from evflow.types import Events, Recording

SIZE = (64, 48)
T0 = 1_643_243_628_737_093  # an epoch time: neither int32 nor float32 holds it


def make(n: int = 2000, count: int = 6, dtype: Any = np.uint8, span: int = 300_000) -> Recording:
    rng = np.random.default_rng(n)
    t = T0 + np.sort(rng.integers(0, span, n))
    events = Events(rng.integers(0, 64, n), rng.integers(0, 48, n), t, rng.integers(0, 2, n), SIZE)
    frames = rng.integers(0, 250, (count, 48, 64)).astype(dtype)
    return Recording(events, frames, T0 + 1000 + 50_000 * np.arange(count))


def equal(a: Events, b: Events) -> None:
    assert a.size == b.size
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def write_ijrr(folder: Path, recording: Recording) -> Path:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    ev, times = recording.events, recording.frame_times
    rows = [f"{(t - T0) / 1e6:.9f} {x} {y} {int(p)}\n"
            for x, y, t, p in zip(ev.x, ev.y, ev.t, ev.p, strict=True)]
    (folder / "events.txt").write_text("".join(rows))
    names = [f"images/frame_{i:08d}.png" for i in range(len(times))]
    (folder / "images.txt").write_text("".join(
        f"{(t - T0) / 1e6:.9f} {name}\n" for t, name in zip(times, names, strict=True)))
    for name, frame in zip(names, recording.frames, strict=True):
        assert cv2.imwrite(str(folder / name), frame)
    return folder


def zipped(folder: Path, inside: str) -> Path:
    path = folder.with_suffix(".zip")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*.*")):
            archive.write(file, inside + str(file.relative_to(folder)))
    return path


def refused(path: Path, **hints: Any) -> EvflowDataError:
    with pytest.raises(EvflowDataError) as raised:
        read_recording(path, **hints)
    return raised.value


def mutations(source: bytes, count: int = 60) -> Any:
    """Copies cut off anywhere, or with 1-3 bytes changed, half of them near the beginning."""
    rng = np.random.default_rng(0)
    for k in range(count):
        data = bytearray(source)
        if k % 3 == 0:
            yield bytes(data[: rng.integers(len(data))])
            continue
        for _ in range(rng.integers(1, 4)):
            end = len(data) if rng.random() < 0.5 else min(len(data), 4000)
            data[rng.integers(end)] = rng.integers(256)
        yield bytes(data)


def survives(path: Path) -> bool:
    """True if the file was read, False if refused; anything else fails the test."""
    try:
        recording = read_recording(path)
    except EvflowDataError:
        return False
    assert isinstance(recording, Recording)
    return True


def damage(target: Path, count: int, survives: Callable[[], bool]) -> None:
    """`count` damaged copies in place of the file: each is read or refused, some are refused; and
    the file itself is read again."""
    sound = target.read_bytes()
    read = 0
    for data in mutations(sound, count):
        target.write_bytes(data)
        read += survives()
    assert read < count
    target.write_bytes(sound)
    assert survives()

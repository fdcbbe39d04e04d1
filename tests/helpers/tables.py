"""Recordings in the layouts of tables and text, written by hand."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.recordings import SIZE, T0, make

from evflow.types import Events, Recording

DAVIS = (346, 260)
BASE = {"v2e": T0, "v2e-text": T0, "e2vid": T0, "evreal": T0, "evimo2": T0}
# the epoch of MVSEC, 1.5e9 s, leaves float64 0.24 us: still the right microsecond


def based(recording: Recording, zero: int, size: tuple[int, int] = SIZE) -> Recording:
    ev = recording.events
    frames = np.zeros((len(recording.frames), size[1], size[0]), np.uint8)
    frames[:, : SIZE[1], : SIZE[0]] = recording.frames
    return Recording(Events(ev.x, ev.y, ev.t - zero, ev.p, size), frames,
                     recording.frame_times - zero)


def want(kind: str, n: int = 2000) -> Recording:
    """What the file written by `write(..., kind)` must read as."""
    recording = based(make(n), BASE.get(kind, 0), DAVIS if kind == "mvsec" else SIZE)
    return recording if kind in ("v2e", "mvsec", "event_utils", "evreal") else Recording.of_events(
        recording.events)


def rows(recording: Recording) -> list[tuple[int, int, int, int]]:
    ev = recording.events
    return [(int(t), int(x), int(y), int(p))
            for t, x, y, p in zip(ev.t, ev.x, ev.y, ev.p, strict=True)]


def write_v2e(folder: Path, r: Recording) -> Path:
    with h5py.File(folder / "a.h5", "w", libver=("v110", "v110")) as f:
        f.create_dataset("events", data=np.array(rows(r), "u4").reshape(-1, 4), compression="gzip")
        f.create_dataset("frame", data=r.frames, compression="gzip")
        f["frame_ts"] = r.frame_times.astype("u4")
        f["frame_idx"] = np.zeros(len(r.frames), "u8")
    return folder / "a.h5"


def write_mvsec(folder: Path, r: Recording) -> Path:
    table = [(x, y, t / 1e6, 2.0 * p - 1) for t, x, y, p in rows(r)]
    with h5py.File(folder / "a.hdf5", "w", libver=("v110", "v110")) as f:
        f["davis/left/events"] = np.array(table, float).reshape(-1, 4)
        f.create_dataset("davis/left/image_raw", data=r.frames, compression="gzip")
        f["davis/left/image_raw_ts"] = r.frame_times / 1e6
        f["davis/right/imu"] = np.zeros(3)
    return folder / "a.hdf5"


def write_event_utils(folder: Path, r: Recording) -> Path:
    with h5py.File(folder / "a.h5", "w", libver=("v110", "v110")) as f:
        f["events/xs"], f["events/ys"] = r.events.x, r.events.y
        f["events/ts"], f["events/ps"] = r.events.t / 1e6, r.events.p
        for i, (frame, t) in enumerate(zip(r.frames, r.frame_times, strict=True)):
            f[f"images/image{i:09d}"] = frame
            f[f"images/image{i:09d}"].attrs["timestamp"] = t / 1e6
        f.attrs["sensor_resolution"] = (SIZE[1], SIZE[0])
    return folder / "a.h5"


def write_text(folder: Path, r: Recording) -> Path:
    lines = ["#!events.txt", "# This is a text DVS created by v2e", "# User name: a"]
    lines += [f"{t / 1e6} {x} {y} {p} {x % 2}" for t, x, y, p in rows(r)]
    (folder / "a.txt").write_text("\n".join(lines) + "\n")
    return folder / "a.txt"


def write_csv(folder: Path, r: Recording) -> Path:
    lines = ["polarity,timestamp_us,x,y", *(f"{p},{t},{x},{y}" for t, x, y, p in rows(r))]
    (folder / "a.csv").write_text("\n".join(lines) + "\n")
    return folder / "a.csv"


def write_e2vid(folder: Path, r: Recording) -> Path:
    lines = [f"{r.events.size[0]} {r.events.size[1]}"]
    lines += [f"{t / 1e6:.9f} {x} {y} {p}" for t, x, y, p in rows(r)]
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("dynamic_6dof.txt", "\n".join(lines) + "\n")
    return folder / "a.zip"


def write_evreal(folder: Path, r: Recording) -> Path:
    folder = folder / "boxes"
    folder.mkdir(exist_ok=True)
    np.save(folder / "events_ts.npy", r.events.t / 1e6)
    np.save(folder / "events_xy.npy", np.stack([r.events.x, r.events.y], 1))
    np.save(folder / "events_p.npy", r.events.p.astype(np.uint8))
    np.save(folder / "images.npy", r.frames[..., None])
    np.save(folder / "images_ts.npy", r.frame_times[:, None] / 1e6)
    (folder / "metadata.json").write_text(json.dumps({"sensor_resolution": [SIZE[1], SIZE[0]]}))
    return folder


def write_evimo2(folder: Path, r: Recording) -> Path:
    folder = folder / "samsung_mono/imo/eval/scene_00"
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "dataset_events_t.npy", r.events.t[:, None] / 1e6)
    np.save(folder / "dataset_events_xy.npy", np.stack([r.events.x, r.events.y], 1))
    np.save(folder / "dataset_events_p.npy", 1 - r.events.p.astype(np.int16)[:, None])
    return folder


WRITERS: dict[str, Callable[[Path, Recording], Path]] = {
    "v2e": write_v2e, "mvsec": write_mvsec, "event_utils": write_event_utils,
    "v2e-text": write_text, "text": write_csv, "e2vid": write_e2vid, "evreal": write_evreal,
    "evimo2": write_evimo2}
each = pytest.mark.parametrize("kind", WRITERS)


def write(folder: Path, kind: str, n: int = 2000) -> Path:
    recording = based(make(n), BASE.get(kind, 0), DAVIS if kind == "mvsec" else SIZE)
    return WRITERS[kind](folder, recording)


def hint(kind: str) -> dict[str, tuple[int, int]]:
    return {"size": SIZE} if kind in ("v2e-text", "text", "evimo2") else {}

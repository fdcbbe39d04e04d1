"""Small sound files of formats that cameras, data sets and other tools write, for fuzzing."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from helpers import ecf, streams
from helpers.fuzz_sample import FRAMES, N, Sample, sample
from helpers.recordings import SIZE, make


def metavision(folder: Path, forms: tuple[int | None, ...]) -> Sample:
    return sample(ecf.write(folder / "a.hdf5", streams.clustered(N), forms, geometry="240x180"),
                  counted=True)


def flat_hdf5(folder: Path, kind: str) -> Sample:
    """Columns in a group of another name, or N x 4."""
    ev = make(N).events
    columns = {"x": ev.x, "y": ev.y, "t": ev.t, "p": ev.p.astype(np.uint8)}
    with h5py.File(folder / "a.h5", "w", libver=("v110", "v110")) as f:
        for name, column in columns.items() if kind == "columns" else ():
            f[f"prophesee/left/{name}"] = column
        if kind == "matrix":
            f["all"] = np.stack([columns[name].astype(np.float64) for name in "xytp"], 1)
        f.attrs["width"], f.attrs["height"] = SIZE
    return sample(folder / "a.h5", counted=True)


def npy(folder: Path, kind: str) -> Sample:
    """N x 4, or records."""
    ev = make(N).events
    columns = {"x": ev.x, "y": ev.y, "t": ev.t, "p": ev.p}
    if kind == "matrix":
        np.save(folder / "a.npy", np.stack([columns[c].astype(np.int64) for c in "xytp"], 1))
    else:
        np.save(folder / "a.npy", np.rec.fromarrays(list(columns.values()), names="x,y,t,p"))
    return sample(folder / "a.npy", counted=True, size=SIZE)


SMALL = (16, 12)  # a sensor, so that frames are


def small_davis(folder: Path, kind: str) -> Sample:
    """Events and two frames: of APS samples in AEDAT 2, in packets in AEDAT 3."""
    rng, path = np.random.default_rng(0), folder / "a.aedat"
    times = np.sort(rng.integers(0, 60_000, 100))
    if kind == "aedat2":
        words = [(int(t), int(rng.integers(12)) << 22 | int(rng.integers(16)) << 12 | 0x800)
                 for t in times]
        words += [(1000 + 30_000 * i + 5000 * read + 20 * x,
                   1 << 31 | y << 22 | x << 12 | read << 10 | 900 - 90 * read)
                  for i in range(FRAMES) for read in (0, 1) for x in range(16) for y in range(12)]
        data = b"#!AER-DAT2.0\r\n" + np.array(
            [(address, t) for t, address in sorted(words)], ">u4").tobytes()
    else:
        data = b"#!AER-DAT3.1\r\n#!END-HEADER\r\n"
        for i, part in enumerate(np.array_split(times, FRAMES)):
            events = [(int(rng.integers(16)) << 17 | int(rng.integers(12)) << 2 | 1, t)
                      for t in part]
            data += streams.aedat3_packet(1, 8, np.array(events, "<u4").tobytes())
            head = struct.pack("<Iiiiiiiii", 3, 0, 0, 9000 * i, 9000 * i + 500, *SMALL, 0, 0)
            data += streams.aedat3_packet(2, 36 + 384, head + rng.bytes(384))
    path.write_bytes(data)
    return sample(path, size=SMALL)


def openeb(folder: Path) -> Sample:
    rows = (f"{x},{y},{p},{t}" for x, y, t, p in streams.listed(streams.clustered(N)))
    (folder / "a.csv").write_text("\n".join(("%geometry:240,180", *rows)) + "\n")
    return sample(folder / "a.csv", text=True)


def nmnist(folder: Path) -> Sample:
    """Times within 23 bits; an overflow among the events."""
    ev = streams.clustered(N)
    rows = [bytes([x, y, p << 7 | t >> 16, t >> 8 & 255, t & 255])
            for x, y, t, p in streams.listed(ev)]
    (folder / "a.bin").write_bytes(b"".join([*rows[:50], bytes([0, 240, 0, 0, 0]), *rows[50:]]))
    return sample(folder / "a.bin")


FORMATS: dict[str, Callable[[Path], Sample]] = {
    "metavision": partial(metavision, forms=(0, 1, 2)),
    "metavision-plain": partial(metavision, forms=()),
    "hdf5-columns": partial(flat_hdf5, kind="columns"),
    "hdf5-matrix": partial(flat_hdf5, kind="matrix"),
    "aedat2-frames": partial(small_davis, kind="aedat2"),
    "aedat3-frames": partial(small_davis, kind="aedat3"), "text-openeb": openeb,
    "nmnist": nmnist, "npy-matrix": partial(npy, kind="matrix"),
    "npy-records": partial(npy, kind="records"),
}

"""Hostile HDF5: something else where a data set should be, claims without data, many links to one
data set."""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from helpers import ecf, streams, tables
from helpers.fuzz_registry import HOSTILE, each, hostile
from helpers.fuzz_samples import SAMPLES, Sample, sample
from helpers.recordings import make

from evflow.io import write_events

PLACES = {"dsec": ("events/t", "events/x", "frames", "frame_times", "t_offset"),
          "v2e": ("events", "frame", "frame_ts"),
          "mvsec": ("davis/left/events", "davis/left/image_raw", "davis/left/image_raw_ts"),
          "metavision": ("CD/events",), "hdf5-columns": ("prophesee/left/t",),
          "hdf5-matrix": ("all",),
          "event_utils": ("events/ts", "events/ps", "images/image000000001")}
COMPOUND = np.dtype([("a", "<u2"), ("b", "<f8")])


def instead(f: Any, name: str, what: str) -> None:
    """Put something else where the data set `name` is."""
    shape = getattr(f[name], "shape", ())
    del f[name]
    data = {
        "strings": lambda: np.full(shape, b"abc"), "scalar": lambda: np.float64(3),
        "compound": lambda: np.zeros(shape, COMPOUND), "complex": lambda: np.zeros(shape, "c8"),
        "deep": lambda: np.zeros((*shape, 2)), "empty": lambda: h5py.Empty("f4"),
        "nan": lambda: np.full(shape, np.nan), "huge": lambda: np.full(shape, 2**64 - 1, "u8"),
        "references": lambda: np.full(shape, f.ref, h5py.ref_dtype),
        "dates": lambda: np.zeros(shape, "i8").astype("V8")}
    if what in data:
        f[name] = data[what]()
    elif what == "group":
        f.create_group(name)
    elif what == "dangling":
        f[name] = h5py.SoftLink("/nowhere")
    elif what == "circle":
        f[name] = h5py.SoftLink("/" + name)
    elif what == "elsewhere":
        f[name] = h5py.ExternalLink("/etc/passwd", "/x")
    elif what == "itself":
        layout = h5py.VirtualLayout(shape, "f8")
        layout[...] = h5py.VirtualSource(".", name, shape)
        f.create_virtual_dataset(name, layout)
    elif what == "claims":
        f.create_dataset(name, (1 << 40, *shape[1:]), "u4", chunks=(9, *shape[1:]))
    elif what == "blocks":
        f.create_dataset(name, (9, *shape[1:]), "f8", chunks=(1 << 22, *shape[1:]),
                         maxshape=(None, *shape[1:]))
    elif what == "foreign-file":
        f.create_dataset(name, shape, "u1", external=[("/etc/passwd", 0, 1 << 20)])
    else:
        assert what == "vlen"
        f.create_dataset(name, shape, h5py.vlen_dtype("i4"))


WHAT = ("strings", "scalar", "compound", "complex", "deep", "empty", "nan", "huge", "references",
        "dates", "group", "dangling", "circle", "elsewhere", "claims", "blocks",
        "foreign-file", "itself", "vlen")


def hdf5(folder: Path, kind: str, place: str, what: str) -> Sample:
    if kind == "dsec":
        path = folder / "a.h5"
        write_events(path, make(50, 2))
    elif kind in SAMPLES and kind not in tables.WRITERS:
        path = SAMPLES[kind](folder).path
    else:
        path = tables.write(folder, kind, 50)
    with h5py.File(path, "a") as f:
        instead(f, place, what)
    return sample(path)


for _kind, _places in PLACES.items():
    for _place in _places:
        HOSTILE |= {f"hostile-{_kind}-{_place.replace('/', '-')}-{_what}":
                    partial(hdf5, kind=_kind, place=_place, what=_what) for _what in WHAT
                    if _place != "t_offset" or _what not in ("foreign-file", "itself")}
                    # HDF5 keeps scalars


@hostile
def many_links_to_one_image(folder: Path) -> Sample:
    path = tables.write(folder, "event_utils", 50)
    with h5py.File(path, "a") as f:
        del f["images"]
        f.attrs["sensor_resolution"] = (1024, 1024)  # that of the images, or they are left out
        f.create_dataset("images/0", (1024, 1024), "u1", chunks=(1024, 1024), compression="gzip")
        f["images/0"][:] = 0
        f["images/0"].attrs["timestamp"] = 0.1
        for i in range(1, 1000):
            f[f"images/{i:09d}"] = f["images/0"]
    return sample(path)


@each(stays=(1, 0), back=(1, 2**64 - 24), back_to_itself=(1, 2**64 - 16), leaves=(1, 1 << 40),
      first=(0, 0), small=(0, 8))
def heap(folder: Path, case: tuple[int, int]) -> Sample:
    """Text of variable length, in whose heap an object is free space of such a size."""
    which, size = case
    path = ecf.write(folder / "a.hdf5", streams.clustered(9), (), geometry="240x180")
    data = bytearray(path.read_bytes())
    struct.pack_into("<HHIQ", data, data.index(b"GCOL") + 16 + 24 * which, 0, 1, 0, size)
    path.write_bytes(data)
    return sample(path)

"""Blocks of HDF5 data sets: whole ones of every filter are read, those that are missing or expand
beyond their size are refused before HDF5 unpacks them."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.io.decode.hdf5 import plausible
from evflow.io.decode.hdf5_contained import File

VALUES = np.arange(1000, dtype="u2")
BLOCKS = {"chunks": (300,)}
SOUND: dict[str, dict[str, Any]] = {
    "contiguous": {}, "plain": BLOCKS, "lzf": BLOCKS | {"compression": "lzf"},
    "gzip": BLOCKS | {"compression": "gzip", "shuffle": True, "fletcher32": True},
    "scaled": BLOCKS | {"scaleoffset": 0, "compression": "gzip"},
    **{name: BLOCKS | dict(options) for name, options in {
        "blosc": hdf5plugin.Blosc(), "lz4": hdf5plugin.LZ4(), "zstd": hdf5plugin.Zstd(),
        "bzip2": hdf5plugin.BZip2(), "bits": hdf5plugin.Bitshuffle(cname="none"),
        "bits_lz4": hdf5plugin.Bitshuffle(), "bits_zstd": hdf5plugin.Bitshuffle(cname="zstd")
    }.items()}}


def read(path: Path) -> np.ndarray:
    with File(path) as f:
        return np.asarray(plausible(path, f["a"]))


@pytest.mark.parametrize("name", SOUND)
@pytest.mark.parametrize("userblock", [0, 512])
def test_whole_blocks_are_read(tmp_path: Path, name: str, userblock: int) -> None:
    with h5py.File(tmp_path / "a.h5", "w", userblock_size=userblock) as f:
        f.create_dataset("a", data=VALUES, **SOUND[name])
    np.testing.assert_array_equal(read(tmp_path / "a.h5"), VALUES)


@pytest.mark.parametrize("made", [
    {"shape": (0,), "dtype": "u2"}, {"shape": (0,), "dtype": "u2", "chunks": (9,),
                                     "maxshape": (None,)}, {"data": h5py.Empty("u2")}])
def test_nothing_needs_no_blocks(tmp_path: Path, made: dict[str, Any]) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as f:
        f.create_dataset("a", **made)
    with File(tmp_path / "a.h5") as f:
        assert not plausible(tmp_path / "a.h5", f["a"]).size


def stored(raw: bytes, mask: int = 0, **made: Any) -> Callable[[Any], None]:
    """A data set of 1,000 bytes, whose only block is `raw`."""
    def write(f: Any) -> None:
        data = f.create_dataset("a", (1000,), "u1", **{"chunks": (1000,)} | made)
        data.id.write_direct_chunk((0,), raw, mask)

    return write


def unwritten(**made: Any) -> Callable[[Any], None]:
    def write(f: Any) -> None:
        data = f.create_dataset("a", (1000,), "u1", **made)
        if made:
            data[:300] = 1

    return write


def twice(f: Any) -> None:
    """Packed by DEFLATE, shuffled, and packed again."""
    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_chunk((1000,))
    made.set_deflate(9)
    made.set_shuffle()
    made.set_deflate(9)
    data = h5py.h5d.create(f.id, b"a", h5py.h5t.NATIVE_UINT8, h5py.h5s.create_simple((1000,)), made)
    data.write_direct_chunk((0,), zlib.compress(zlib.compress(bytes(1 << 20))))


LONG = zlib.compress(os.urandom(1 << 19), 0)
LZ4, BLOSC, ZSTD = (struct.pack(">QI", 1 << 33, 9), struct.pack("<IIII", 2, 1 << 31, 9, 9),
                    b"\x28\xb5\x2f\xfd" + b"\xe0" + struct.pack("<Q", 1 << 33))
DAMAGED: dict[str, tuple[Callable[[Any], None], str]] = {
    "never": (unwritten(), "was never written"),
    "holes": (unwritten(chunks=(100,)), "has 3 of its 10 blocks"),
    "large": (stored(b"x", chunks=(1 << 29,), maxshape=(None,)), "claims 536,870,912 bytes"),
    "gzip": (stored(LONG, compression="gzip"), "expands to 1,001 or more"),
    "skips": (stored(LONG, 2, compression="gzip", fletcher32=True), "expands to 1,001 or more"),
    "twice": (twice, "went through filter 1"),
    "blosc": (stored(BLOSC, **hdf5plugin.Blosc()), "expands to 2,147,483,648"),
    "lz4": (stored(LZ4, **hdf5plugin.LZ4()), "expands to 8,589,934,592"),
    "zstd": (stored(ZSTD, **hdf5plugin.Zstd()), "expands to 8,589,934,592"),
    "bits": (stored(LZ4, **hdf5plugin.Bitshuffle()), "expands to 8,589,934,592")}


@pytest.mark.parametrize("name", DAMAGED)
def test_others_are_refused(tmp_path: Path, name: str) -> None:
    write, why = DAMAGED[name]
    with h5py.File(tmp_path / "a.h5", "w") as f:
        write(f)
    with pytest.raises(EvflowDataError, match=f"EV009.*a.h5: .*{why}"):
        read(tmp_path / "a.h5")


def test_links_within_links_are_counted(tmp_path: Path) -> None:
    """Each leads through 300 of the one before: followed without a count, 300^5 in all."""
    with h5py.File(tmp_path / "a.h5", "w") as f:
        f["a"] = VALUES
        f["level0"] = h5py.SoftLink("/")
        for level in range(1, 6):
            f[f"level{level}"] = h5py.SoftLink("/".join([f"level{level - 1}"] * 300))
        f["short"] = h5py.SoftLink("/level0/level0/a")
    with File(tmp_path / "a.h5") as f:
        assert f["short"].shape == VALUES.shape
        with pytest.raises(ValueError, match="leads nowhere"):
            f["level5/a"]

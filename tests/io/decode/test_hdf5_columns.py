"""Columns of HDF5 that are compressed here are what HDF5 reads, and as small as its own."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from evflow.io.decode.hdf5_columns import FILTERS, Column

RNG = np.random.default_rng(0)
N, CHUNK = 50_000, 1 << 14
KINDS = {
    "coordinates": RNG.integers(0, 640, N).astype(np.uint16),
    "scanned rows": np.tile(np.arange(640, dtype=np.uint16), N // 640 + 1)[:N],
    "times": np.sort(RNG.integers(0, 10_000, N)).astype(np.uint32),
    "seconds": np.sort(RNG.integers(0, 10**6, N)) / 1e6,
    "polarity": RNG.random(N) < 0.5,
    "one value": np.full(N, 7, np.int64),
    "negative": RNG.integers(-5, 5, N).astype(np.int16),
    "a few": np.arange(3, dtype=np.uint8),
    "one chunk": RNG.integers(0, 9, CHUNK).astype(np.uint8),
    "none": np.zeros(0, np.uint8)}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("step", [1_000, CHUNK, N])
def test_hdf5_reads_what_was_written(kind: str, step: int, tmp_path: Path) -> None:
    values = KINDS[kind]
    with h5py.File(tmp_path / "file.h5", "w") as f:
        own, stock = (f.create_dataset(name, (0,), values.dtype, maxshape=(None,), chunks=(CHUNK,),
                                       **FILTERS) for name in ("own", "stock"))
        column = Column(own)
        for first in range(0, len(values), step):
            column.extend(values[first : first + step])
        column.settle()
        stock.resize(values.shape)
        stock[:] = values
    with h5py.File(tmp_path / "file.h5") as f:
        np.testing.assert_array_equal(f["own"][()], values)
        assert f["own"].id.get_num_chunks() == f["stock"].id.get_num_chunks()
        limit = 1.05 * f["stock"].id.get_storage_size() + 300 * f["own"].id.get_num_chunks()
        assert f["own"].id.get_storage_size() <= limit


def test_values_take_the_type_of_the_column(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "file.h5", "w") as f:
        column = Column(f.create_dataset("t", (0,), "u4", maxshape=(None,), chunks=(8,), **FILTERS))
        column.extend(np.arange(5))
        column.settle()
        np.testing.assert_array_equal(f["t"][()], np.arange(5))
        column.extend(np.arange(5, 20))  # goes on from where it can be read
        column.settle()
        np.testing.assert_array_equal(f["t"][()], np.arange(20))

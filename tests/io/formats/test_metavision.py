"""Metavision's HDF5: the three forms of ECF, blocks without it, sizes, and what is damaged."""

from __future__ import annotations

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers import ecf as encoder
from helpers.recordings import equal, refused
from helpers.streams import clustered

from evflow.io import read_events, read_recording
from evflow.io.decode import ecf
from evflow.types import Events


@pytest.mark.parametrize("forms", [(), (0,), (1,), (2,), (0, 1, 2, None)])
def test_every_form_is_read(tmp_path: Path, forms: tuple[int | None, ...]) -> None:
    path = encoder.write(tmp_path / "a.hdf5", clustered(500), forms, geometry="240x180")
    equal(read_events(path), clustered(500))
    part = read_events(path, start_s=0.002, stop_s=0.004)
    equal(part, clustered(500).slice(3000, 5000))
    assert refused(path, size=(100, 180)).code == "EV005"


def test_long_runs_and_steps() -> None:
    """Counts beyond 15, 31 and 127; steps beyond 15 us, of 0x1234567 and of two weeks."""
    rng = np.random.default_rng(0)
    steps = [0] * 200 + [15, 16, 0x1234567, 14 * 86_400 * 10**6, 1, 0, 3] * 9
    t = np.cumsum(steps) + 7
    n = len(t)
    x = np.sort(rng.integers(0, 1280, n))
    y, p = np.repeat([2, 700], [n - 40, 40]), np.repeat([1, 0], [n - 9, 9])
    rows = list(zip(*(c.tolist() for c in (x, y, t, p)), strict=True))
    for form in (0, 1, 2):
        found = ecf.decode(encoder.encode(rows, form))
        for name, want in zip("xytp", (x, y, t, p), strict=True):
            np.testing.assert_array_equal(getattr(found, name), want)


def test_bytes_by_hand() -> None:
    """Two events at 1000 us, and one 17 us later: a step of 15 adds its nibbles, lowest first."""
    data = struct.pack("<Iq", 3 << 2, 1000) + bytes([0x02, 0xF1, 0xF1, 0x01])
    data += struct.pack("<2H", 50 << 5 | 2, 51 << 5 | 1)
    data += struct.pack("<2H", 100 << 5 | 0b01000, 9 << 5) + bytes([1 << 7 | 2, 1])
    found = ecf.decode(data)
    assert found.t.tolist() == [1000, 1000, 1017]
    assert found.x.tolist() == [100, 102, 9]
    assert found.y.tolist() == [50, 50, 51]
    assert found.p.tolist() == [True, True, False]


def test_size_by_the_name_of_the_sensor(tmp_path: Path) -> None:
    path = encoder.write(tmp_path / "a.hdf5", clustered(20), generation="4.2", format="ECF")
    assert read_recording(path).events.size == (1280, 720)
    path = encoder.write(tmp_path / "b.hdf5", clustered(20))
    assert refused(path).code == "EV015"


def test_damaged_blocks_are_told_with_their_event(tmp_path: Path) -> None:
    path = encoder.write(tmp_path / "a.hdf5", clustered(300), (0,), geometry="240x180")
    with h5py.File(path, "r+") as f:
        f["CD/events"].id.write_direct_chunk((128,), b"\xff" * 40)
    error = refused(path)
    assert error.code == "EV009"
    assert "at event 128: its block is damaged" in str(error)
    got = read_events(path, partial=True)
    first = clustered(300)
    equal(got, Events(first.x[:128], first.y[:128], first.t[:128], first.p[:128], first.size))


def test_truncated_blocks_never_pass() -> None:
    rows = list(zip(*(getattr(clustered(60), c).tolist() for c in "xytp"), strict=True))
    for form in (0, 1, 2):
        data = encoder.encode([(x, y, t, int(p)) for x, y, t, p in rows], form)
        for end in range(len(data)):
            with pytest.raises(ValueError, match=r"bytes|runs|events"):
                ecf.decode(data[:end])


def test_filters_and_fields_that_are_not_known(tmp_path: Path) -> None:
    """ECF on something else than events, and events without a time."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as f:
        group = f.create_group("events")
        for name in "ytp":
            group[name] = np.arange(5)
        made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        made.set_chunk((5,))
        made.set_filter(ecf.FILTER, h5py.h5z.FLAG_OPTIONAL)
        x = h5py.h5d.create(
            group.id, b"x", h5py.h5t.NATIVE_UINT16, h5py.h5s.create_simple((5,)), made)
        x.write_direct_chunk((0,), bytes(9))
    error = refused(path, size=(64, 48))
    assert (error.code, "filter 36559" in error.seen, "h5repack" in error.fix) == (
        "EV010", True, True)
    with h5py.File(path, "w") as f:
        f["CD/events"] = np.zeros(4, [("x", "u2"), ("y", "u2"), ("p", "i2")])
    error = refused(path, size=(64, 48))
    assert (error.code, "('x', 'y', 'p')" in error.seen) == ("EV008", True)

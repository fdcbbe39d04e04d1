"""HDF5 that is read as far as the file goes: what is lost is not taken for absent, and heaps that
have no end are not walked."""

from __future__ import annotations

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

from evflow.io.decode.hdf5_contained import File
from evflow.io.decode.hdf5_heaps import Heaps


def test_a_member_whose_header_is_lost_is_not_taken_for_absent(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as f:
        f["t_offset"] = np.int64(5)
        place = h5py.h5o.get_info(f["t_offset"].id).addr
    data = bytearray(path.read_bytes())
    data[place:place + 16] = bytes(16)
    path.write_bytes(data)
    with File(path) as f:
        for ask in (lambda: "t_offset" in f, lambda: f.get("t_offset"), lambda: f["t_offset"]):
            with pytest.raises(ValueError, match="cannot be opened"):
                ask()


def test_text_of_a_sound_heap_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as f:
        f.attrs["words"] = ["left", "right" * 2000]
        f["a/b"] = np.arange(3)
        f["a/b"].attrs["unit"], f["a"].attrs["n"] = "us", 3
        f["text"] = ["x", "yz"]
        f["within"] = np.frombuffer(b"zGCOL" + bytes(99), np.uint8)
    with File(path) as f:
        assert list(f.attrs["words"]) == ["left", "right" * 2000]
        assert f["a/b"].attrs["unit"] == "us"
        assert f["a"].attrs.get("n") == 3
        assert f["a"].attrs.get("m") is None
        assert bytes(f["within"][:5]) == b"zGCOL"
        with pytest.raises(ValueError, match="variable length"):
            f["text"][:]


def test_a_signature_at_the_edge_of_what_is_read_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "a"
    head = b"GCOL" + struct.pack("<IQ", 1, 48)
    good = head + struct.pack("<HHIQ", 0, 0, 0, 32) + bytes(16)
    bad = head + bytes(32)
    path.write_bytes(b"ab" + bad + good)
    for first in range(9):
        for count in range(1, 70):
            want = (b"ab" + bytes(4) + bad[4:] + good)[first : first + count]
            with Heaps(path) as file:
                file.seek(first)
                into = bytearray(count)
                assert file.readinto(into) == len(want)
                assert bytes(into[: len(want)]) == want

"""HDF5 that is read as far as the file goes: what is lost is not taken for absent."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from evflow.io.decode.hdf5_contained import File


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

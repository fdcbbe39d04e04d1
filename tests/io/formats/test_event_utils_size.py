"""The size of the sensor in files of event_utils' layout that no image shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evflow.io import read_recording


@pytest.mark.parametrize("stated", [{"width": 64, "height": 48}, {"resolution": (64, 48)}], ids=str)
def test_a_size_under_another_name_is_read(tmp_path: Path, stated: dict[str, Any]) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as f:
        for name, column in zip(("xs", "ys", "ts", "ps"), ([3, 9], [4, 8], [0.1, 0.2], [0, 1]),
                                strict=True):
            f[f"events/{name}"] = np.array(column)
        f.attrs.update(stated)
    assert read_recording(tmp_path / "a.h5").events.size == (64, 48)

"""Sensors that are higher than wide, in npz files that give two numbers for their size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evflow.io import read_recording


@pytest.mark.parametrize(("stated", "size"), [
    ({"resolution": (48, 64)}, (48, 64)), ({"resolution": (64, 48)}, (48, 64)),
    ({"width": 48, "height": 64}, (48, 64)), ({"size": (48, 64)}, (48, 64))], ids=str)
def test_upright_frames_tell_which_side_is_the_width(
    tmp_path: Path, stated: dict[str, Any], size: tuple[int, int]
) -> None:
    rng, n = np.random.default_rng(0), 2000
    np.savez(tmp_path / "a.npz", x=rng.integers(0, 48, n), y=rng.integers(0, 64, n),
             t=np.sort(rng.integers(0, 100_000, n)), p=rng.integers(0, 2, n),
             frames=rng.integers(0, 255, (3, 64, 48), np.uint8),
             frame_times=np.array([0, 50_000, 100_000]), **stated)
    found = read_recording(tmp_path / "a.npz")
    assert found.events.size == size
    assert found.has_frames

"""Reading any source of frames in tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.io.source import open_frames


def read(path: Path, **hints: Any) -> tuple[np.ndarray, list[int], list[str]]:
    """All frames, times and notes; the source keeps what it promises."""
    source = open_frames(path, **hints)
    pairs = list(source.open())
    assert all(f.shape[1::-1] == source.size for f, _ in pairs)
    if not hints.get("partial"):
        assert source.count == len(pairs)
    return np.stack([f for f, _ in pairs]), [t for _, t in pairs], source.notes


def message(call: Callable[[], Any]) -> str:
    with pytest.raises(EvflowDataError) as caught:
        call()
    return str(caught.value)

"""Data sets for tests: a tiny one, what is in a folder, and how two sequences compare."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from evflow.dataset import PRESETS, EventSequence, make_sequence
from evflow.dataset.manifest import Manifests
from evflow.errors import EvflowDataError

CONFIG = PRESETS["debug"]


@contextlib.contextmanager
def cached_compilation() -> Iterator[None]:
    """Processes find all that others compiled, where JAX_COMPILATION_CACHE_DIR is set."""
    option = "jax_persistent_cache_min_compile_time_secs"
    before = getattr(jax.config, option)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(option.upper(), "0")
        jax.config.update(option, 0)
        yield
    jax.config.update(option, before)


@functools.cache
def sequence(number: int = 0) -> EventSequence:
    return make_sequence(CONFIG, 0, number)


def contents(folder: Path) -> dict[str, str]:
    """The files of all sequences and their hashes."""
    files = [p for split in ("train", "test") for p in (folder / split).rglob("*") if p.is_file()]
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def assert_tidy(folder: Path) -> None:
    """Nothing hidden, nothing temporary; what is in place is sound."""
    assert [p for p in folder.rglob("*") if p.name.startswith(".") or p.suffix == ".tmp"] == []
    found = Manifests.read(folder)
    for split in ("train", "test"):
        for path in (folder / split).glob("*"):
            assert found.fault(f"{split}/{path.stem}", "dsec") is None


def assert_equal(a: EventSequence, b: EventSequence) -> None:
    for name in "xytp":
        np.testing.assert_array_equal(getattr(a.events, name), getattr(b.events, name))
    assert a.events.size == b.events.size
    arrays = [{"frames": s.frames, "times": s.frame_times, **s.truth} for s in (a, b)]
    assert arrays[0].keys() == arrays[1].keys()
    for name, array in arrays[0].items():
        assert array.dtype == arrays[1][name].dtype
        np.testing.assert_array_equal(array, arrays[1][name])
    assert a.nominal == b.nominal


def refused(code: str, *words: str) -> Any:
    return pytest.raises(EvflowDataError, match=".*".join([code, *words]))

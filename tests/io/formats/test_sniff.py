"""Every format is recognised, by its content alone where that can be."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.fuzz_samples import SAMPLES

from evflow.io.registry import FORMATS, find_format

NAMES = sorted((f.NAME for f in FORMATS), key=len, reverse=True)
KINDS = {kind: name for kind in SAMPLES if not kind.endswith("partial")
         for name in [next((n for n in NAMES if kind.startswith(n)), None)] if name}
BY_NAME = ("nmnist",)  # has neither header nor checksum


def told(path: Path) -> str:
    return find_format(path).NAME


def test_every_format_has_a_sample() -> None:
    optional = {"aedat4", "rosbag", "rosbag2"}  # packages
    assert set(NAMES) - optional <= set(KINDS.values())


@pytest.mark.parametrize(("kind", "name"), KINDS.items())
def test_formats_are_told_apart(tmp_path: Path, kind: str, name: str) -> None:
    path = SAMPLES[kind](tmp_path).path
    assert told(path) == name
    if path.is_file() and name not in BY_NAME:
        bare = path.rename(path.with_name("a"))
        assert told(bare) == name
        for suffix in (".h5", ".txt", ".raw", ".dat", ".npz", ".bin"):
            named = bare.rename(bare.with_suffix(suffix))
            claimed = told(named)
            named.rename(bare)
            assert claimed == name, suffix

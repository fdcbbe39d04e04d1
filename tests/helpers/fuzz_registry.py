"""Where hostile files are listed: `HOSTILE[name](folder)` writes one and says how it is read."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from helpers.fuzz_samples import Sample

HOSTILE: dict[str, Callable[[Path], Sample]] = {}


def hostile(maker: Callable[[Path], Sample]) -> Callable[[Path], Sample]:
    HOSTILE["hostile-" + maker.__name__.replace("_", "-")] = maker
    return maker


def each(**cases: Any) -> Callable[[Callable[[Path, Any], Sample]], None]:
    """One hostile file per case, made by maker(folder, case)."""

    def add(maker: Callable[[Path, Any], Sample]) -> None:
        for name, case in cases.items():
            HOSTILE[f"hostile-{maker.__name__}-{name}".replace("_", "-")] = partial(
                _with, maker, case)

    return add


def _with(maker: Callable[[Path, Any], Sample], case: Any, folder: Path) -> Sample:
    return maker(folder, case)

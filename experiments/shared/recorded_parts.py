"""The recordings that `evaluate_network` scores: those it is given, else those at hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from evflow.errors import EvflowDataError
from experiments.shared.recorded import (
    Part,
    Rotation,
    cut_of,
    read_part,
    read_rotation,
    sequence_name,
)
from experiments.shared.recordings import distinct, held_folder, held_recordings

ROTATIONS = ("ijrr_boxes_rotation", "ijrr_dynamic_rotation")


def parts(
    data: Sequence[Path], warmup_s: float, window_ms: float, *, whole: bool = False,
    size: tuple[int, int] | None = None,
) -> list[Part]:
    """The recordings under these paths, or `held_recordings` without any. One that cannot be read
    is reported and left out. Arguments as of `read_part`; whole: nothing is cut. Raises EV020
    where two have one name, and the last one's error where none can be read."""
    paths = list(data) or held_recordings()[::-1]
    cut = not whole and bool(data)  # the held ones are slices, shorter than their cuts
    distinct(paths, sequence_name)
    found: list[Part] = []
    for path in paths:
        start, stop = cut_of(path) if cut else (0.0, math.inf)
        if stop < math.inf:
            print(f"{path}: {start:g} to {stop:g} s count (--whole for all of it)")
        try:
            found.append(read_part(path, warmup_s, window_ms, cut, size))
        except EvflowDataError as error:
            if data and path == paths[-1] and not found:
                raise
            print(f"{path} left out: {error}")
    return found


def rotations() -> dict[str, Rotation]:
    """Those of ROTATIONS that lie in `held_folder`."""
    return {name: read_rotation(held_folder() / name) for name in ROTATIONS
            if (held_folder() / name / "extra.npz").is_file()}

"""Which values of a chunk of events can be any: those of damaged bytes often cannot."""

from __future__ import annotations

import numpy as np

from evflow.checks import COLUMNS, LATEST_US
from evflow.io.decode.chunk import Chunk
from evflow.io.decode.units import UNITS_US


def possible_times(t: np.ndarray, unit: str) -> np.ndarray:
    """(N,) bool: which of t, in `unit`, are finite, and no further from 0 than LATEST_US."""
    most = LATEST_US / UNITS_US[unit]
    if t.dtype.kind not in "fiu" or (len(t) and -most < t.min() and t.max() < most):
        return np.ones(len(t), bool)  # two passes, where comparing all takes eight times as long
    with np.errstate(invalid="ignore"):
        return np.asarray((t < most) & (t > -most))


def first_odd(chunk: Chunk, unit: str) -> tuple[int, str] | None:
    """The first event with an impossible value, and its column: times as above, p in {-1, 0, 1},
    whole coordinates; None if there is none. unit: of the times."""
    def fits(name: str) -> np.ndarray:
        column: np.ndarray = getattr(chunk, name)
        if name == "t":
            return possible_times(column, unit)
        with np.errstate(invalid="ignore"):
            whole = column % 1 == 0 if column.dtype.kind == "f" else np.ones(len(column), bool)
            return whole & ((column >= -1) & (column <= 1)) if name == "p" else whole

    found = [(int(np.argmin(right)), name) for name in COLUMNS if not (right := fits(name)).all()]
    return min(found, default=None)

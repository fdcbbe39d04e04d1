"""A block of decoded events, produced by decoders and consumed by all later stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np


class Chunk(NamedTuple):
    """Consecutive events, (n,) each: x, y whole numbers, t in the format's own unit, p bool,
    {0, 1} or {-1, 1}. Event i stands at `unit` number `where(i)` of the file."""

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray
    where: Callable[[int], int]
    unit: str = "byte"

    def area(self) -> float:
        """The pixels of the area that its events reach."""
        width, height = (max(float(np.nanmax(a, initial=0.0)), 0.0) + 1 for a in (self.x, self.y))
        return width * height

    def only(self, kept: np.ndarray) -> Chunk:
        """The events at these indices."""
        return Chunk(self.x[kept], self.y[kept], self.t[kept], self.p[kept],
                     lambda i: self.where(int(kept[i])), self.unit)


def joined(chunks: Sequence[Chunk]) -> Chunk:
    """Concatenate chunks (at least one)."""
    firsts = np.cumsum([0, *(len(chunk.t) for chunk in chunks)])[:-1]
    x, y, t, p = (np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in "xytp")

    def where(i: int) -> int:
        k = int(np.searchsorted(firsts, i, "right")) - 1
        return chunks[k].where(i - int(firsts[k]))

    return Chunk(x, y, t, p, where, chunks[0].unit)

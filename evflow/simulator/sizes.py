"""How many pixels a program steps at a time, and the memory that it takes.

The pixels that may fire in a block are padded to one of a few sizes, as XLA compiles a program for
each. A short video gains nothing by many: the first has room for twice as many pixels as fire in
the first block, a larger one comes when it is needed, and a smaller one once the padding without it
has taken a good part of the time to compile it. What the padding does is thrown away, so the events
are the same.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Hashable

import numpy as np

# A call hands work to another thread and back, which costs more than arrays that leave the cache.
ACTIVE: tuple[int, ...] = (4096, 8192, 12288, 16384, 20480)
PATIENCE = 1 << 19  # pixels of padding: some .1 s on one core, where a program takes .3 and more
ROOM = 2  # times the pixels for which a size is chosen


class Sizes:
    """The sizes that have a program. pixels: of the sensor."""

    def __init__(self, pixels: int) -> None:
        self.pixels, self.ready = pixels, list[int]()
        self.padding: Counter[int] = Counter()  # that each size would have saved

    def of(self, count: int) -> int:
        """The size for `count` pixels, up to the largest."""
        fits = next(size for size in ACTIVE if size >= count)
        if fits > max(self.ready, default=0):
            roomy = max(fits, min(ROOM * count, self.pixels))
            self.ready.append(next((size for size in ACTIVE if size >= roomy), ACTIVE[-1]))
        size = min(size for size in self.ready if size >= fits)
        self.padding[fits] += size - fits
        if size > fits and self.padding[fits] > PATIENCE:
            self.ready.append(fits)
            return fits
        return size


@functools.lru_cache(maxsize=256)
def sizes(pixels: int, *program: Hashable) -> Sizes:
    """Those of a program, as long as the process runs. program: what else it is compiled for."""
    return Sizes(pixels)


def aligned(shape: tuple[int, int], dtype: np.dtype) -> np.ndarray:
    """An empty array that a CPU device takes over without a copy: at a multiple of 64 bytes."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + 64, np.uint8)
    first = -memory.ctypes.data % 64
    return memory[first : first + size].view(dtype).reshape(shape)


def picked(pick: np.ufunc, frames: list[np.ndarray]) -> np.ndarray:
    """The greatest or least of all frames, in place: fresh memory is dear."""
    out = frames[0].copy()
    for frame in frames[1:]:
        pick(out, frame, out=out)
    return out

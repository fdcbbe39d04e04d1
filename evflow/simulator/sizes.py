"""Sizes of the arrays of pixels that are stepped at a time.

The pixels that may fire in a block are padded to one of a few sizes, as XLA compiles a program for
each. The first size has room for twice the pixels of the first block. A larger one is added when
needed, a smaller one once padding has cost about as much time as compiling it. Results of padding
are discarded, so the events do not depend on sizes.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Hashable

import numpy as np

# Not smaller: a call hands work to another thread and back, which costs more than cache misses.
ACTIVE: tuple[int, ...] = (4096, 8192, 12288, 16384, 20480)
PATIENCE = 1 << 19  # pixels of padding before a smaller size: some .1 s; compiling takes .3 s
ROOM = 2  # room of a new size, relative to the pixels that need it


class Sizes:
    """The sizes with a compiled program. pixels: of the sensor."""

    def __init__(self, pixels: int) -> None:
        self.pixels, self.ready = pixels, list[int]()
        self.padding: Counter[int] = Counter()  # pixels that each size would have saved

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
    """The sizes of a program, cached for the process. program: everything else it is compiled
    for."""
    return Sizes(pixels)


def aligned(shape: tuple[int, int], dtype: np.dtype) -> np.ndarray:
    """An empty array, aligned to 64 bytes, which a CPU device takes over without a copy."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + 64, np.uint8)
    first = -memory.ctypes.data % 64
    return memory[first : first + size].view(dtype).reshape(shape)


def picked(pick: np.ufunc, frames: list[np.ndarray]) -> np.ndarray:
    """The greatest or least value of each pixel over the frames, in reused memory, as new memory is
    slow."""
    out = frames[0].copy()
    for frame in frames[1:]:
        pick(out, frame, out=out)
    return out

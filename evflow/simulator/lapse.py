"""Event times of frames far apart: in double precision, on the host.

A crossing is a fraction of its interval. float32 resolves microseconds in tenths of a second, but
not in the minutes or hours between frames of a time lapse. For these the pixels' memory is also
tracked in float64 on the host; the number of events is still the device's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from evflow.camera import Camera
from evflow.light.log_maps import log64
from evflow.simulator import pack
from evflow.simulator.active import Block, Sent
from evflow.simulator.constants import Constants
from evflow.simulator.pack import Keys

Array = np.ndarray

FAR_US = 1 << 18  # length of an interval at which float32 log intensities resolve .5 us


class Lapse:
    """Event times of blocks with long intervals, for pixels whose memory changes at events only."""

    def __init__(self, model: Constants) -> None:
        self.model = model
        self.before: deque[Array] = deque()  # memory before each block in flight
        self.memory: Array | None = None  # log intensity (N,) float64

    def begin(self, block: Block, dt_us: Array, base: Any) -> None:
        """Record the memory before a block; base: (N,) float32, the device's memory."""
        if self._is_far(dt_us):
            first = block.first == 0  # the memory is the first frame
            self.before.append(log64(block.frames[0], self.model.log_map) if first else
                               np.array(base, np.float64))

    def signal(
        self, keys: Keys, camera: Camera, pieces: Sequence[tuple[Array, Array, Sent]], dt_us: Array
    ) -> Iterator[Array] | None:
        """Keys of the signal events of the next block; None if its intervals are short. camera:
        flat NumPy maps; pieces: pixels, their frames (T + 1, K) in DN, their output."""
        if not self._is_far(dt_us):
            self.memory = None
            return None
        before = self.before.popleft()
        self.memory = before if self.memory is None else self.memory
        return self._followed(self.memory, keys, camera, pieces, dt_us)

    def _is_far(self, dt_us: Array) -> bool:
        return (int(dt_us.max(initial=0)) > FAR_US and self.model.refractory_s is None
                and self.model.timestamps == "crossing")

    def _followed(
        self, memory: Array, keys: Keys, camera: Camera,
        pieces: Sequence[tuple[Array, Array, Sent]], dt_us: Array,
    ) -> Iterator[Array]:
        for pixels, frames, sent in pieces:
            seen = log64(frames[:, : len(pixels)], self.model.log_map)
            counts = np.asarray(sent.spikes.count)[:, : len(pixels)].astype(np.float64)
            struck = sent.struck if self.model.noise_resets_memory else None
            on, off = (np.asarray(theta)[pixels].astype(np.float64)
                       for theta in (camera.theta_on, camera.theta_off))
            for i in range(len(dt_us)):
                step = np.where(counts[i] > 0, on, -off)
                contrast = seen[i : i + 2] - memory[pixels]
                yield _crossings(keys, i, pixels, counts[i], step, contrast, dt_us)
                memory[pixels] += np.abs(counts[i]) * step
                if struck is not None:
                    reset = np.asarray(struck)[i, : len(pixels)]
                    memory[pixels] = np.where(reset, seen[i + 1], memory[pixels])


def _crossings(
    keys: Keys, i: int, pixels: Array, count: Array, step: Array, contrast: Array, dt_us: Array
) -> Array:
    """Keys of the events of interval i. count: (K,); step: (K,) thresholds, negative for OFF;
    contrast: (2, K) at its begin and end."""
    pack.need_few(count, 1)
    at = np.flatnonzero(count)
    row, k = pack.repeated(np.abs(count[at]))
    at = at[row]
    rise = np.diff(contrast, axis=0)[0, at]
    towards = np.where(rise * step[at] > 0, rise, np.inf)  # else it was beyond already
    fraction: Any = ((k + 1) * step[at] - contrast[0, at]) / towards
    return pack.from_fractions(keys, np.full(len(at), i), pixels[at], fraction, count[at] > 0,
                               dt_us, noise=False)

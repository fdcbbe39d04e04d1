"""The host's view of a sensor: frames go in block by block, events come out.

`Thresholds` (v2e, ESIM, the paper) and `Brownian` (DVS-Voltmeter) keep the pixels' state from
block to block. `advance` sends a block to the device and returns what will fetch its events, which
another thread may call while the next block is under way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.intensity import to_log
from evflow.sensors import SensorModel
from evflow.simulator import active, noise, pack, sensor, voltmeter
from evflow.simulator.active import Block, Sent
from evflow.simulator.pack import Columns
from evflow.simulator.sensor import Sensor, SimState

Array = jax.Array
Fetch = Callable[[], list[Columns]]

BLOCK = 8  # frames; more of them have more active pixels, fewer pass more often over all pixels
SALTED = 64 * BLOCK  # intervals whose salts are drawn at a time
ACTIVE = 8192  # active pixels that are stepped at a time; their arrays stay in the cache


class Circuit(Protocol):
    def advance(self, frames: list[np.ndarray], edges: np.ndarray) -> Fetch:
        """The next up to BLOCK flat frames. edges: their times and that of the frame before."""


def circuit(key: Array, frame: np.ndarray, start_us: int, camera: Camera, model: SensorModel
            ) -> Circuit:
    """The sensor at its first frame (H, W). camera: float32 maps (H, W)."""
    kind = Brownian if model.kind == "voltmeter" else Thresholds
    return kind(key, frame, start_us, camera, model)


@partial(jax.jit, static_argnames="model")
def _start(
    key: Array, frame: Array, camera: Camera, nominal: Array | None, *, model: SensorModel
) -> tuple[Sensor, SimState]:
    return sensor.start(key, to_log(frame, model.log_map), camera, model, nominal)


@jax.jit
def _salts(key: Array, first: int) -> Array:
    return noise.salts(key, first + jnp.arange(SALTED))


class _Blocks:
    """What both kinds share: noise rates, and blocks padded to BLOCK frames."""

    def __init__(
        self, key: Array, frame: np.ndarray, start_us: int, camera: Camera, model: SensorModel
    ) -> None:
        self.model, self.start_us, self.most_hz, nominal = model, start_us, 0.0, None
        if noise.is_noisy(model, camera):
            nominal = noise.nominal_thresholds(model, camera)
            self.most_hz = noise.most_rate(model, camera, nominal)
        self.whole, self.state = _start(key, frame, camera, nominal, model=model)
        self.words = np.asarray(self.whole.words)
        self.interval, self.salts = 0, np.empty((0, 2), np.uint32)

    def block(self, frames: list[np.ndarray], edges: np.ndarray) -> Block:
        """Raises EV014 where the noise is more than an interval can hold."""
        noise.check_rate(self.most_hz, float(np.diff(edges).max()) * 1e-6)
        missing = BLOCK - len(frames)
        frames = frames + [frames[-1]] * missing
        edges = np.append(edges, np.full(missing, edges[-1]))
        seconds = (edges - self.start_us) * 1e-6
        high = seconds.astype(np.float32)
        clock = np.stack([high, seconds - high], -1).astype(np.float32)
        dt = (np.diff(edges) * 1e-6).astype(np.float32)
        # Only the frames are always read; jit passes over what a model has no use for.
        return Block(jnp.asarray(np.stack(frames)), dt, clock, self._next_salts())

    def _next_salts(self) -> np.ndarray:
        if not len(self.salts):
            self.salts = np.asarray(_salts(self.state.key, self.interval))
            self.interval += SALTED
        first, self.salts = np.split(self.salts, [BLOCK])
        return first


class Thresholds(_Blocks):
    """Pixels that compare log intensity with thresholds; only those that may fire are stepped."""

    def advance(self, frames: list[np.ndarray], edges: np.ndarray) -> Fetch:
        block, sent, count = self.block(frames, edges), [], self.words.size
        pixels = self.state.pixels
        after, may_send = active.look(self.model, self.whole, pixels, block)
        if self.model.timestamps == "v2e":  # its slots depend on all pixels
            at, size = np.arange(count, dtype=np.int32), count
        else:
            at, size = np.flatnonzero(may_send).astype(np.int32), ACTIVE
        for first in range(0, len(at), size):
            some = at[first : first + size]
            padded = np.full(size, count, np.int32)
            padded[: len(some)] = some
            after, out = active.step(self.model, self.whole, pixels, after, block, padded)
            sent.append((some, out))
        self.state = SimState(after, self.state.interval, self.state.time, self.state.key)
        return partial(self._columns, sent, np.diff(edges))

    def _columns(self, sent: list[tuple[np.ndarray, Sent]], dt_us: np.ndarray) -> list[Columns]:
        def of(pixels: np.ndarray, out: Sent) -> Iterator[Columns]:
            yield from pack.signal_columns(self.model, out, pixels, dt_us)
            yield from pack.noise_columns(self.model, out.struck, pixels, self.words, dt_us)

        return [part for pixels, out in sent for part in of(pixels, out)]


class Brownian(_Blocks):
    """DVS-Voltmeter's pixels, and the camera's eta on top."""

    def __init__(
        self, key: Array, frame: np.ndarray, start_us: int, camera: Camera, model: SensorModel
    ) -> None:
        key, self.key = jax.random.split(key)
        super().__init__(key, frame, start_us, camera, model)
        self.camera, self.count = jax.tree.map(jnp.ravel, camera), 0
        self.voltage = voltmeter.start(frame.ravel())

    def advance(self, frames: list[np.ndarray], edges: np.ndarray) -> Fetch:
        block, dt_us, parts = self.block(frames, edges), np.diff(edges), []
        struck = active.strike(self.model, self.whole, block)
        for step, frame in enumerate(frames):
            self.voltage, pixel, fraction, on = voltmeter.fired(
                self.key, self.count, self.model.voltmeter, self.camera, self.voltage, frame,
                float(dt_us[step]))
            parts.append(Columns(np.full(len(pixel), step), pixel, fraction, on, noise=False))
            self.count += 1
        everywhere = np.arange(self.words.size)
        return lambda: parts + list(
            pack.noise_columns(self.model, struck, everywhere, self.words, dt_us))

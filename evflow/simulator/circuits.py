"""Pixel circuits on the host: frames in, block by block; events out.

`Still` and `Drifting` (v2e, ESIM, the paper) and `Brownian` (DVS-Voltmeter) keep the pixels' state
between blocks. `run` dispatches blocks and yields functions that fetch their events, while the next
block runs. Voxels are made from `steps`, which `Still` and `Drifting` have.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.light.log_maps import to_log
from evflow.simulator import active, noise, pack, sensor, voltmeter
from evflow.simulator.active import BLOCK, Block, Exit
from evflow.simulator.constants import Constants
from evflow.simulator.lapse import Lapse
from evflow.simulator.pack import Keys
from evflow.simulator.pixel import PixelState
from evflow.simulator.sensor import Sensor, SimState
from evflow.simulator.sizes import ACTIVE, aligned, picked, sizes

Array = jax.Array
Packed = tuple[Keys, list[np.ndarray]]  # unsorted events as integers, and their encoding
Fetch = Callable[[], Packed]
Piece = tuple[np.ndarray, np.ndarray, Any]  # pixels, the frames they see, their output
Stepped = tuple[list[Piece], Block, np.ndarray]  # a block, and the ticks of its intervals
Spiked = tuple[np.ndarray, np.ndarray, np.ndarray]  # pixel, fraction of the interval, whether ON

SALTED = 64 * BLOCK  # intervals whose salts are drawn at a time


class Circuit(Protocol):
    def run(self, video: Iterable[tuple[list[np.ndarray], np.ndarray]]) -> Iterator[Fetch]:
        """For each block, a function that fetches its events. video: up to BLOCK flat frames, and
        (T + 1,) times: theirs and the previous frame's."""


def circuit(
    key: Array, frame: np.ndarray, start_us: int, camera: Camera, model: Constants
) -> Circuit:
    """The sensor at its first frame (H, W). camera: float32 maps (H, W)."""
    if model.kind == "voltmeter":
        return Brownian(key, frame, start_us, camera, model)
    return thresholds(key, frame, start_us, camera, model, exit=active.sent)


def thresholds(
    key: Array, frame: np.ndarray, start: int, camera: Camera, model: Constants, *,
    exit: Exit, tick_s: float = 1e-6,
) -> Still | Drifting:
    """`circuit` for all kinds but DVS-Voltmeter, with any exit. tick_s: unit of frame times."""
    kind = Still if model.is_still else Drifting
    return kind(exit, key, frame, start, camera, model, tick_s)


@jax.jit
def _start(
    key: Array, frame: Array, camera: Camera, nominal: Array | None, model: Constants
) -> tuple[Sensor, SimState]:
    return sensor.start(key, to_log(frame, model.log_map), camera, model, nominal)


@jax.jit
def _salts(key: Array, first: int) -> Array:
    return noise.salts(key, first + jnp.arange(SALTED))


class _Blocks:
    """Common to all kinds: noise rates, and blocks padded to BLOCK frames."""

    def __init__(
        self, key: Array, frame: np.ndarray, start: int, camera: Camera, model: Constants,
        tick_s: float = 1e-6,
    ) -> None:
        self.model, self.begin, self.tick_s = model, start, tick_s
        self.most_hz, nominal = 0.0, None
        if noise.is_noisy(model, camera):
            nominal = noise.nominal_thresholds(model, camera)
            self.most_hz = noise.most_rate(model, camera, nominal)
        self.law = model.on_device()  # argument of compiled programs
        self.whole, state = _start(key, frame, camera, nominal, self.law)
        self.here = jax.tree.map(np.asarray, self.whole)  # copy on the host
        self.pixels, self.key = state.pixels, state.key
        self.interval, self.salts = 0, np.empty((0, 2), np.uint32)
        self.no_clock = np.zeros((BLOCK + 1, 2), np.float32)
        self.before = frame.ravel()

    def keys(self, ticks: np.ndarray) -> Keys:
        """Encoding of the events of these intervals as sortable integers."""
        return Keys.of(self.before.size, int(ticks.sum()))

    def block(self, frames: list[np.ndarray], edges: np.ndarray) -> Block:
        """The block of these frames. Raises EV014 where an interval has too much noise."""
        ticks = np.diff(edges)
        noise.check_rate(self.most_hz, float(ticks.max()) * self.tick_s)
        if missing := BLOCK - len(frames):
            frames = frames + [frames[-1]] * missing
            ticks = np.append(ticks, np.zeros(missing, np.int64))
        frames = [self.before, *frames]
        self.before = frames[-1]
        # jit drops inputs that a model does not use.
        block = Block(np.int32(self.interval), frames, (ticks * self.tick_s).astype(np.float32),
                      ticks.astype(np.uint32), self._clock(edges[0], ticks), self._next_salts(),
                      np.uint32(self.keys(ticks).bits_below))
        self.interval += BLOCK
        return block

    def _clock(self, begin: int, ticks: np.ndarray) -> np.ndarray:
        """(BLOCK + 1, 2) times for v2e's slots, see `SimState.time`."""
        if self.model.timestamps != "v2e":
            return self.no_clock
        seconds = (begin - self.begin + np.append(0, np.cumsum(ticks))) * self.tick_s
        high = seconds.astype(np.float32)
        return np.stack([high, seconds - high], -1).astype(np.float32)

    def _next_salts(self) -> np.ndarray:
        if not len(self.salts):
            self.salts = np.asarray(_salts(self.key, self.interval))
        first, self.salts = np.split(self.salts, [BLOCK])
        return first


class _Thresholds(_Blocks):
    """Pixels that compare log intensity with thresholds; only those that may fire are stepped."""

    def __init__(self, exit: Exit, *sensor: Any) -> None:
        super().__init__(*sensor)
        self.exit = exit
        self.sizes = sizes(self.before.size, jax.tree.structure(self.law), exit, self.before.dtype)

    def steps(self, video: Iterable[tuple[list[np.ndarray], np.ndarray]]) -> Iterator[Stepped]:
        """Steps of each block, dispatched; the device may still compute them."""
        raise NotImplementedError

    def run(self, video: Iterable[tuple[list[np.ndarray], np.ndarray]]) -> Iterator[Fetch]:
        return (partial(self._packed, *stepped) for stepped in self.steps(video))

    def pieces(
        self, at: np.ndarray, block: Block
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Block]]:
        """The pixels `at` in parts. Yields the pixels, the same padded with numbers beyond the last
        pixel, and the block with the frames of these pixels."""
        count, most = self.here.words.size, ACTIVE[-1]
        if slots := self.model.timestamps == "v2e":  # slots depend on all pixels
            at, most = np.arange(count), count
        for first in range(0, len(at), most):
            some = at[first : first + most]
            size = count if slots else self.sizes.of(len(some))
            padded = np.append(some, np.arange(count, count + size - len(some)))
            # NumPy gathers four times as fast as XLA; mode "clip" would take half as long again.
            seen = np.empty((BLOCK + 1, size), self.before.dtype)
            for frame, row in zip(block.frames, seen, strict=True):
                frame.take(padded, mode="wrap", out=row)
            yield some, padded.astype(np.int32), dataclasses.replace(block, frames=seen)

    def _packed(self, pieces: list[Piece], block: Block, dt_us: np.ndarray) -> Packed:
        keys = self.keys(dt_us)
        struck = [(pixels, frames, out.struck) for pixels, frames, out in pieces]
        return keys, [*self._signal(keys, pieces, dt_us),
                      *pack.noises(self.model, keys, self.here, struck, block, dt_us)]

    def _signal(
        self, keys: Keys, pieces: list[Piece], dt_us: np.ndarray
    ) -> Iterator[np.ndarray]:
        return pack.signal(self.model, keys, [(pixels, out) for pixels, _, out in pieces], dt_us)


class Drifting(_Thresholds):
    """Pixels whose memory changes without events: the device checks every pixel."""

    def __init__(self, *exit_and_sensor: Any) -> None:
        super().__init__(*exit_and_sensor)
        # Buffers are reused, as new memory is slow; two, as the device may still read one block
        # while the next is filled.
        shape = (BLOCK + 1, self.before.size)
        self.buffers = itertools.cycle([aligned(shape, self.before.dtype) for _ in range(2)])

    def steps(self, video: Iterable[tuple[list[np.ndarray], np.ndarray]]) -> Iterator[Stepped]:
        looked: tuple[Any, ...] = ()
        for frames, edges in video:
            block = self.block(frames, edges)
            block = dataclasses.replace(
                block, frames=np.stack(block.frames, out=next(self.buffers)))
            stepped = self._step(*looked) if looked else None
            # Queued on the device behind the previous step; does not block here.
            after, may_send = active.look(self.law, self.whole, self.pixels, block)
            looked = block, np.diff(edges), after, may_send
            if stepped:
                yield stepped
        yield self._step(*looked)

    def _step(
        self, block: Block, ticks: np.ndarray, after: PixelState, may_send: Array
    ) -> Stepped:
        pieces: list[Piece] = []
        for some, padded, seen in self.pieces(np.flatnonzero(may_send), block):
            after, sent = active.step(
                self.law, self.whole, self.pixels, after, seen, padded, exit=self.exit)
            pieces.append((some, seen.frames, sent))
        self.pixels = after
        return pieces, block, ticks


class Still(_Thresholds):
    """Pixels whose memory changes at events only: the host compares the brightest and the darkest
    value in a block with each pixel's limits, which is fast for bytes."""

    def __init__(self, *exit_and_sensor: Any) -> None:
        super().__init__(*exit_and_sensor)
        found = active.limits(
            self.law, self.whole.camera, self.pixels.base, self.before.dtype)
        self.bright, self.dark = np.array(found)
        self.seen = np.full(self.before.size, self.begin)  # time of each pixel's last step
        self.stepped: list[tuple[np.ndarray, Array]] = []  # pixels and their new limits
        self.lapse = Lapse(self.model)

    def steps(self, video: Iterable[tuple[list[np.ndarray], np.ndarray]]) -> Iterator[Stepped]:
        for frames, edges in video:
            block = self.block(frames, edges)
            struck = None
            if self.whole.rates is not None:
                struck = active.look_for_noise(self.whole, block)
            brightest, darkest = (picked(pick, frames) for pick in (np.maximum, np.minimum))
            for pixels, limits in self.stepped:  # waits for the block before
                self.bright[pixels], self.dark[pixels] = np.asarray(limits)[:, : len(pixels)]
            may_send = (brightest > self.bright) | (darkest < self.dark)
            if struck is not None:
                may_send |= np.asarray(struck)
            yield self._step(block, edges, np.flatnonzero(may_send))

    def _step(self, block: Block, edges: np.ndarray, at: np.ndarray) -> Stepped:
        pieces: list[Piece] = []
        self.stepped = []
        self.lapse.begin(block, np.diff(edges), self.pixels.base)
        for some, padded, seen in self.pieces(at, block):
            rested = self._rested(some, padded, edges) if self.model.is_dead_between else None
            self.pixels, sent, limits = active.step_still(
                self.law, self.whole, self.pixels, seen, padded, rested, exit=self.exit)
            self.stepped.append((some, limits))
            pieces.append((some, seen.frames, sent))
        return pieces, block, np.diff(edges)

    def _signal(self, keys: Keys, pieces: list[Piece], dt_us: np.ndarray) -> Iterator[np.ndarray]:
        exact = self.lapse.signal(keys, self.here.camera, pieces, dt_us)
        return super()._signal(keys, pieces, dt_us) if exact is None else exact

    def _rested(self, some: np.ndarray, padded: np.ndarray, edges: np.ndarray) -> np.ndarray:
        """Seconds since these pixels were last stepped; records this block as their last."""
        since = edges[0] - self.seen.take(padded, mode="clip")
        self.seen[some] = edges[-1]
        return (since * self.tick_s).astype(np.float32)


class Brownian(_Blocks):
    """DVS-Voltmeter's pixels, and the camera's eta on top."""

    def __init__(
        self, key: Array, frame: np.ndarray, start_us: int, camera: Camera, model: Constants
    ) -> None:
        key, self.signal = jax.random.split(key)
        super().__init__(key, frame, start_us, camera, model)
        self.camera, self.count = jax.tree.map(jnp.ravel, camera), 0
        self.voltage = voltmeter.start(frame.ravel())

    def run(self, video: Iterable[tuple[list[np.ndarray], np.ndarray]]) -> Iterator[Fetch]:
        for frames, edges in video:
            dt_us = np.diff(edges)
            block = self.block(frames, edges)
            block = dataclasses.replace(block, frames=np.stack(block.frames))
            struck = active.strike(self.law, self.whole, block)
            signal = [self._interval(*each) for each in zip(frames, dt_us.tolist(), strict=True)]
            yield partial(self._packed, signal, struck, block, dt_us)

    def _interval(self, frame: np.ndarray, dt_us: float) -> Spiked:
        self.voltage, pixel, fraction, on = voltmeter.fired(
            self.signal, self.count, self.law.voltmeter, self.camera, self.voltage, frame, dt_us)
        self.count += 1
        return pixel, fraction, on

    def _packed(
        self, signal: list[Spiked], struck: Array | None, block: Block, dt_us: np.ndarray
    ) -> Packed:
        keys = self.keys(dt_us)
        step = np.repeat(np.arange(len(signal)), [len(pixel) for pixel, _, _ in signal])
        pixel, fraction, on = (np.concatenate(c) for c in zip(*signal, strict=True))
        everywhere = np.arange(self.here.words.size)
        struck_everywhere = [(everywhere, block.frames, struck)]
        return keys, [
            pack.from_fractions(keys, step, pixel, fraction, on, dt_us, noise=False),
            *pack.noises(self.model, keys, self.here, struck_everywhere, block, dt_us)]

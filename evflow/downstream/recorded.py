"""Training sequences from real recordings instead of simulation.

There is no true flow (EV-FlowNet learns from the frames at the ends of its windows, see
`losses.photometric`) and so no temporal consistency.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.downstream.simulated import SequenceConfig, Sequences, draw_noise
from evflow.downstream.tensor import event_tensor
from evflow.errors import EvflowDataError
from evflow.recordings import plan_windows
from evflow.types import Recording

Array = jax.Array

MOST_BYTES = 1 << 30  # of event tensors in memory: some 1200 windows of 240x180 pixels


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RecordedBank:
    """N runs of T windows from frame to frame. tensors (N, T, H, W, bins): signed events; borders
    (N, T + 1, H, W): frames at the windows' borders, on [0, 1]."""

    tensors: Array
    borders: Array


def recorded_bank(
    recordings: Sequence[Recording], config: SequenceConfig, most_bytes: int = MOST_BYTES
) -> RecordedBank:
    """Runs of config.windows neighbouring frame intervals without gap or glitch, evenly thinned to
    most_bytes.

    Raises EV015 for recordings of several sizes or smaller than the crop, EV017 where no run is
    long enough, and as `plan_windows`.
    """
    sizes = {r.events.size for r in recordings}
    if len(sizes) != 1 or min(min(s) for s in sizes) < config.crop:
        raise EvflowDataError("EV015", f"recordings of {sorted(sizes)} pixels, crops of "
                              f"{config.crop}.", "Take those of one sensor, larger than a crop.")
    found = [(recording, i) for recording in recordings for i in _runs(recording, config.windows)]
    if not found:
        raise EvflowDataError("EV017", f"no {config.windows} neighbouring windows without a gap.",
                              "Take fewer windows, or longer recordings.")
    (width, height), = sizes
    fit = max(1, most_bytes // (4 * config.windows * width * height * (config.bins + 1)))
    chosen = np.linspace(0, len(found) - 1, min(fit, len(found))).round().astype(int)
    parts = [_run(recording, first, config) for recording, first in (found[i] for i in chosen)]
    tensors, borders = (jnp.asarray(np.stack(column)) for column in zip(*parts, strict=True))
    return RecordedBank(tensors, borders)


def _runs(recording: Recording, windows: int) -> list[int]:
    """First intervals of runs that do not overlap."""
    usable = [i for first, last in plan_windows(recording, 1).pairs for i in range(first, last)]
    starts: list[int] = []
    run = 0
    for before, i in zip([-2, *usable], usable, strict=False):
        run = run + 1 if i == before + 1 else 1
        if run == windows:
            starts.append(i - windows + 1)
            run = 0
    return starts


def _run(
    recording: Recording, first: int, config: SequenceConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Tensors (T, H, W, bins) and frames (T + 1, H, W) of the intervals from `first` on."""
    edges = recording.frame_times[first:first + config.windows + 1]
    tensors = [event_tensor(recording.events.slice(int(a), int(b)), config.bins)
               for a, b in itertools.pairwise(edges)]
    frames = [recording.frame_dn(first + i) / np.float32(255) for i in range(len(edges))]
    return np.stack(tensors), np.stack(frames)


def sample_recorded(
    key: Array, bank: RecordedBank, config: SequenceConfig, _camera: Camera | None = None
) -> Sequences:
    """A batch in place of `sample_sequences`: random crops of random runs, with the same noise on
    the tensors. The camera is ignored; flow is 0 and no pixel counts as visible.
    """
    keys = jax.random.split(key, config.sequences)

    def one(key: Array) -> tuple[Array, Array, Array]:
        k_run, k_row, k_column, k_noise = jax.random.split(key, 4)
        runs, _, rows, columns = bank.borders.shape
        at = (jax.random.randint(k_run, (), 0, runs), 0,
              jax.random.randint(k_row, (), 0, rows - config.crop + 1),
              jax.random.randint(k_column, (), 0, columns - config.crop + 1))
        size = (config.crop, config.crop)
        borders = jax.lax.dynamic_slice(bank.borders, at, (1, config.windows + 1, *size))[0]
        tensors = jax.lax.dynamic_slice(
            bank.tensors, (*at, 0), (1, config.windows, *size, config.bins))[0]
        return tensors, draw_noise(k_noise, config), borders

    tensors, noise, borders = (jnp.swapaxes(a, 0, 1) for a in jax.vmap(one)(keys))
    unseen = jnp.zeros_like(borders[1:])
    still = jnp.stack([unseen, unseen], 2)
    return Sequences(tensors, noise, borders, still, still, unseen)

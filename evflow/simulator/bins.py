"""Weights of one interval's events on the voxel bins (Eq. 2), without making the events.

Within an interval a pixel's events sit on an arithmetic progression, so the sum of their
triangular weights has a closed form (`hat_sums`). An interval touches few bins, mostly two; only
those are computed.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.simulator.spikes import Spikes

Array = jax.Array


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Which bins the intervals of a window touch, arrays (T,). low: the first bin; offset:
    where the interval begins, in bins from `low`; wide: whether it touches more than two bins.
    length: of an interval, in bins. width: bins that an interval touches at most."""

    low: Any
    offset: Any
    wide: Any
    length: float
    width: int

    @staticmethod
    def of(steps: int, bins: int) -> Schedule:
        length = (bins - 1) / steps
        edges = np.arange(steps) * length
        low = np.minimum(np.floor(edges + 1e-6), bins - 2)
        last = np.ceil(edges + length - 1e-6)
        width = min(bins, int(np.max(last - low)) + 1)
        low = np.minimum(low, bins - width)
        return Schedule(low.astype(np.int32), (edges - low).astype(np.float32), last - low > 1,
                        length, width)


def hat_sums(width: int, first: Array, spacing: Array, count: Array) -> list[Array]:
    """Weights on bins 0, 1, ... (`width` of them) of a progression of events.

    first, spacing are in bins; every event must lie in [0, width - 1]. Within a gap between two
    bins the weights are linear, so the number of events in it and the sum of their positions
    suffice: one division, whatever the count.
    """
    inverse = 1.0 / jnp.maximum(spacing, 1e-12)
    weights = [jnp.zeros_like(count) for _ in range(width)]
    done, total = jnp.zeros_like(count), jnp.zeros_like(count)
    for gap in range(width - 1):
        if gap == width - 2:
            upto = count
        else:
            upto = jnp.clip(jnp.floor((gap + 1.0 - first) * inverse) + 1.0, 0.0, count)
        position = upto * (first + spacing * (0.5 * (upto - 1.0)))  # sum of the first `upto`
        number, moment = upto - done, position - total
        weights[gap] += (gap + 1.0) * number - moment
        weights[gap + 1] += moment - gap * number
        done, total = upto, position
    return weights


def signal_bins(
    width: int, spikes: Spikes, offset: Array, length: float, dead: Array | None
) -> list[Array]:
    """Weights (N,) of one interval's signal events on the `width` bins it touches, negative for
    OFF: an interval has one polarity per pixel.

    The interval spans [offset, offset + length] of these bins. dead: the refractory period in
    interval lengths, None where pixels never wait.
    """
    count, spacing = jnp.abs(spikes.count), spikes.spacing * length
    if dead is None:
        weights = hat_sums(width, offset + spikes.first * length, spacing, count)
    else:
        # The waiting events come first, `dead` apart, then those that cross in their own time;
        # where crossings are no further apart than `dead`, every event waits for the one before.
        assert spikes.earliest is not None
        gain = spikes.spacing - dead
        lag = jnp.maximum(spikes.earliest - spikes.first, 0.0)
        waiting = jnp.where(gain > 0, jnp.ceil(lag / jnp.maximum(gain, 1e-9)), count)
        waiting = jnp.minimum(waiting, count)
        at = spikes.first + waiting * spikes.spacing
        late = hat_sums(width, offset + spikes.earliest * length,
                        jnp.zeros_like(count) + dead * length, waiting)
        timely = hat_sums(width, offset + at * length, spacing, count - waiting)
        weights = [a + b for a, b in zip(late, timely, strict=True)]
    sign = jnp.sign(spikes.count)
    return [w * sign for w in weights]


def noise_bins(width: int, at: Array, sign: Array, offset: Array, length: float) -> list[Array]:
    """Weights (N,) of one noise event per pixel, of polarity `sign` (0: none), at the fraction
    `at` of the interval."""
    position = offset + at * length
    return [sign * jnp.maximum(0.0, 1.0 - jnp.abs(position - j)) for j in range(width)]


def by_polarity(weights: list[Array]) -> tuple[list[Array], list[Array]]:
    """(ON, OFF) of weights that are negative for OFF."""
    return [jnp.maximum(w, 0.0) for w in weights], [jnp.maximum(-w, 0.0) for w in weights]


def add(grid: Array, low: Array, on: list[Array], off: list[Array]) -> Array:
    """Add weights (N,) to bins low, low + 1, ... of grid (2 * bins, N): [ON bins, OFF bins]."""
    bins = grid.shape[0] // 2
    for first, weights in ((low, on), (low + bins, off)):
        for j, weight in enumerate(weights):
            old = jax.lax.dynamic_index_in_dim(grid, first + j, 0)
            grid = jax.lax.dynamic_update_index_in_dim(grid, old + weight[None], first + j, 0)
    return grid

"""The camera's summary: additive statistics of all pixels, and the estimate from their sums."""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
from jax.typing import ArrayLike

from evflow.camera import Summary
from evflow.checks import need
from evflow.errors import EvflowDataError
from evflow.network import pooling
from evflow.network.architecture import Params
from evflow.network.bijection import DEFAULT_WINDOW_S, parts
from evflow.network.config import ModelConfig
from evflow.network.coordinates import squashed_summary
from evflow.network.inputs import prepare
from evflow.network.pooling import Stats
from evflow.process.chunks import LARGE, on_cpu

Array = jax.Array


def summarize(
    params: Params, voxels: ArrayLike, dlogI: ArrayLike, *, window_s: ArrayLike = DEFAULT_WINDOW_S,
    intensity: ArrayLike | None = None,
) -> Stats:
    """Additive statistics of all pixels: the pooled evidence for the camera's summary.

    Statistics of windows and tiles of one camera are added: `sum(summarize(...) for ...)`.

    Args:
        params: of `load_weights`.
        voxels: (..., H, W, 32), events per pixel and bin, of `voxelize`.
        dlogI: (..., H, W), natural-log units, of `delta_log_intensity`.
        window_s: length of the window in seconds, a number or (...,).
        intensity: mean log intensity (lin-log of DN), (..., H, W) or (...,), NaN where unknown;
            None: unknown everywhere.

    Returns:
        Statistics (...,), pooled over (H, W) only.

    Raises:
        EvflowDataError: EV001 (no pixel), EV002 (shape), EV003 (values that cannot be counts or
            logarithms), EV007 (NaN), EV018 (weights of the paper's network, which does not pool, or
            not weights), EV020 (window_s).

    Example:
        >>> stats = sum(ef.summarize(params, v, d) for v, d in windows)
        >>> summary, std = ef.finish(params, stats)
    """
    config, net = pooling_parts(params)
    inputs = prepare(config, voxels, dlogI, window_s, intensity)
    at_a_time = LARGE if on_cpu(inputs) else None  # activations of all would be new memory
    return _pool(net["summary"], *inputs, config=config, at_a_time=at_a_time)


def pooling_parts(params: Params) -> tuple[ModelConfig, Params]:
    """`parts` of a network that has a summary; EV018 for others."""
    config, net = parts(params)
    if not config.pool or "summary" not in net:
        raise EvflowDataError(
            "EV018", "these weights estimate every pixel separately and have no summary.",
            'Use load_weights("default").')
    return config, net


@partial(jax.jit, static_argnames=("config", "at_a_time"))
def _pool(
    net: Params, voxels: Array, dlogI: Array, window_s: Array, intensity: Array | None, *,
    config: ModelConfig, at_a_time: int | None,
) -> Stats:
    return pooling.pool(config, net, voxels, dlogI, window_s, intensity, at_a_time=at_a_time)


def finish(params: Params, stats: Stats | Literal[0]) -> tuple[Summary, Summary]:
    """The camera's summary from pooled statistics.

    Args:
        params: of `load_weights`.
        stats: of `summarize`, one or a sum (its type includes the 0 that `sum` begins with).

    Returns:
        The summary and its standard deviation, (...,) each, in natural units (natural log, Hz);
        the std shrinks with the amount of data.

    Raises:
        EvflowDataError: EV018 (weights of the paper's network, which has no summary, or not
            weights), EV020 (not statistics, or a sum of none).
    """
    config, net = pooling_parts(params)
    if isinstance(stats, int) and stats == 0:
        raise EvflowDataError("EV020", "stats is 0, the sum of no statistics.",
                              "Were there no windows? Pass those of one at least.")
    need(stats, Stats, "stats", "Pass the result of summarize, or a sum of results.")
    return squashed_summary(*pooled_y(net["summary"], stats, config=config))


@partial(jax.jit, static_argnames="config")
def pooled_y(net: Params, stats: Stats, *, config: ModelConfig) -> tuple[Array, Array]:
    """y (..., 6) of the summary, and its std in y."""
    return pooling.finish(config, net, stats)

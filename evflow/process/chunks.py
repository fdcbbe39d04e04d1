"""Pixels are independent: process them in chunks, and a share of them on every core of a CPU.

XLA splits each operation among its threads, which does not pay below some 5,000 pixels, while
activations stay in a core's cache only up to some 1,000. So unless the caller is tracing, `at_once`
runs one execution per core, each on its share and in small chunks. `estimate` of a 346x260 frame,
given the summary, on two cores: .71 s this way; a single execution takes 1.50, 1.33, 1.29, 1.33,
1.55, 6.1 s in chunks of 2560, 4096, 6144, 11264, 16384 and 46000 (and the flow .96, .85, .69, .72,
.76, .78 s).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

Array = jax.Array

# Pixels. SMALL is for one core: 512, 640, 960, 1280 take .71, .70, .69, .73 s; activations take
# 1.6 MB at 640. HUGE is for accelerators, where activations stay below 1 GB.
SMALL, LARGE, HUGE = 640, 6144, 2**18


def in_chunks(f: Callable[..., Any], rows: Any, size: int) -> Any:
    """f of a tree of arrays (n, ...), at most `size` rows at a time (a multiple of 16); results are
    (n, ...)."""
    n = len(jax.tree.leaves(rows)[0])
    if n <= size:
        return f(rows)
    # Equal chunks of whole vectors of 16 floats; the last one is padded with zeros.
    even = 16 * math.ceil(n / (16 * math.ceil(n / size)))

    def cut(a: Array) -> Array:
        padded = jnp.pad(a, ((0, -n % even), *((0, 0),) * (a.ndim - 1)))
        return padded.reshape(-1, even, *a.shape[1:])

    out = jax.lax.map(f, jax.tree.map(cut, rows))
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:n], out)


def by_platform(f: Callable[..., Any], rows: Any, *, alone: bool) -> Any:
    """`in_chunks` with the size that suits the platform. alone: this call may use all cores."""
    size = LARGE if alone and cores_per_device() > 1 else SMALL
    return jax.lax.platform_dependent(
        rows, cpu=partial(in_chunks, f, size=size), default=partial(in_chunks, f, size=HUGE))


def cores_per_device() -> int:
    """Cores that this process may use per JAX device."""
    usable = getattr(os, "sched_getaffinity", None)  # Linux
    cores = len(usable(0)) if usable else os.cpu_count() or 1
    return max(1, cores // jax.local_device_count())


def executions(pixels: int, arrays: Any) -> int:
    """How many executions on a tree of arrays to run at once: one per core if JAX's first device is
    a CPU that holds them and each has a full chunk; 1 while tracing and on accelerators."""
    return max(1, min(cores_per_device(), pixels // SMALL)) if on_cpu(arrays) else 1


def on_cpu(arrays: Any) -> bool:
    """Whether JAX's first device is a CPU and holds a tree of arrays; False while tracing."""
    leaves, here = jax.tree.leaves(arrays), jax.local_devices()[0]
    if any(isinstance(a, jax.core.Tracer) for a in leaves):
        return False
    return here.platform == "cpu" and all(
        a.devices() == {here} for a in leaves if isinstance(a, Array))


def at_once(calls: Sequence[Callable[[], Any]]) -> list[Any]:
    """Results of jitted calls that run side by side.

    XLA keeps the order of calls from one thread, so every call but the first gets its own thread.
    The first runs under the caller's settings and compiles; the others find its program.
    """
    first = calls[0]()
    if len(calls) == 1:
        return [first]
    x64 = jnp.result_type(float) == jnp.float64  # of this thread

    def run(call: Callable[[], Any]) -> Any:
        with jax.enable_x64(x64):
            return jax.block_until_ready(call())  # else the thread would take a second call

    with ThreadPoolExecutor(len(calls) - 1) as pool:
        return [first, *pool.map(run, calls[1:])]


def joined(shares: Sequence[Array], pixels: int) -> Array:
    """(images, pixels, C) from equal shares (images, n, C) in order; the last one may overlap."""
    if len(shares) == 1:
        return shares[0]
    extra = sum(share.shape[1] for share in shares) - pixels
    return jnp.concatenate([*shares[:-1], shares[-1][:, extra:]], 1)

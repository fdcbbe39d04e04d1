"""What this machine can do at most: single-precision products (sgemm) and copying memory.

Every run measures both, so that shares hold at the machine's present load. The larger of the
libraries' figures is the limit.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Case, Setting, Workload, cores


def _size(setting: Setting) -> int:
    return 256 if setting.quick else 2048


def sgemm_jax(setting: Setting) -> Workload:
    n = _size(setting)
    a, b = jax.random.normal(jax.random.key(0), (2, n, n), jnp.float32)
    product = jax.jit(partial(jnp.matmul, precision="highest"))
    return Workload(lambda: product(a, b), lambda _: {"GFLOP": 2e-9 * n**3}, f"{n}^3")


def sgemm_torch(setting: Setting) -> Workload:
    import torch

    n = _size(setting)
    a, b = torch.randn(2, n, n)
    return Workload(lambda: a @ b, lambda _: {"GFLOP": 2e-9 * n**3},
                    f"{n}^3, {torch.get_num_threads()} threads")


def copy(setting: Setting, threads: int) -> Workload:
    """np.copyto between arrays beyond any cache, a part per thread; read and write both count."""
    source = np.ones((1 << 18) if setting.quick else (1 << 28), np.uint8)
    target = np.zeros_like(source)
    parts = list(zip(np.array_split(target, threads), np.array_split(source, threads), strict=True))
    pool = ThreadPoolExecutor(threads)
    return Workload(lambda: list(pool.map(lambda part: np.copyto(*part), parts)),
                    lambda _: {"GB": 2e-9 * source.nbytes}, f"{source.nbytes >> 20} MiB")


CASES = (
    Case("limits", "sgemm", "jax", sgemm_jax),
    Case("limits", "sgemm", "torch", sgemm_torch, needs="torch"),
    Case("limits", "copy", f"numpy, {cores()} threads", partial(copy, threads=cores())),
    Case("limits", "copy", "numpy, 1 thread", partial(copy, threads=1)),
)

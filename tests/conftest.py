"""Shared fixtures. Strict rank promotion is set through the environment, before JAX is imported,
so that tests of the NumPy-only rooms never load it and subprocesses inherit it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.compilation import compile_quickly, optimise_often_run, remember

os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
compile_quickly(os.environ)
remember(os.environ)
# Python's default, a garbage collection per 700 new objects, takes 4 % of the time: JAX traces make
# many objects, hardly any of them garbage.
gc.set_threshold(20_000, 20, 20)
# Arrays of megabytes come and go. By default each is a mapping of its own, which the system fills
# with zeros: that takes longer than many programs run. So freed memory is kept.
LIBC: Any = None
with contextlib.suppress(AttributeError, OSError, TypeError):  # libraries other than glibc
    LIBC = ctypes.CDLL(None)
    for setting, megabytes in ((-3, 64), (-1, 256)):  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD
        LIBC.mallopt(setting, megabytes << 20)
# Memory of a worker above which its compiled programs are dropped: a fifth of the machine's.
MOST_MB = max(2500, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 5_000_000)


# Jobs that a shell starts in the background ignore Ctrl-C, and so would all their children.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """One worker runs all tests of a file, as they share fixtures and compiled programs."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


def pytest_collection_finish() -> None:
    if "jax" in sys.modules:
        optimise_often_run()


@pytest.fixture(scope="module", autouse=True)
def _bounded_memory() -> Iterator[None]:
    """Drop compiled programs above MOST_MB: thousands of them take gigabytes per process."""
    yield
    status = Path("/proc/self/status")
    resident = status.read_text().split("VmRSS:")[1].split()[0] if status.exists() else 0
    if "jax" in sys.modules and int(resident) > MOST_MB * 1024:
        sys.modules["jax"].clear_caches()
        gc.collect()
        with contextlib.suppress(AttributeError):
            LIBC.malloc_trim(0)


@pytest.fixture(scope="module")
def optimised() -> Iterator[None]:
    """For tests that run longer than they compile, or that depend on the last bit."""
    import jax

    before = jax.config.read("jax_disable_most_optimizations")
    jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
    jax.clear_caches()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder EVFLOW_DATA, which holds data/ (recordings, formats, images) and goldens/."""
    folder = os.environ.get("EVFLOW_DATA")
    if not folder:
        pytest.skip("EVFLOW_DATA is not set: no real recordings at hand")
    if not Path(folder).is_dir():
        pytest.skip(f"EVFLOW_DATA={folder} is not a folder")
    return Path(folder)


@pytest.fixture(scope="session")
def data_file(data_dir: Path) -> Callable[[str], Path]:
    """data_file("data/recordings/NAME") is its path, or the test is skipped."""

    def find(relative: str) -> Path:
        path = data_dir / relative
        if not path.exists():
            pytest.skip(f"{path} is absent")
        return path

    return find

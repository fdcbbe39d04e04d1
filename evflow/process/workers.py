"""Worker processes that end with their block, or when their parent is killed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any


@contextlib.contextmanager
def worker_pool(
    workers: int, prepare: Callable[..., Any] | None = None, *arguments: Any
) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh interpreters, because JAX's threads do not survive a fork. Each first calls
    prepare(*arguments). Ctrl-C is left to the parent."""
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_begin,
                               initargs=(prepare, *arguments))
    try:
        yield pool
    finally:
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()  # unfinished results are not needed
        pool.shutdown(cancel_futures=True)


def _begin(prepare: Callable[..., Any] | None, *arguments: Any) -> None:
    """The first call in a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent.join,), daemon=True).start()
    if prepare is not None:
        prepare(*arguments)


def _end_after(wait: Callable[[], None]) -> None:
    wait()
    os._exit(1)

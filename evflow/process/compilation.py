"""Compiled programs: cached between runs of a command, and reported while they are compiled.

The library itself changes no setting: a cache belongs to the process, and a command is one.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"  # the last event before compilation
COMPILED = "/jax/core/compile/backend_compile_duration"
JAX_OWN = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")


def cache_folder(environ: Mapping[str, str], system: str = sys.platform) -> Path | None:
    """evflow's folder in this system's cache directory; None without a home."""
    named = environ.get("LOCALAPPDATA" if system == "win32" else "XDG_CACHE_HOME", "")
    try:
        home = Path.home()
    except RuntimeError:
        return Path(named, "evflow") if Path(named).is_absolute() else None
    usual = {"win32": "AppData/Local", "darwin": "Library/Caches"}.get(system, ".cache")
    # The XDG specification says that a relative XDG_CACHE_HOME is to be ignored.
    return (Path(named) if Path(named).is_absolute() else home / usual) / "evflow"


def remember(environ: Mapping[str, str] = os.environ) -> Path | None:
    """Cache what this process compiles in the user's cache folder for later runs; returns the
    folder.

    Returns None and changes nothing if JAX's own environment variables configure the cache, or if
    the folder cannot be written."""
    if any(name in environ for name in JAX_OWN):
        return None
    folder = cache_folder(environ)
    try:
        if folder is None:
            return None
        folder = folder / "programs"
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        return None
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    for name, least in (("min_compile_time_secs", 0), ("min_entry_size_bytes", -1)):
        if f"JAX_PERSISTENT_CACHE_{name.upper()}" not in environ:
            jax.config.update(f"jax_persistent_cache_{name}", least)
    return folder


@contextlib.contextmanager
def announced(announce: Callable[[bool], None]) -> Iterator[None]:
    """Call announce(True) whenever a program is about to be compiled or looked up in this block,
    and announce(False) when it is ready."""
    import jax

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event in (LOWERED, COMPILED):
            announce(event == LOWERED)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)

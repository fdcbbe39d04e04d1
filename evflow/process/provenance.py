"""Where a result comes from: versions, machine, and hashes of files."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
from pathlib import Path

PACKAGES = ("jax", "jaxlib", "flax", "numpy", "opencv-python-headless", "matplotlib")


def versions() -> dict[str, str]:
    """Of evflow, of what it runs on, and of the machine."""
    import jax

    import evflow

    found = {"evflow": evflow.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {**found, "device": jax.devices()[0].device_kind, "platform": platform.platform()}


def sha256(path: str | os.PathLike) -> str:
    """Of a file; of a folder, that of its files' names and hashes in order."""
    path = Path(path)
    if not path.is_dir():
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    whole = hashlib.sha256()
    for part in sorted(p for p in path.rglob("*") if p.is_file()):
        whole.update(f"{part.relative_to(path).as_posix()}\0{sha256(part)}\n".encode())
    return whole.hexdigest()


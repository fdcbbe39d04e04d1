"""What every experiment shares: provenance of a result, where results go, names of files."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
from pathlib import Path
from typing import Any

import jax

from evflow.files import atomic_write

PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy")


def provenance() -> dict[str, Any]:
    """Versions and machine, saved with every result."""
    import evflow

    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    machine = {"platform": platform.platform(), "cpus": os.cpu_count(),
               "device": jax.devices()[0].device_kind}
    return {"evflow": evflow.__version__, "versions": versions, "machine": machine}


def write_result(path: Path, result: dict[str, Any], config: dict[str, Any]) -> None:
    """Save a result with its configuration and provenance as JSON."""
    with atomic_write(path, overwrite=True) as temporary:
        record = {"result": result, "config": config, **provenance()}
        temporary.write_text(json.dumps(record, indent=2, default=str) + "\n")


def slug(name: str) -> str:
    """A name that is a file name everywhere."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", name)

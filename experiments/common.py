"""What every experiment shares: provenance of a result, where results go, names of files."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import platform
import re
from pathlib import Path
from typing import Any

import jax

from evflow.errors import EvflowDataError
from evflow.files import atomic_write
from evflow.report.provenance import weights_hash

PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy")


def provenance() -> dict[str, Any]:
    """Versions and machine, saved with every result."""
    import evflow

    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    machine = {"platform": platform.platform(), "cpus": os.cpu_count(),
               "device": jax.devices()[0].device_kind}
    return {"evflow": evflow.__version__, "versions": versions, "machine": machine}


def write_result(path: Path, result: dict[str, Any], config: dict[str, Any]) -> None:
    """Save a result with its configuration, the hashes of the weights that this names, and
    provenance as JSON."""
    with atomic_write(path, overwrite=True) as temporary:
        record = {"result": result, "config": config, "weights_sha256": hashes(config),
                  **provenance()}
        temporary.write_text(json.dumps(record, indent=2, default=str) + "\n")


def hashes(config: dict[str, Any]) -> dict[str, str]:
    """SHA-256 of the released or other weights under "weights" in a configuration."""
    named = config.get("weights") or ()
    found = {}
    for name in named if isinstance(named, list | tuple) else (named,):
        with contextlib.suppress(EvflowDataError, OSError):  # made by the experiment itself
            found[str(name)] = weights_hash(name)
    return found


def slug(name: str) -> str:
    """A name that is a file name everywhere."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", name)

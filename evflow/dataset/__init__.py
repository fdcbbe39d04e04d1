"""Data sets of simulated cameras, made in shards and read as plain NumPy arrays.

Makers use `build` and `verify` (or `python -m experiments.make_dataset`); users of a set
`iter_sequences` and `read_sequence`, which never import JAX: names load on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "EventSequence": "sequence",
    "sequence_names": "sequence",
    "iter_sequences": "store",
    "read_sequence": "store",
    "sequence_paths": "store",
    "write_sequence": "store",
    "DatasetConfig": "config",
    "PRESETS": "config",
    "optical_flow": "motion",
    "make_sequence": "generate",
    "build": "shards",
    "verify": "manifest",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"evflow.dataset.{_HOME[name]}"), name)
    raise AttributeError(f"module 'evflow.dataset' has no attribute {name!r}")

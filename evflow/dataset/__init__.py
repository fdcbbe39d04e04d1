"""Data sets of simulated cameras, made in shards and read as plain NumPy arrays.

Makers use `build` and `verify` (or `python -m experiments.make_dataset`); users of a set
`iter_sequences` and `read_sequence`, which never import JAX: names load on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

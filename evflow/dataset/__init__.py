"""Data sets of simulated cameras, made in shards and read as plain NumPy arrays.

`build` and `verify` make a set (or `python -m experiments.make_dataset`); `iter_sequences` and
`read_sequence` read it without importing JAX. Names load on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

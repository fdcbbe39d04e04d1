"""Scores of event streams, images and optical flow, as numbers without drawing.

The names load on first use: comparing streams needs no JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

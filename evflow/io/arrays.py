"""Single .npy arrays on disk, opened without reading them: lying headers and pickles refused."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from evflow.errors import EvflowDataError


def mapped(path: Path, shape: tuple[int | None, ...]) -> np.ndarray:
    """A memory-mapped .npy of numbers; trailing axes of length 1 beyond `shape` are dropped.

    Raises EV009 (damaged, pickled, another shape), EV016 (absent).
    """
    if not path.is_file():
        raise EvflowDataError("EV016", f"{path} is not there.", "Is the folder complete?")
    try:
        with open(path, "rb") as f:
            version = np.lib.format.read_magic(f)
            header = (np.lib.format.read_array_header_1_0 if version[0] == 1
                      else np.lib.format.read_array_header_2_0)
            found, fortran, dtype = header(f)
            start = f.tell()
    except Exception as e:  # NumPy's header parser raises a dozen kinds, tokenize's among them
        raise EvflowDataError(
            "EV009", f"{path} is not a sound .npy ({e or type(e).__name__}).",
            "Copy it again.") from e
    need, size = start + math.prod(found) * dtype.itemsize, os.path.getsize(path)
    if dtype.kind not in "biuf" or min(found, default=0) < 0 or need > size:
        raise EvflowDataError(
            "EV009", f"{path} claims {found} {dtype}, {need:,} bytes, and has {size:,}.",
            "Cut off, or an array of objects (pickles are refused)? Copy or export it again.")
    kept = found
    while len(kept) > len(shape) and kept[-1] == 1:
        kept = kept[:-1]
    if len(kept) != len(shape) or any(
            want is not None and want != got for want, got in zip(shape, kept, strict=True)):
        raise EvflowDataError(
            "EV009", f"{path} has shape {found}; expected {shape}.", "Export it again.")
    if math.prod(found) == 0:
        return np.zeros(kept, dtype)
    data = np.memmap(path, dtype, "r", start, found, "F" if fortran else "C")
    return data.reshape(kept)

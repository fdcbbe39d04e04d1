"""COCO's run-length masks: alternating runs of 0 and 1 down the columns, 0 first.

Runs come as a list, or packed into a string: 5 bits to a character (code 48 + value, 32 = more
follow), lowest first, in two's complement, and from the fourth on as the difference to the run
two before. Pure NumPy, without a loop over runs or characters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evflow.errors import EvflowDataError

MAX_CHARACTERS = 7  # 35 bits: no image has longer runs


def decode_rle(counts: str | bytes | Sequence[int], shape: tuple[int, int],
               where: str = "an RLE") -> np.ndarray:
    """The mask, bool (H, W) of `shape`; `where` names it in messages.

    Raises EV003 (runs that are no whole numbers), EV009 (damaged: a character out of range, a
    number cut off, a negative run, or runs that do not sum to H W).
    """
    runs = (unpack_counts(counts, where) if isinstance(counts, str | bytes)
            else _listed(counts, where))
    height, width = shape
    if (runs < 0).any() or (runs > height * width).any():  # the latter's sum could wrap around
        odd = runs[(runs < 0) | (runs > height * width)][0]
        raise EvflowDataError("EV009", f"{where} has a run of {odd} pixels.", _FIX)
    if runs.sum() != height * width:
        raise EvflowDataError(
            "EV009", f"{where} covers {runs.sum():,} pixels, its image {width}x{height} has "
            f"{height * width:,}.", "Is it of another image size, or cut off?")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def unpack_counts(text: str | bytes, where: str = "an RLE") -> np.ndarray:
    """The runs (N,) int64 of a packed string; EV009 where it is damaged."""
    data = text.encode("latin-1", "replace") if isinstance(text, str) else text
    code = np.frombuffer(data, np.uint8).astype(np.int64) - 48
    bad = (code < 0) | (code > 63)
    if bad.any():
        at = int(np.argmax(bad))
        raise EvflowDataError("EV009", f"{where} holds {data[at:at + 1]!r} at {at:,}.", _FIX)
    last = code < 32
    if len(code) == 0 or not last[-1]:
        raise EvflowDataError("EV009", f"{where} ends within a number.", _FIX)
    ends = np.flatnonzero(last)
    starts = np.append(0, ends[:-1] + 1)
    digit = np.arange(len(code)) - np.repeat(starts, ends - starts + 1)
    if digit.max() >= MAX_CHARACTERS:
        raise EvflowDataError("EV009", f"{where} holds a number of {digit.max() + 1} digits.", _FIX)
    runs = np.add.reduceat((code & 31) << (5 * digit), starts)
    runs -= np.where(code[ends] & 16, np.int64(32) << (5 * digit[ends]), 0)  # the sign
    runs[1::2] = np.cumsum(runs[1::2])
    runs[2::2] = np.cumsum(runs[2::2])
    return runs


def _listed(counts: Sequence[int], where: str) -> np.ndarray:
    try:
        runs = np.asarray(counts)
    except ValueError:  # lists in a list
        runs = np.zeros((), object)
    if runs.ndim != 1 or (runs.size and runs.dtype.kind not in "iu"):
        raise EvflowDataError(
            "EV003", f"{where} has runs of shape {runs.shape} and dtype {runs.dtype}.",
            "Expected whole numbers, or a string.")
    return runs.astype(np.int64)


_FIX = "Damaged? Export it again."

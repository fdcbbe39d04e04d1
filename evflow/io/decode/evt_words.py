"""Which encoding of Prophesee's RAW do these words have? For missing or wrong headers.

Decided by the types of words, and by the high time bits, which never decrease: EVT 2.0 has 32-bit
words; EVT 2.1 has the same in one half of its 64-bit words, so that times appear in that half only;
EVT 3.0 has 16-bit words.
"""

from __future__ import annotations

import numpy as np

LOW, TIME = 0x6, 0x8
EVT2_TYPES = np.isin(np.arange(16), (0, 1, TIME, 0xA, 0xE, 0xF))
EVT3_TYPES = ~np.isin(np.arange(16), (1, 9, 11, 12, 13))
LEAST = 8  # time words needed to decide
MOST_S = 2  # seconds between two of them
FITS = 0.99  # share of valid types, and of times that do not decrease
PADDED = 0.9  # share of valid types in EVT 3.0, which some firmware pads
NAMES = ("EVT2", "EVT2.1", "EVT3")


def fitting(data: bytes, order: str = "<") -> list[str]:
    """Those of `NAMES` whose words the data after a header can be; order: of bytes."""
    fits = _evt2(data, order), _evt21(data, order), _evt3(data, order)
    return [name for name, fit in zip(NAMES, fits, strict=True) if fit]


def encoding_note(declared: str, read: str) -> str:
    """What to say about words that are read in another encoding than the header declares."""
    return (f"the header says {declared}, but the words are those of {read} and were read as such"
            if declared else f"the header names no encoding: the words are those of {read}")


def _evt2(data: bytes, order: str) -> bool:
    words = np.frombuffer(data, f"{order}u4", len(data) // 4)
    return _goes_on(words) and _typed(words >> 28, EVT2_TYPES)


def _goes_on(words: np.ndarray) -> bool:
    """Whether the times of 32-bit words (n,) increase."""
    return _rises(words[words >> 28 == TIME], 0xFFFFFFF, MOST_S * 10**6 // 64)


def _evt21(data: bytes, order: str) -> bool:
    words = np.frombuffer(data, f"{order}u4", len(data) // 8 * 2)
    halves = words[0::2], words[1::2]
    times = [int((half >> 28 == TIME).sum()) for half in halves]
    if _goes_on(words) and min(times) > max(times) // 8:
        return False  # these are EVT 2.0
    return any(_goes_on(half) and _typed(half >> 28, EVT2_TYPES) for half in halves)


def _evt3(data: bytes, order: str) -> bool:
    words = np.frombuffer(data, f"{order}u2", len(data) // 2)
    kinds = words >> 12
    marks = words[(kinds == TIME) | (kinds == LOW)]
    high = marks >> 12 == TIME
    turn = np.cumsum(high)  # high words so far; the low words that follow complete the time
    known = ~high & (turn > 0)
    if high.sum() < LEAST or not known.any():
        return False
    whole = (marks[high].astype(np.int64) & 0xFFF)[turn[known] - 1] << 12 | marks[known] & 0xFFF
    return _rises(whole, 0xFFFFFF, MOST_S * 10**6) and _typed(kinds, EVT3_TYPES, PADDED)


def _rises(words: np.ndarray, bits: int, most: int) -> bool:
    """Whether the times in these bits of words (n,) increase, by steps of at most `most`."""
    if len(words) < LEAST:
        return False
    times = (words & bits).astype(np.int64)
    steps = (times[1:] - times[:-1]) & bits
    return bool((steps <= most).mean() >= FITS)


def _typed(kinds: np.ndarray, known: np.ndarray, least: float = FITS) -> bool:
    return bool(known[kinds].mean() >= least)

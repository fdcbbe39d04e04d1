"""Which encoding of Prophesee's RAW are these words? For headers that tell none, or a wrong one.

Words tell it by their types, and by the high bits of time, which never fall: EVT 2.0 has 32-bit
words, EVT 2.1 the same in one half of its 64-bit words, so that times stand in one half alone, EVT
3.0 16-bit words.
"""

from __future__ import annotations

import numpy as np

LOW, TIME = 0x6, 0x8
EVT2_TYPES = np.isin(np.arange(16), (0, 1, TIME, 0xA, 0xE, 0xF))
EVT3_TYPES = ~np.isin(np.arange(16), (1, 9, 11, 12, 13))
LEAST = 8  # words of time by which an encoding is told
MOST_S = 2  # between two of them
FITS = 0.99  # of the types that an encoding has, and of the times that do not fall
PADDED = 0.9  # of the types of EVT 3.0, which some firmware pads
NAMES = ("EVT2", "EVT2.1", "EVT3")


def fitting(data: bytes, order: str = "<") -> list[str]:
    """Those of `NAMES` whose words the data, the first behind a header, can be; order: of bytes."""
    fits = _evt2(data, order), _evt21(data, order), _evt3(data, order)
    return [name for name, fit in zip(NAMES, fits, strict=True) if fit]


def said(declared: str, read: str) -> str:
    """What is said of words that are read as another encoding than the header declares."""
    return (f"the header says {declared}, but the words are those of {read} and were read so"
            if declared else f"no header tells the encoding: the words are those of {read}")


def _evt2(data: bytes, order: str) -> bool:
    words = np.frombuffer(data, f"{order}u4", len(data) // 4)
    return _goes_on(words) and _typed(words >> 28, EVT2_TYPES)


def _goes_on(words: np.ndarray) -> bool:
    """Do the times of 32-bit words (n,) rise?"""
    return _rises(words[words >> 28 == TIME], 0xFFFFFFF, MOST_S * 10**6 // 64)


def _evt21(data: bytes, order: str) -> bool:
    words = np.frombuffer(data, f"{order}u4", len(data) // 8 * 2)
    halves = words[0::2], words[1::2]
    times = [int((half >> 28 == TIME).sum()) for half in halves]
    if _goes_on(words) and min(times) > max(times) // 8:
        return False  # those of EVT 2.0
    return any(_goes_on(half) and _typed(half >> 28, EVT2_TYPES) for half in halves)


def _evt3(data: bytes, order: str) -> bool:
    words = np.frombuffer(data, f"{order}u2", len(data) // 2)
    kinds = words >> 12
    marks = words[(kinds == TIME) | (kinds == LOW)]
    high = marks >> 12 == TIME
    turn = np.cumsum(high)  # high words so far: the low ones behind them complete the time
    known = ~high & (turn > 0)
    if high.sum() < LEAST or not known.any():
        return False
    whole = (marks[high].astype(np.int64) & 0xFFF)[turn[known] - 1] << 12 | marks[known] & 0xFFF
    return _rises(whole, 0xFFFFFF, MOST_S * 10**6) and _typed(kinds, EVT3_TYPES, PADDED)


def _rises(words: np.ndarray, bits: int, most: int) -> bool:
    """Do the times in these bits of words (n,) go on, by steps of at most that many?"""
    if len(words) < LEAST:
        return False
    times = (words & bits).astype(np.int64)
    steps = (times[1:] - times[:-1]) & bits
    return bool((steps <= most).mean() >= FITS)


def _typed(kinds: np.ndarray, known: np.ndarray, least: float = FITS) -> bool:
    return bool(known[kinds].mean() >= least)

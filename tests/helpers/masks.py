"""COCO's packed masks, written by hand."""

from __future__ import annotations


def pack(runs: list[int]) -> str:
    """COCO's string of runs, bit by bit."""
    text = ""
    for i, run in enumerate(runs):
        rest, more = run - (runs[i - 2] if i > 2 else 0), True
        while more:
            five, rest = rest & 31, rest >> 5
            more = rest != (-1 if five & 16 else 0)
            text += chr(48 + five + 32 * more)
    return text

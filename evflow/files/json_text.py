"""JSON of people's files: parsed only where it does not nest without end."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

DEEPEST = 100  # brackets within brackets: more than any file of ours, of COCO or of EVREAL has
BLOCK = 1 << 20  # bytes looked at together
STEP = np.zeros(256, np.int8)  # what a byte adds to the depth
STEP[[ord("["), ord("{")]] = 1
STEP[[ord("]"), ord("}")]] = -1


def parse_json(text: bytes | str, **options: Any) -> Any:
    """What `json.loads` makes of `text`; ValueError where brackets nest deeper than DEEPEST.

    Not left to the interpreter's own limit: RecursionError comes at any depth, by what is on the
    stack already, and objects that are collected amid it fail to close.
    """
    data = text.encode() if isinstance(text, str) else text
    depth = 0
    for start in range(0, len(data), BLOCK):
        steps = STEP[np.frombuffer(data, np.uint8, min(BLOCK, len(data) - start), start)]
        if depth + int(np.cumsum(steps, dtype=np.int64).max()) > DEEPEST:
            raise ValueError("brackets within brackets without end")
        depth += int(steps.sum(dtype=np.int64))
    return json.loads(data, **options)

"""JSON from unknown files: parsed only if it is not nested too deeply."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

DEEPEST = 100  # nested brackets: more than evflow's, COCO's or EVREAL's files have
BLOCK = 1 << 20  # bytes examined together
STEP = np.zeros(256, np.int8)  # change of depth by each byte value
STEP[[ord("["), ord("{")]] = 1
STEP[[ord("]"), ord("}")]] = -1


def parse_json(text: bytes | str, **options: Any) -> Any:
    """`json.loads` of `text`; ValueError if brackets nest deeper than DEEPEST.

    The interpreter's own limit is no substitute: RecursionError depends on the stack at the time,
    and objects that are garbage-collected in between may fail to close.
    """
    data = text.encode() if isinstance(text, str) else text
    depth = 0
    for start in range(0, len(data), BLOCK):
        steps = STEP[np.frombuffer(data, np.uint8, min(BLOCK, len(data) - start), start)]
        if depth + int(np.cumsum(steps, dtype=np.int64).max()) > DEEPEST:
            raise ValueError("brackets are nested too deeply")
        depth += int(steps.sum(dtype=np.int64))
    return json.loads(data, **options)

"""White of 16-bit and float frames, where a file states it under the name that evflow gives it.

The frames of a part, or of a dark scene, do not show it: they would be taken for those of a smaller
converter, four times too bright, or for fractions of white.
"""

from __future__ import annotations

from typing import Any

import numpy as np

WHITE = "full_scale"  # name under which it is written


def stated_white(value: Any) -> int:
    """The DN of a saturated pixel that a number, or array of one, states; 0 if it is no whole
    number of 1..65535."""
    one = np.asarray(value if isinstance(value, int | np.integer | np.ndarray) else ())
    white = int(one.item()) if one.dtype.kind in "iu" and one.size == 1 else 0
    return white if 0 < white < 2**16 else 0

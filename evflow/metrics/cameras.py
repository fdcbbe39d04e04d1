"""How alike two cameras are, parameter by parameter, in units of what is known of both."""

from __future__ import annotations

from typing import Any

import numpy as np

from evflow.camera import PARAMETERS, Camera
from evflow.errors import EvflowDataError

APART = 3.0  # standard deviations by which the medians of a map differ for sure
FLOOR = 0.01  # of a value: errors below are not believed


def compare_cameras(
    a: Camera, b: Camera, a_std: Camera | None = None, b_std: Camera | None = None
) -> dict[str, Any]:
    """JSON-ready numbers of two cameras of maps (H, W), by parameter.

    Of each: median a and b, their ratio b / a (None where a is 0); r, correlation over the pixels
    (None where a map does not vary or the sizes differ); error, standard deviation of the
    difference of the medians, and apart, that difference in units of it (both None without
    standard deviations): the median pixel's own, as all pixels share most of it.

    Raises EV002 where one holds several cameras.
    """
    for camera in (a, b):
        if len(camera.shape) != 2:
            raise EvflowDataError("EV002", f"maps of shape {camera.shape}.",
                                  "Compare two cameras of maps (H, W).")
    return {name: _one(*(None if c is None else np.asarray(getattr(c, name), np.float64)
                         for c in (a, b, a_std, b_std))) for name in PARAMETERS}


def _one(
    a: np.ndarray | None, b: np.ndarray | None, a_std: np.ndarray | None, b_std: np.ndarray | None
) -> dict[str, float | None]:
    assert a is not None
    assert b is not None
    first, second = float(np.median(a)), float(np.median(b))
    error = apart = None
    if a_std is not None and b_std is not None:
        error = float(np.hypot(np.median(a_std), np.median(b_std)))
        apart = (second - first) / max(error, FLOOR * max(first, second), 1e-12)
    varies = a.shape == b.shape and np.ptp(a) > 0 and np.ptp(b) > 0
    return {"a": first, "b": second, "ratio": second / first if first else None,
            "r": float(np.corrcoef(a.ravel(), b.ravel())[0, 1]) if varies else None,
            "error": error, "apart": apart}


def describe_cameras(numbers: dict[str, Any], names: tuple[str, str]) -> str:
    """A line a parameter, and which differ for sure."""
    lines = [f"{'':12} {names[0]:>14.14} {names[1]:>14.14} {'ratio':>8} {'apart':>8} {'r':>6}"]
    for name, row in numbers.items():
        ratio, apart, r = (
            "" if row[k] is None else f"{row[k]:{form}}"
            for k, form in (("ratio", ".3f"), ("apart", "+.1f"), ("r", ".2f")))
        lines.append(f"{name:12} {row['a']:14.4f} {row['b']:14.4f} {ratio:>8} {apart:>8} {r:>6}")
    known = [name for name, row in numbers.items() if row["apart"] is not None]
    sure = [name for name in known if abs(numbers[name]["apart"]) > APART]
    lines.append("apart: difference of the medians in standard deviations of it; r: over pixels.")
    if not known:
        lines.append("A camera without standard deviations: whether they differ is not known.")
    else:
        lines.append(f"They differ in {', '.join(sure)}." if sure else
                     "They do not differ by more than the errors allow.")
    return "\n".join(lines)

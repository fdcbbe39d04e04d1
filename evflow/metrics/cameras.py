"""Comparison of two cameras, parameter by parameter, in units of their errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from evflow.camera import PARAMETERS, Camera
from evflow.errors import EvflowDataError
from evflow.light.log_maps import normalised_intensity

APART = 3.0  # standard deviations: larger differences are certain
FLOOR = 0.01  # relative: least error of a value
GREY = 128.0  # DN at which two cutoffs are compared that depend on light in different ways
WHITE = 255.0  # DN of a cutoff that is proportional to light
WHOLE = ("sigma_on", "sigma_off", "cutoff_hz", "refractory_s", "leak_hz", "shot_hz")  # no maps

Known = Mapping[str, tuple[float, float]]


def compare_cameras(
    a: Camera, b: Camera, a_std: Camera | None = None, b_std: Camera | None = None, *,
    a_known: Known | None = None, b_known: Known | None = None,
    a_by_light: bool = True, b_by_light: bool = True,
) -> dict[str, dict[str, float | None]]:
    """JSON-ready numbers of two cameras of maps (H, W), by parameter.

    Args:
        a, b: the cameras.
        a_std, b_std: standard deviations of their pixels.
        a_known, b_known: camera-wide values and errors (`read_known`).
        a_by_light, b_by_light: whether their cutoffs are proportional to light and given at 255
            DN, or the same in any light (`SensorModel.cutoff_by_light`).

    Returns:
        By parameter: a, b, the known value, else the median of the map; a_std, b_std, its standard
        deviation, else that of the median pixel, as errors of pixels are mostly shared; their
        ratio b / a; error, std of the difference; apart, the difference in units of it; r,
        correlation over the pixels. None where a value is unknown, a map does not vary, or sizes
        differ. Of cutoff_hz also at_dn, the light in DN at which both are given: 255, or None
        where they are the same in any light, or 128 if one of them is proportional to light and
        the other is not; and a_by_light, b_by_light: 1 or 0, or None where it was not measured.

    Raises:
        EvflowDataError: EV002 for maps of several cameras.
    """
    for camera in (a, b):
        if len(camera.shape) != 2:
            raise EvflowDataError("EV002", f"maps of shape {camera.shape}.",
                                  "Compare two cameras of maps (H, W).")
    found = {}
    for name in PARAMETERS:
        maps = [np.asarray(getattr(camera, name), np.float64) for camera in (a, b)]
        varies = maps[0].shape == maps[1].shape and all(np.ptp(m) > 0 for m in maps)
        row = _one(_value(name, maps[0], a_std, a_known), _value(name, maps[1], b_std, b_known))
        r = float(np.corrcoef(maps[0].ravel(), maps[1].ravel())[0, 1]) if varies else None
        found[name] = {**row, "r": r if row["a"] is not None and row["b"] is not None else None}
    for name in WHOLE:
        pair = (a_known or {}).get(name), (b_known or {}).get(name)
        if pair != (None, None):
            found[name] = {**(_cutoffs(pair, (a_by_light, b_by_light)) if name == "cutoff_hz"
                              else _one(*pair)), "r": None}
    return found


def _cutoffs(
    pair: tuple[tuple[float, float] | None, tuple[float, float] | None], by_light: tuple[bool, bool]
) -> dict[str, float | None]:
    """The row of two cutoffs, at one light where their laws differ."""
    laws = [law if one else None for one, law in zip(pair, by_light, strict=True)]
    at = GREY if {True, False} <= {*laws} else WHITE if True in laws else None
    scale = normalised_intensity(GREY) if at == GREY else 1.0
    a, b = ((one[0] * scale, one[1] * scale) if one and law else one
            for one, law in zip(pair, laws, strict=True))
    return {**_one(a, b), "at_dn": at, **{f"{side}_by_light": None if law is None else float(law)
                                          for side, law in zip("ab", laws, strict=True)}}


def said_of_cutoff(row: Mapping[str, float | None]) -> str:
    """The light at which the cutoffs of a row are given, in words."""
    at = row["at_dn"]
    return "in any light" if at is None else f"at {at:g} DN"


def _value(
    name: str, values: np.ndarray, std: Camera | None, known: Known | None
) -> tuple[float, float] | None:
    """The camera's value and its error (NaN if unknown); None where it was not measured."""
    if known and set(PARAMETERS) & set(known):
        return known.get(name)
    error = np.nan if std is None else float(np.median(np.asarray(getattr(std, name))))
    return float(np.median(values)), error


def _one(
    a: tuple[float, float] | None, b: tuple[float, float] | None
) -> dict[str, float | None]:
    (first, first_std), (second, second_std) = a or (np.nan, np.nan), b or (np.nan, np.nan)
    error = float(np.hypot(first_std, second_std))
    apart = (second - first) / max(error, FLOOR * max(first, second), 1e-12)
    ratio = second / first if first else np.nan
    return {key: float(value) if np.isfinite(value) else None for key, value in {
        "a": first, "a_std": first_std, "b": second, "b_std": second_std, "ratio": ratio,
        "error": error, "apart": apart if np.isfinite(error) else np.nan}.items()}


def verdict(numbers: dict[str, Any], labels: Mapping[str, str] | None = None) -> str:
    """A sentence naming the parameters that differ significantly. labels: their names."""
    known = [name for name, row in numbers.items() if row["apart"] is not None]
    sure = [(labels or {}).get(name, name) for name in known
            if abs(numbers[name]["apart"]) > APART]
    if not known:
        return "A camera without standard deviations: whether they differ is not known."
    return (f"They differ in {', '.join(sure)}." if sure else
            "They do not differ by more than the errors allow.")

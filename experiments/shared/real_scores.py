"""Measured against true values of cameras that are not ideal, and their tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evflow import CameraEstimate, estimate_camera
from evflow.camera.optics import MEASURED
from evflow.errors import EvflowDataError
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.kept import Row
from experiments.shared.real_cameras import CHANGES, added_light

LABELS = {"cutoff_hz": "cutoff [Hz]", "refractory_s": "dead time [s]", "leak_hz": "leak [Hz]"}
SLOW = [name for name, change in CHANGES.items()
        if "model" in change and change["model"].photoreceptor is not None]  # without a cutoff_hz
HEADS = ("condition", "cameras", "ideal: median error of θ", "68 / 95 % hold",
         "measured: median error", "68 / 95 % hold", "median std")
OTHER_HEADS = ("what else", "condition", "true", "found in", "median error", "68 / 95 % hold")


def need_rows(path: Path | None) -> Path:
    """The file of the rows; EV020 where none was named, EV016 where there is none."""
    if path is None:
        raise EvflowDataError("EV020", "--as-it-is without --rows.", "Name the file of the rows.")
    if not path.is_file():
        raise EvflowDataError("EV016", f"no rows at {path}.", "Name the file of the rows.")
    return path


def in_two(runs: Sequence[list[int]]) -> list[list[int]]:
    """First and second half of each run of frame intervals, in turn. Runs of fewer than 4 are left
    out: a half is of two intervals at least, and both would hold the same one."""
    return [run[k:k + len(run) // 2] for run in runs if len(run) >= 4 for k in (0, len(run) // 2)]


def thresholds(found: CameraEstimate, truth: np.ndarray) -> Row:
    """Relative errors of theta_on and theta_off, and their stds."""
    theta, std = ([float(s.theta_on), float(s.theta_off)]
                  for s in (found.summary, found.summary_std))
    return {"error": (theta / truth - 1).tolist(), "std": (std / truth).tolist()}


def score(params: Any, hidden: Hidden, protocol: Protocol) -> Row:
    """Measured and true values of a camera."""
    truth = np.array([float(hidden.nominal.theta_on), float(hidden.nominal.theta_off)])
    found = estimate_camera(hidden.recording, params)
    sensor, optics = found.sensor, found.optics
    row: Row = {
        "measured": thresholds(found, truth),
        "sensor": {name: [getattr(sensor, name), finite(found.sensor_std.get(name)),
                          getattr(protocol.model, name)] for name in MEASURED},
        "light": [optics.offset_dn, finite(optics.offset_dn_std), added_light(protocol)]}
    if protocol.model.shot_hz:
        maps = np.stack([found.camera.eta_on, found.camera.eta_off])
        sides = maps, np.stack([hidden.camera.eta_on, hidden.camera.eta_off])
        row["noise"] = [[[float(of(m)) for m in both] for both in sides]
                        for of in (np.mean, np.median)]
    return row


def finite(value: float | None) -> float | None:
    """The value; None for NaN, which JSON cannot represent."""
    return value if value is not None and np.isfinite(value) else None


def score_ideal(params: Any, hidden: Hidden, _protocol: Protocol) -> Row:
    """Thresholds of the estimate that assumes ideal pixels."""
    truth = np.array([float(hidden.nominal.theta_on), float(hidden.nominal.theta_off)])
    return thresholds(estimate_camera(hidden.recording, params, pixel="ideal"), truth)


def key(name: str, number: int, *, ideal: bool = False) -> str:
    """Key of a row: condition, number of the camera, whether assumed ideal."""
    return f"{name} {number}{' ideal' * ideal}"


def gathered(rows: dict[str, Row], names: Sequence[str]) -> dict[str, list[Row]]:
    """The rows by key -> those of each condition that has some, with what takes a camera for ideal
    as "ideal" of its row."""
    found: dict[str, list[Row]] = {}
    for name in names:
        some: list[Row] = []
        while (of := key(name, len(some))) in rows:
            beside = rows.get(key(name, len(some), ideal=True))
            some.append(rows[of] | ({"ideal": beside} if beside else {}))
        if some:
            found[name] = some
    return found


def held(error: np.ndarray, std: np.ndarray) -> str:
    """Per cent of errors within 1 and 1.96 std."""
    z = np.abs(error) / std
    return f"{100 * (z < 1).mean():.0f} / {100 * (z < 1.96).mean():.0f} %" if z.size else "–"


def cells(name: str, rows: list[Row]) -> list[str]:
    """A condition's thresholds."""
    line = [name, str(len(rows))]
    for which in ("ideal", "measured"):
        error, std = (np.array([r[which][k] for r in rows if which in r]) for k in ("error", "std"))
        line += [f"{100 * np.median(np.abs(error)):.1f} %" if error.size else "–",
                 held(error, std)]
    return [*line, f"{100 * np.median(std):.1f} %"]


def sensor_lines(rows: dict[str, list[Row]]) -> list[list[str]]:
    """What was measured of the circuit: what, condition, true value, how often found, median error
    of those, and how often the intervals hold; last, how often it was found where there is none."""
    lines = []
    for name, label in LABELS.items():
        without = []
        for condition, found in rows.items():
            value, std, true = np.array([r["sensor"][name] for r in found], float).T
            there = value > 0
            if not true[0]:
                if condition not in SLOW or name != "cutoff_hz":
                    without += there.tolist()
                continue
            off = value[there] / true[there] - 1
            lines.append([label, condition, f"{true[0]:g}", f"{there.sum()} of {len(found)}",
                          f"{100 * np.median(np.abs(off)):.0f} %" if off.size else "–",
                          held(off, std[there] / true[there])])
        lines.append([label, "all others", "0", f"{sum(without)} of {len(without)}", "", ""])
    return lines


def light_lines(rows: dict[str, list[Row]]) -> list[list[str]]:
    """The same of the light that frames lack, and of noise rates over pixels."""
    lines = []
    for condition, found in rows.items():
        value, std, true = np.array([r["light"] for r in found], float).T
        there = value != 0
        if true[0]:
            off = (value - true)[there]
            lines.append(["light added [DN]", condition, f"{true[0]:g}",
                          f"{there.sum()} of {len(found)}",
                          f"{np.median(np.abs(off)):.1f} DN" if off.size else "–",
                          held(off, std[there])])
        for k, what in enumerate(("mean", "median") if "noise" in found[0] else ()):
            maps, real = np.array([r["noise"][k] for r in found]).transpose(1, 0, 2)
            lines.append([f"η [Hz], {what} of pixels", condition, f"{np.median(real):.2f}", "all",
                          f"{100 * np.median(np.abs(maps / real - 1)):.0f} %", ""])
    return lines

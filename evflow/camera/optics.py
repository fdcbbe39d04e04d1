"""What is measured of a camera beyond its maps: summary, circuit, and how its frames relate to what
its pixels see.

camera.npz holds them as scalars, `summary_theta_on`, `sensor_cutoff_hz`, `optics_offset_dn`, ...
and their standard deviations `..._std`, NaN where nothing was measured.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evflow.camera.file import PARAMETERS
from evflow.camera.leak import shot_eta
from evflow.camera.prior import Summary
from evflow.camera.sensors import DeadContrast, LogMap, SensorModel
from evflow.errors import EvflowDataError
from evflow.files.archives import load_npz

MEASURED = ("cutoff_hz", "refractory_s", "leak_hz", "shot_hz")  # of a SensorModel, with an error
SHOT_ETA = "shot_eta_hz"
LAW = "cutoff_by_light"  # 1 or 0
MAP = "log_eps"  # 1: the sensor's log map is "log_eps", 0: "linlog"
LOSS = "dead_contrast"  # index in LOSSES
LOSSES: tuple[DeadContrast, ...] = ("keeps", "drops", "resets")
LOSS_WORDS: dict[DeadContrast, str] = {
    "keeps": "", "drops": ", events in it dropped", "resets": ", reset at its end"}


@dataclasses.dataclass(frozen=True)
class Optics:
    """How the frames of a recording relate to the light on its pixels.

    offset_dn: light in DN that the pixels see and the frames do not show (dark light minus the
    frames' black level); delay_s: delay in seconds of events after the frame times; exposure_s: of
    the frames in seconds, as their blur shows (out of focus they look alike), 0 where a file told
    it or nothing shows it; and the standard deviations of these, NaN where not measured.
    """

    offset_dn: float = 0.0
    delay_s: float = 0.0
    offset_dn_std: float = float("nan")
    delay_s_std: float = float("nan")
    exposure_s: float = 0.0
    exposure_s_std: float = float("nan")


def as_arrays(
    sensor: SensorModel, std: Mapping[str, float], optics: Optics
) -> dict[str, np.ndarray]:
    """Scalars by their names in camera.npz."""
    named = {f"sensor_{name}": getattr(sensor, name) for name in MEASURED}
    named |= {f"sensor_{name}_std": std.get(name, np.nan) for name in MEASURED}
    named[f"sensor_{SHOT_ETA}"] = sensor.shot_eta_hz
    named[f"sensor_{LAW}"] = float(sensor.cutoff_by_light)
    named[f"sensor_{MAP}"] = float(sensor.log_map == MAP)
    named[f"sensor_{LOSS}"] = LOSSES.index(sensor.in_dead_time)
    named |= {f"optics_{name}": value for name, value in dataclasses.asdict(optics).items()}
    return {name: np.asarray(value, np.float64) for name, value in named.items()}


def summary_arrays(summary: Summary, std: Summary) -> dict[str, np.ndarray]:
    """A summary as scalars by their names in camera.npz."""
    return {f"summary_{name}{end}": np.asarray(value, np.float64)
            for end, kind in (("", summary), ("_std", std))
            for name, value in dataclasses.asdict(kind).items()}


def read_summary(path: str | os.PathLike) -> tuple[dict[str, float], dict[str, float]] | None:
    """The summary in a camera.npz and its standard deviations, by name; None if it has none.
    Raises EV009, EV016."""
    held = load_npz(Path(path))
    names = [field.name for field in dataclasses.fields(Summary)]
    if any(f"summary_{name}{end}" not in held for name in names for end in ("", "_std")):
        return None
    of, std = ({n: held[f"summary_{n}{end}"] for n in names} for end in ("", "_std"))
    if any(np.shape(v) != () or v.dtype.kind not in "fiu"
           for values in (of, std) for v in values.values()) or not np.isfinite(
               [*of.values()]).all() or np.isinf([*std.values()]).any():
        raise EvflowDataError("EV009", f"{path}: a value of its summary is not a finite number.",
                              "Make the file again: evflow estimate.")
    return {n: float(v) for n, v in of.items()}, {n: float(v) for n, v in std.items()}


def read_shared(path: str | os.PathLike) -> dict[str, float]:
    """What `shared_error` gives of the summary in a camera.npz; empty if it has none. Raises EV009,
    EV016."""
    found = read_summary(path)
    return {} if found is None else shared_error(*found)


def shared_error(summary: Mapping[str, float], std: Mapping[str, float]) -> dict[str, float]:
    """The error that all pixels of a camera share, relative to the values, by name of the map: that
    of its summary, by name. Without maps whose value is 0 or whose error is unknown."""
    return {name: std[name] / summary[name] for name in PARAMETERS
            if summary[name] > 0 and np.isfinite(std[name])}


def read_known(path: str | os.PathLike) -> dict[str, tuple[float, float]]:
    """(value, standard deviation) of everything in a camera.npz that was measured for the camera as
    a whole: the determined part of its summary, and its circuit. Raises EV009, EV016."""
    held = load_npz(Path(path))
    values, errors = read_summary(path) or ({}, {})
    undetermined = {f"{kind}_{name.partition('_')[2]}" for name in read_undetermined(path)
              for kind in ("theta", "sigma")}
    known = {name: (value, errors[name]) for name, value in values.items()
             if name not in undetermined}
    sensor = read_sensor(path)[0]
    for name in MEASURED:
        error = float(held.get(f"sensor_{name}_std", np.nan))
        if getattr(sensor, name) and np.isfinite(error):
            known[name] = (getattr(sensor, name), error)
    return known


def read_undetermined(path: str | os.PathLike) -> tuple[str, ...]:
    """Thresholds in a camera.npz whose values and widths are the prior's, because the recording did
    not determine them; empty for files that do not say. Raises EV009, EV016."""
    named = load_npz(Path(path)).get("undetermined")
    return () if named is None or named.dtype.kind != "U" else tuple(str(n) for n in named.ravel())


def read_sensor(path: str | os.PathLike) -> tuple[SensorModel, Optics]:
    """The circuit and the optics in a camera.npz; those of an ideal pixel if it holds none.
    Raises EV009 if a value is not a finite number, EV016 if there is no file."""
    held = load_npz(Path(path))
    values: dict[str, dict[str, Any]] = {"sensor": {}, "optics": {}}
    names = {"sensor": (*MEASURED, SHOT_ETA, LAW, MAP, LOSS),
             "optics": tuple(f.name for f in dataclasses.fields(Optics))}
    for room, wanted in names.items():
        for name in wanted:
            value = held.get(f"{room}_{name}")
            if value is None:
                continue
            if np.shape(value) != () or value.dtype.kind not in "fiu" or (
                    not name.endswith("_std") and not np.isfinite(value)):
                raise EvflowDataError("EV009", f"{path}: {room}_{name} is not a finite number.",
                                      "Make the file again: evflow estimate.")
            values[room][name] = float(value)
    if LAW in values["sensor"]:
        values["sensor"][LAW] = bool(values["sensor"][LAW])
    if SHOT_ETA not in values["sensor"] and values["sensor"].get("shot_hz"):
        # Older files lack it, and have a summary.
        of = (read_summary(path) or ({"eta_on": 0.0, "eta_off": 0.0}, {}))[0]
        values["sensor"][SHOT_ETA] = shot_eta(
            of["eta_on"], of["eta_off"], values["sensor"].get("leak_hz", 0.0))
    log_map: LogMap = "log_eps" if values["sensor"].pop(MAP, 0.0) else "linlog"
    if (loss := values["sensor"].pop(LOSS, 0.0)) not in range(len(LOSSES)):
        raise EvflowDataError(
            "EV009", f"{path}: sensor_{LOSS} is {loss:g}.", "It is "
            f"{', '.join(f'{k} ({name})' for k, name in enumerate(LOSSES))}: evflow estimate.")
    sensor = SensorModel(
        **values["sensor"], log_map=log_map, dead_contrast=LOSSES[int(loss)] if loss else "auto",
        eta_is_all=True, noise_resets_memory=True)
    return sensor, Optics(**values["optics"])

"""The simulators that a camera can be exported to, and how an export is written."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from evflow.camera.camera import Camera
from evflow.camera.exports import esim, iebcs, openeb, v2e
from evflow.camera.exports.common import Export, Maps, Settings
from evflow.camera.file import PARAMETERS
from evflow.camera.optics import Optics
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.files.folders import atomic_folder
from evflow.files.whole import need_members, write_checked

TARGETS: Mapping[str, Callable[[Maps, Settings], Export]] = {
    "v2e": v2e.export, "esim": esim.export, "openeb": openeb.export, "iebcs": iebcs.export}


def export_camera(
    camera: Camera, to: str, std: Camera | None = None, sensor: SensorModel = SensorModel(),
    summary: Mapping[str, float] | None = None, optics: Optics = Optics(),
    undetermined: Sequence[str] = (),
) -> tuple[Export, Maps]:
    """A camera of maps (H, W) as the settings of a simulator, with the maps as float32. std: that
    of an estimate's maps, which are smoother than the camera; sensor: its measured circuit;
    summary: the estimate's summary (`read_summary`), by default computed from the maps; optics: how
    the light on the pixels differs from what the frames show; undetermined: maps that are a
    prior's, not measured.

    Raises EV020 (no such simulator), EV002 (several cameras at once).
    """
    if to not in TARGETS:
        raise EvflowDataError("EV020", f"to={to!r}.", f"Choose from {list(TARGETS)}.")
    if len(camera.shape) != 2:
        raise EvflowDataError(
            "EV002", f"the camera's maps have shape {camera.shape}.", "Export one camera, (H, W).")
    maps, errors = ({name: np.asarray(getattr(c, name), np.float32) for name in PARAMETERS}
                    if c is not None else None for c in (camera, std))
    assert maps is not None
    export = TARGETS[to](maps, Settings.of(maps, errors, sensor, summary))
    text = _unmeasured(undetermined) + export.text + _light(optics)
    return dataclasses.replace(export, text=text), maps


def _unmeasured(names: Sequence[str]) -> str:
    """A paragraph about values that are a prior's; "" without any."""
    return (f"NOT MEASURED: {' and '.join(names)}, with their spread. They are a prior's,\n"
            "whatever is said of them below and in the scripts.\n\n") if names else ""


def _light(optics: Optics) -> str:
    """A line about an offset between this camera's frames and its pixels; "" if there is none."""
    if not (np.isfinite(optics.offset_dn_std) and optics.offset_dn):
        return ""
    seen = f"{abs(optics.offset_dn):.1f} DN {'more' if optics.offset_dn > 0 else 'less'} than"
    return (f"- Light: the pixels of this camera see {seen} its frames show, and\n"
            "  the thresholds refer to that light. Add it to frames of this camera, as evflow\n"
            "  simulate does; other videos do not need it.\n")


def write_export(
    folder: str | os.PathLike, export: Export, maps: Maps, *, overwrite: bool = False
) -> Path:
    """maps.npz, README.txt, the scripts and arrays in a new folder; EV013, EV019."""
    corner = {name: values[:1, :1] for name, values in maps.items()}  # names depend on no size
    kinds = [make(corner, Settings.of(corner)) for make in TARGETS.values()]
    names = {"maps.npz", "README.txt"}.union(*(k.scripts.keys() | k.arrays.keys() for k in kinds))
    with atomic_folder(folder, names=names, overwrite=overwrite) as new:
        with open(new / "maps.npz", "wb") as f:
            np.savez_compressed(f, allow_pickle=False, **maps)
        need_members(new / "maps.npz", {f"{name}.npy": None for name in maps})
        for name, array in export.arrays.items():
            with open(new / name, "wb") as f:
                np.lib.format.write_array(f, array)
        for name, source in {"README.txt": export.text, **export.scripts}.items():
            write_checked(new / name, source)
    return Path(folder)

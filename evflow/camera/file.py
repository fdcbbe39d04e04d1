"""Reading and writing the maps of a camera as an .npz of arrays by name."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from shlex import quote
from typing import Any, BinaryIO

import numpy as np

from evflow.errors import EvflowDataError, naming
from evflow.files.archives import load_npz
from evflow.files.atomic import atomic_write
from evflow.files.regular import need_opened
from evflow.files.whole import need_members

PARAMETERS = ("theta_on", "theta_off", "eta_on", "eta_off")
ERRORS = tuple(f"{name}_std" for name in PARAMETERS)
EXPECTED = ("Expected the camera.npz of evflow estimate (or Camera.save): maps (H, W) "
            f"{', '.join(PARAMETERS)}.")
UNITS = {"theta": "natural log", "eta": "Hz per pixel and polarity"}
Arrays = dict[str, Any]
QUICK = 1  # compression level: higher ones hardly shrink maps of floats


def write_maps(path: str | os.PathLike, maps: Arrays, extra: Arrays, overwrite: bool) -> Path:
    """Write the maps of PARAMETERS with their units, and other arrays; raises EV020 if one of these
    has a reserved name, EV013, EV019."""
    if taken := {*PARAMETERS, "meta"} & set(extra):
        raise EvflowDataError("EV020", f"extra arrays named {', '.join(sorted(taken))}.",
                              "The camera's own maps have these names; choose others.")
    if objects := [name for name, values in extra.items() if np.asarray(values).dtype.hasobject]:
        raise EvflowDataError("EV020", f"{', '.join(objects)} hold objects, not numbers or text.",
                              "Give arrays of numbers.")
    arrays = {**maps, **extra}
    with atomic_write(path, overwrite=overwrite) as temporary:
        with open(temporary, "wb") as opened:
            _write_arrays(opened, {"meta": np.array(json.dumps(UNITS)), **arrays})
        need_members(temporary, {f"{name}.npy": None for name in ("meta", *arrays)})
    return Path(path)


def _write_arrays(opened: BinaryIO, arrays: Arrays) -> None:
    """Like np.savez_compressed, which does not let one choose the level."""
    with zipfile.ZipFile(opened, "w", zipfile.ZIP_DEFLATED, compresslevel=QUICK) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)


def read_maps(path: Path) -> tuple[list[np.ndarray], list[np.ndarray] | None]:
    """The arrays of PARAMETERS, and their std if the file has them; raises EV008, EV009, EV016."""
    _check_kind(path)
    data = load_npz(path)
    missing = [n for n in PARAMETERS if n not in data]
    if missing:
        recording = " It is a recording." if {"t", "x", "y", "p"} <= set(data) else ""
        raise EvflowDataError(
            "EV008", f"{path} holds {', '.join(sorted(data)[:12])} but not "
            f"{', '.join(missing)}.{recording}", EXPECTED if not recording else
            f"Estimate its camera, evflow estimate {quote(str(path))} -o cam/, and pass "
            "cam/camera.npz.")
    with naming(path):
        for name in {*PARAMETERS, *ERRORS} & set(data):
            if data[name].dtype.kind not in "fiu":
                raise EvflowDataError("EV009", f"{name} has dtype {data[name].dtype}.",
                                      "Expected float32.")
    whole = all(name in data for name in ERRORS)
    return [data[n] for n in PARAMETERS], [data[n] for n in ERRORS] if whole else None


def holds_camera(path: Path) -> bool:
    """Whether a file is an .npz with a camera's maps."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in PARAMETERS} <= set(archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def _check_kind(path: Path) -> None:
    """Raise EV016 if there is no file, EV008 if it is not an .npz."""
    inside = path / "camera.npz"
    if path.is_dir() and inside.is_file():
        raise EvflowDataError("EV016", f"{path} is a folder.", f"Pass {inside}.")
    if not path.is_file():
        raise EvflowDataError("EV016", f"no camera file at {path}"
                              f"{' (a folder without camera.npz)' if path.is_dir() else ''}.",
                              "Make one: evflow estimate RECORDING -o cam/.")
    need_opened(path)
    with open(path, "rb") as opened:
        head = opened.read(6)
    if head == np.lib.format.MAGIC_PREFIX:
        raise EvflowDataError("EV008", f"{path} is one array (.npy), not a camera.", EXPECTED)
    if head[:2] != b"PK" and path.suffix.lower() != ".npz":
        beside = path.with_name("camera.npz")
        raise EvflowDataError("EV008", f"{path} is not an .npz: it begins with {head!r}.", EXPECTED
                              + (f" Beside it lies {beside}." if beside.is_file() else ""))

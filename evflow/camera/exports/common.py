"""The registry of simulators, the scalars nearest to a camera, and how an export is written."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.folders import atomic_folder
from evflow.files.whole import need_members

if TYPE_CHECKING:
    from evflow.camera import Camera

Maps = Mapping[str, np.ndarray]
GREY = 1 - 0.75 * (128 + 20) / 275  # shot noise of v2e and of OpenEB at 128 DN over that at 0 DN
MAD = 1.4826  # standard deviations in a median absolute deviation of a normal distribution

NOISE = '''"""Adds the measured noise to simulated events: Poisson, per pixel and polarity."""

import numpy as np


def add_noise(x, y, t_us, p, maps, start, stop, seed=0):
    """Columns (N,) of a simulation without noise -> columns sorted by time; p is 0 or 1.

    maps: eta_on, eta_off (H, W) in Hz. start, stop: of the video, in us: noise does not wait for
    the first event. The pixel's memory is not reset by a noise event.
    """
    rng, columns = np.random.default_rng(seed), [[x], [y], [t_us], [p]]
    for polarity, name in ((1, "eta_on"), (0, "eta_off")):
        count = rng.poisson(maps[name] * (stop - start) * 1e-6)
        rows, cols = np.nonzero(count)
        n = count[rows, cols]
        new = (np.repeat(cols, n), np.repeat(rows, n), rng.integers(start, stop, n.sum()),
               np.full(n.sum(), polarity))
        for column, values in zip(columns, new):
            column.append(values)
    x, y, t_us, p = (np.concatenate(column) for column in columns)
    order = np.argsort(t_us, kind="stable")
    return x[order], y[order], t_us[order], p[order]
'''


@dataclasses.dataclass(frozen=True)
class Settings:
    """The scalars nearest to a camera's maps: medians over the pixels, thresholds in natural-log
    units, rates in Hz per pixel and polarity; sigma: the spread of a threshold over the pixels."""

    width: int
    height: int
    theta_on: float
    theta_off: float
    sigma_on: float
    sigma_off: float
    eta_on: float
    eta_off: float

    @staticmethod
    def of(maps: Maps, std: Maps | None = None) -> Settings:
        """From maps (H, W) and their standard deviations; hot and dead pixels move neither median
        nor spread, which is that of the estimates and that within each, together."""
        middle = {name: float(np.median(values)) for name, values in maps.items()}
        sigma = {}
        for name in ("theta_on", "theta_off"):
            spread = MAD * float(np.median(np.abs(maps[name] - middle[name])))
            within = float(np.median(std[name])) if std else 0.0
            sigma[name.replace("theta", "sigma")] = float(np.hypot(spread, within))
        height, width = maps["theta_on"].shape
        return Settings(width, height, **middle, **sigma)

    @property
    def sigma(self) -> float:
        """One spread for both polarities: the root of the mean variance."""
        return float(np.hypot(self.sigma_on, self.sigma_off) / np.sqrt(2))


@dataclasses.dataclass(frozen=True)
class Export:
    """text: how to use it and what is lost. scripts: name -> Python source. arrays: name.npy ->
    array, beside the maps."""

    text: str
    scripts: Mapping[str, str]
    arrays: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


def export_camera(camera: Camera, to: str, std: Camera | None = None) -> tuple[Export, Maps]:
    """A camera of maps (H, W) in the words of a simulator, and the maps as float32. std: of an
    estimate's maps, which are more even than the camera.

    Raises EV020 (no such simulator), EV002 (several cameras at once).
    """
    from evflow.camera import PARAMETERS

    known = targets()
    if to not in known:
        raise EvflowDataError("EV020", f"to={to!r}.", f"Choose from {list(known)}.")
    if len(camera.shape) != 2:
        raise EvflowDataError(
            "EV002", f"the camera's maps have shape {camera.shape}.", "Export one camera, (H, W).")
    maps, errors = ({name: np.asarray(getattr(c, name), np.float32) for name in PARAMETERS}
                    if c is not None else None for c in (camera, std))
    assert maps is not None
    return known[to](maps, Settings.of(maps, errors)), maps


def write_export(
    folder: str | os.PathLike, export: Export, maps: Maps, *, overwrite: bool = False
) -> Path:
    """maps.npz, README.txt, the scripts and arrays in a new folder; EV013, EV019."""
    corner = {name: values[:1, :1] for name, values in maps.items()}  # files are named by no map
    kinds = [make(corner, Settings.of(corner)) for make in targets().values()]
    names = {"maps.npz", "README.txt"}.union(*(k.scripts.keys() | k.arrays.keys() for k in kinds))
    with atomic_folder(folder, names=names, overwrite=overwrite) as new:
        with open(new / "maps.npz", "wb") as f:
            np.savez_compressed(f, allow_pickle=False, **maps)
        need_members(new / "maps.npz", {f"{name}.npy": None for name in maps})
        for name, array in export.arrays.items():
            with open(new / name, "wb") as f:
                np.lib.format.write_array(f, array)
        for name, source in {"README.txt": export.text, **export.scripts}.items():
            (new / name).write_text(source, "utf-8")
    return Path(folder)


def targets() -> dict[str, Callable[[Maps, Settings], Export]]:
    """The simulators by name."""
    from evflow.camera.exports import esim, iebcs, openeb, v2e

    return {module.__name__.rpartition(".")[2]: module.export
            for module in (v2e, esim, openeb, iebcs)}

"""The result of an estimate: maps with errors, the camera's summary, and notes."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evflow.camera import PARAMETERS, Camera, Summary
from evflow.camera.optics import Optics, as_arrays, shared_error, summary_arrays
from evflow.camera.sensors import SensorModel
from evflow.estimation.bench.levels import Bench
from evflow.estimation.drift import Third
from evflow.estimation.extent import EVERYTHING, Extent
from evflow.estimation.refine.receptor_result import Found
from evflow.notes import Note, as_dicts

THRESHOLDS = ("theta_on", "theta_off")  # possible entries of `undetermined`


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class CameraEstimate:
    """A measured camera: maps with their errors, what all pixels share, and what to know about it.

    Attributes:
        camera: maps (H, W), theta in natural-log units, eta in Hz.
        std: their standard deviations, in the same units; NaN for weights that estimate none.
        summary: the camera's medians, noise rates and mismatch, scalars.
        summary_std: their standard deviations.
        valid: (H, W) bool, pixels that are not hot and have at least 3 events in the windows used,
            counted where the frames are neither saturated nor black.
        n_events: (H, W) uint32, events in the windows used.
        hot: (H, W) bool, pixels that fire while nothing moves.
        dead: (H, W) bool, pixels that never fire while those around them do.
        windows: number of windows used; 0 for a static scene.
        notes: what to know before trusting it.
        undetermined: those of `THRESHOLDS` that the recording does not determine: their values and
            widths are the prior's.
        sensor: the pixel circuit as far as it was measured: cutoff_hz, 0 if the photoreceptor is
            too fast to be measured, and cutoff_by_light; refractory_s, 0 if too few pixels change
            that fast; leak_hz and shot_hz, both part of the camera's eta, 0 if there are fewer
            than 200 such events.
        sensor_std: its standard deviations by field, NaN where nothing was measured.
        optics: how the frames relate to the light on the pixels: offset, delay and exposure.
        receptor: how both were found: the search for the photoreceptor and what it explains; None
            if nothing was searched for.
        extent: how much of the recording was read, and what more would bring.
        thirds: thresholds of the three thirds of the recording, if it is long enough: whether the
            camera stayed the same.
        bench: for a bench, its light levels: noise and speed at each; None for other recordings.
    """

    camera: Camera
    std: Camera
    summary: Summary
    summary_std: Summary
    valid: np.ndarray
    n_events: np.ndarray
    hot: np.ndarray
    dead: np.ndarray
    windows: int
    notes: tuple[Note, ...]
    undetermined: tuple[str, ...]
    sensor: SensorModel = SensorModel(noise_resets_memory=True)
    sensor_std: Mapping[str, float] = dataclasses.field(default_factory=dict)
    optics: Optics = Optics()
    receptor: Found | None = None
    extent: Extent = EVERYTHING
    thirds: tuple[Third, ...] = ()
    bench: Bench | None = None

    def __repr__(self) -> str:
        height, width = np.shape(self.valid)
        determined = [name for name in THRESHOLDS if name not in self.undetermined]
        values = "".join(f", {name} {float(getattr(self.summary, name)):.4g} ± "
                         f"{float(getattr(self.summary_std, name)):.2g}"
                         for name in (*determined, "eta_on", "eta_off"))
        return f"CameraEstimate({width}x{height}{values}, {len(self.notes)} notes)"

    @property
    def shared_error(self) -> dict[str, float]:
        """The part of std that all pixels share, relative to the values, by name of the map: what
        `Camera.drawn` takes."""
        return shared_error(*({k: float(v) for k, v in dataclasses.asdict(s).items()}
                              for s in (self.summary, self.summary_std)))

    def save(self, path: str | os.PathLike, *, overwrite: bool = False) -> Path:
        """Write camera.npz: theta_on ..., theta_on_std ... (if known), valid, n_events, hot, dead,
        and the scalars of `camera.optics`: summary, circuit, frames.

        Args:
            path: of the file; `Camera.load` reads it.
            overwrite: replace a file that exists.

        Returns:
            The path.

        Raises:
            EvflowDataError: EV013 (exists), EV014 (maps out of range), EV019 (cannot be written).
        """
        extra: dict[str, Any] = {}
        if not np.isnan(np.asarray(self.std.theta_on)).all():
            extra = {f"{name}_std": getattr(self.std, name) for name in PARAMETERS}
        extra |= as_arrays(self.sensor, self.sensor_std, self.optics)
        extra |= summary_arrays(self.summary, self.summary_std)
        extra["undetermined"] = np.array(self.undetermined, "U9")
        return self.camera.save(path, overwrite=overwrite, **extra, valid=self.valid,
                                n_events=self.n_events, hot=self.hot, dead=self.dead)

    def as_dict(self) -> dict[str, Any]:
        """Summary, std and notes as JSON-ready values; None for NaN."""
        def floats(s: Summary) -> dict[str, float | None]:
            return {k: float(v) if np.isfinite(v) else None
                    for k, v in dataclasses.asdict(s).items()}

        def places(mask: np.ndarray) -> list[list[int]]:
            return [[int(x), int(y)] for y, x in np.argwhere(mask)]

        scalars = as_arrays(self.sensor, self.sensor_std, self.optics)
        measured = {k: float(v) if np.isfinite(v) else None for k, v in scalars.items()}
        return {"summary": floats(self.summary), "summary_std": floats(self.summary_std),
                **measured,
                "valid_fraction": float(self.valid.mean()), "events": int(self.n_events.sum()),
                "hot_pixels": places(self.hot), "dead_pixels": places(self.dead),
                "windows": self.windows, "undetermined": list(self.undetermined),
                "extent": self.extent.as_dict(), "thirds": [t.as_dict() for t in self.thirds],
                **({"bench": self.bench.as_dict()} if self.bench else {}),
                "notes": as_dicts(self.notes)}

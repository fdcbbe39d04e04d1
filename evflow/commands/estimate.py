"""`evflow estimate`: a recording's camera."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated

import tyro

from evflow.commands.options import Reading, write_json
from evflow.errors import EvflowDataError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate(Reading):
    """Measure a camera: per-pixel thresholds and noise rates, from events and frames.

    Example: evflow estimate flight.aedat4 -o cam/
    """

    recording: tyro.conf.Positional[Path]
    """A recording with frames."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for camera.npz, camera.json and the pictures."""
    weights: str = "default"
    """Name of released weights, or a .safetensors path."""
    window_ms: float = 40.0
    """Shortest window; windows run from frame to frame."""
    plots: bool = True
    """Write maps and histograms as PNG (needs matplotlib)."""
    overwrite: bool = False
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> None:
        from evflow.progress import bar
        from evflow.recording import estimate_camera
        from evflow.report import plots
        from evflow.report.text import describe
        from evflow.weights import load_weights, model_card

        if (self.out / "camera.npz").exists() and not self.overwrite:
            raise EvflowDataError(
                "EV013", f"{self.out / 'camera.npz'} exists.", "Pass --overwrite.")
        if self.plots:
            plots.require()
        recording = self.read(self.recording)
        params = load_weights(self.weights)
        with bar("estimating") as progress:
            found = estimate_camera(
                recording, params, min_window_us=round(self.window_ms * 1000), progress=progress)
        found.save(self.out / "camera.npz", overwrite=self.overwrite)
        facts = {**found.as_dict(), "recording": str(self.recording), "weights": self.weights,
                 "weights_steps": model_card(self.weights).get("steps")}
        write_json(self.out / "camera.json", facts)
        if self.plots:
            plots.camera_maps(found, self.out / "maps.png")
            plots.camera_histograms(found, self.out / "histograms.png")
        print(json.dumps(facts, indent=2) if self.json else describe(found))
        print(f"written to {self.out}/", file=sys.stderr)

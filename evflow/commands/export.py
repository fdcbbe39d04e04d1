"""`evflow export`: a measured camera as settings of another simulator."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Literal

import tyro

from evflow.commands.options import warn_of_prior
from evflow.commands.writing import need_absent, need_folder


@dataclasses.dataclass(frozen=True)
class Export:
    """Export a measured camera to another simulator: its maps, the nearest settings, a script, and
    what that program cannot represent.

    Example: evflow export cam/camera.npz --to v2e -o cam/v2e
    """

    camera: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAMERA")]
    """camera.npz from evflow estimate."""
    to: Literal["v2e", "esim", "openeb", "iebcs"]
    """The simulator."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for maps.npz, README.txt and the script."""
    overwrite: bool = False
    """Replace the folder if it holds an export and nothing else."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        from evflow.camera import Camera
        from evflow.camera.exports import export_camera, write_export
        from evflow.camera.optics import read_sensor, read_summary, read_undetermined

        need_folder(self.out)
        camera, std = Camera.load_with_std(self.camera)
        need_absent(self.out, self.overwrite, self.camera)
        known = read_summary(self.camera)
        sensor, optics = read_sensor(self.camera)
        undetermined = read_undetermined(self.camera)
        export, maps = export_camera(
            camera, self.to, std, sensor, known[0] if known else None, optics, undetermined)
        write_export(self.out, export, maps, overwrite=self.overwrite)
        warn_of_prior(undetermined, "exported")
        files = [*sorted([*export.scripts, *export.arrays]), "maps.npz", "README.txt"]
        facts = {"out": str(self.out), "to": self.to, "files": files, "text": export.text}
        print(json.dumps(facts) if self.json else
              f"{export.text}\nwritten to {self.out}/: {', '.join(files)}")

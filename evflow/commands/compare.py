"""`evflow compare`: how similar two event streams, or two cameras, are."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from evflow.commands.options import Reading, note_idle, own_first, print_notes, value, write_json
from evflow.commands.packages import need_packages
from evflow.commands.writing import need_absent, need_folder
from evflow.errors import EvflowDataError

if TYPE_CHECKING:
    from evflow.camera import Camera
    from evflow.types import Events


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Compare(Reading):
    """Compare a synthetic stream with a real one by rates, pixels, intervals and noise, or two
    measured cameras (camera.npz) parameter by parameter.

    Example: evflow compare flight.aedat4 synth.h5 -o comparison/

    Example: evflow compare cam/camera.npz later/camera.npz
    """

    real: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REAL")]
    """The recorded events, in any known format. The reading options apply to both; --start and
    --stop count from its first event."""
    synthetic: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SYNTHETIC")]
    """The events to compare with them, from a sensor of the same size. Or both are cameras."""
    out: Annotated[Path | None, value("FOLDER", "-o")] = None
    """Folder for compare.json and compare.html (which needs matplotlib)."""
    plots: bool = True
    """Write compare.html."""
    overwrite: bool = False
    """Replace these files if they exist."""
    json: bool = False
    """Print all numbers as JSON."""

    def _streams(self) -> tuple[Events, Events, tuple[int, int] | None]:
        """Both streams, and the time to compare where that is not what both cover. A time range
        refers to REAL; if SYNTHETIC shares its clock the same times are used, though it may be
        silent in them, otherwise the same number of seconds from its own first event."""
        real = print_notes(self.read(self.real, with_frames=False)).events
        if (self.start is None and self.stop is None) or not len(real):
            return real, print_notes(self.read(self.synthetic, with_frames=False)).events, None
        whole = dataclasses.replace(self, start=None, stop=None)
        synthetic = print_notes(whole.read(self.synthetic, with_frames=False)).events
        span = int(real.t[0]), int(real.t[-1]) + 1
        if len(same := synthetic.slice(*span)):
            return real, same, None
        every = whole.read(self.real, with_frames=False).events
        if len(synthetic) and every.t[0] <= synthetic.t[-1] and synthetic.t[0] <= every.t[-1]:
            return real, synthetic, span
        return real, self.read(self.synthetic, with_frames=False).events, None

    def _cameras(self, *both: tuple[Camera, Camera | None]) -> None:
        """Compare two cameras."""
        from evflow.camera.optics import LOSS_WORDS, read_known, read_sensor
        from evflow.metrics.cameras import compare_cameras, verdict
        from evflow.report.cameras import describe_cameras, write_cameras

        self._check_targets()
        (a, a_std), (b, b_std) = both
        sensors = read_sensor(self.real)[0], read_sensor(self.synthetic)[0]
        numbers = compare_cameras(
            a, b, a_std, b_std, a_known=read_known(self.real), b_known=read_known(self.synthetic),
            a_by_light=sensors[0].cutoff_by_light, b_by_light=sensors[1].cutoff_by_light)
        if a.shape != b.shape:
            print(f"note: their maps are {a.shape} and {b.shape}: they are not compared pixel by "
                  "pixel.", file=sys.stderr)
        laws = [sensor.in_dead_time for sensor in sensors]
        if all(sensor.refractory_s for sensor in sensors) and laws[0] != laws[1]:
            said = [LOSS_WORDS[law] or ", contrast kept" for law in laws]
            print(f"note: dead times of two kinds: the first's{said[0]}; the second's{said[1]}. "
                  "Where light changes fast, their events differ.", file=sys.stderr)
        facts = {"a": str(self.real), "b": str(self.synthetic), "verdict": verdict(numbers),
                 **numbers}
        names = _short(self.real), _short(self.synthetic)
        if self.out and self.plots:
            write_cameras(self.out / "compare.html", (a, b), numbers, names,
                          self._compared("First camera", "Second camera"),
                          overwrite=self.overwrite)
        if self.out:  # after the page, which takes long and may be interrupted
            write_json(self.out / "compare.json", facts)
        print(json.dumps(facts, indent=2) if self.json else describe_cameras(numbers, names))
        if self.out:
            print(f"written to {self.out}/", file=sys.stderr)

    def _check_targets(self) -> None:
        """Raise EV010, EV013 before any long work."""
        for name in ("compare.json", *(["compare.html"] if self.plots else [])):
            if self.out:
                need_absent(self.out / name, self.overwrite)
        need_packages(self.real, self.synthetic, pictures=bool(self.out) and self.plots,
                      no_pictures="--no-plots")

    def _compared(self, *labels: str) -> dict[str, str]:
        """The facts that a page states: the two files, the command and the versions."""
        from evflow.process.provenance import one_line, sha256

        shown = {label: f"{path}, sha256 {sha256(path)}" for label, path in zip(
            labels, (self.real, self.synthetic), strict=True)}
        return {**shown, "Command": shlex.join(["evflow", *sys.argv[1:]]), "Versions": one_line()}

    def run(self) -> None:
        from evflow.metrics.streams import compare
        from evflow.report.alike import describe_streams, judge_streams
        from evflow.report.streams import write_comparison
        from evflow.report.verdict import worst

        if self.out:
            need_folder(self.out)
        if cameras := _cameras(self.real, self.synthetic):
            self._cameras(*cameras)
            return
        self._check_targets()
        note_idle(self, "only the events of the streams are compared")
        real, synthetic, span = self._streams()
        numbers = compare(real, synthetic, span_us=span)
        words = describe_streams(numbers)
        facts = {"real": str(self.real), "synthetic": str(self.synthetic),
                 "grade": worst(judge_streams(numbers)), "verdict": words.splitlines(), **numbers}
        if self.out and self.plots:
            write_comparison(self.out / "compare.html", real, synthetic, numbers,
                             facts=self._compared("Real stream", "Synthetic stream"),
                             labels=(self.real.name, self.synthetic.name),
                             overwrite=self.overwrite)
        if self.out:
            write_json(self.out / "compare.json", facts)
        print(json.dumps(facts, indent=2) if self.json else words)
        if self.out:
            print(f"written to {self.out}/", file=sys.stderr)


def _short(path: Path) -> str:
    """A short name for a camera: cam/camera.npz is cam."""
    return path.parent.name if path.stem == "camera" and path.parent.name else path.stem


def _cameras(*paths: Path) -> list[tuple[Camera, Camera | None]]:
    """The two cameras, or none if neither file is one. EV020 if only one of them is."""
    from evflow.camera import Camera
    from evflow.camera.file import holds_camera

    found = [holds_camera(path) for path in paths]
    if all(found):
        return [Camera.load_with_std(path) for path in paths]
    if any(found):
        camera, other = (paths[found.index(kind)] for kind in (True, False))
        if not other.exists():
            raise EvflowDataError("EV016", f"no file or folder at {other}.", where=other)
        raise EvflowDataError(
            "EV020", f"{camera} is a camera, {other} is not.",
            "Compare two cameras or two event streams. To see whether the camera fits a recording: "
            "evflow simulate RECORDING --camera camera.npz -o synth.h5, and compare the two.")
    return []

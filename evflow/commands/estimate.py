"""`evflow estimate`: measure a camera from a recording."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from evflow.commands.light import check_light
from evflow.commands.options import (
    Compiling,
    Reading,
    check_finite,
    own_first,
    print_notes,
    refuse,
    value,
    write_json,
)
from evflow.commands.packages import need_packages
from evflow.commands.writing import need_apart, need_folder
from evflow.errors import EvflowDataError, naming
from evflow.notes import as_dicts

if TYPE_CHECKING:
    from evflow.camera import Summary
    from evflow.estimation.halves import FirstPart
    from evflow.estimation.pipeline import Measured
    from evflow.estimation.result import CameraEstimate
    from evflow.notes import Note
    from evflow.recordings.check import Report
    from evflow.types import Recording

FILES = ("camera.npz", "camera.json", "report.html", *(
    f"{name}.{kind}" for name in ("maps", "histograms") for kind in ("png", "pdf", "svg")))
READ = ("effort", "budget_s", "on_interrupt")  # options on how much is read
SHORT = 100 * 346 * 260  # pixels of frames: memory does not matter in recordings this short
SAID_BELOW = ("EV011", "EV017", "EV030")  # findings that an estimate notes itself
OF_EACH = ("events.gaps", "pixels.hot", "pixels.dead")  # notes on a recording, not on the camera


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate(Compiling, Reading):
    """Measure a camera: per-pixel thresholds and noise rates, from events and frames.

    Example: evflow estimate flight.aedat4 -o cam/

    Example: evflow estimate screen.aedat4 -o bench/ --protocol step

    Example: evflow estimate dim.aedat4 bright.aedat4 -o noise/ --protocol static --lux 5 200
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """A recording with frames; without frames only the noise of a static scene can be measured."""
    more: Annotated[tuple[Path, ...], tyro.conf.Positional,
                    tyro.conf.arg(metavar="[MORE ...]")] = ()
    """With --protocol static: recordings at rest in other light, with one --lux value for each."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for camera.npz, camera.json, the pictures and report.html."""
    protocol: Literal["motion", "step", "static"] = "motion"
    """How it was recorded. motion: any moving scene; step: a screen that fills the view and steps
    between light levels (thresholds follow from the events per step); static: a scene at rest,
    where all events are noise."""
    effort: Literal["quick", "normal", "full"] = "normal"
    """How much of a long recording to read. normal: parts spread over it, until the errors stop
    shrinking or a minute's work is done (DAVIS346); quick: a third of that; full: everything."""
    budget_s: Annotated[float | None, value("SECONDS")] = None
    """Stop reading after this many seconds of work (0: read one part)."""
    on_interrupt: Literal["stop", "save"] = "stop"
    """What Ctrl-C does while the recording is read. stop: end without a result; save: measure the
    camera from what was read (a second Ctrl-C ends)."""
    lux: Annotated[tuple[float, ...], value("LUX ...")] = ()
    """Illuminance from a light meter. static: one value per recording, in the same order, for noise
    against illuminance; step: one value per level, darkest first, instead of the frames' ratios;
    without frames one per rest between the --triggers, in order of time."""
    triggers: Annotated[Path | None, value("FILE")] = None
    """With --protocol step: times of the light's edges, for latency: one per line, on the events'
    clock, or the recording itself (triggers of Prophesee RAW, AEDAT 4, or evt3 in a ROS bag)."""
    thresholds: Annotated[Path | None, value("FILE")] = None
    """With --protocol static: take the thresholds, which a scene at rest does not show, from this
    camera.npz; the result has its thresholds and the measured noise."""
    weights: str = "default"
    """Name of released weights, or a .safetensors path."""
    window_ms: float = 40.0
    """Minimum length of a window; windows run from frame to frame."""
    reconstruct: bool = False
    """For a recording without frames: reconstruct them from the events (see evflow reconstruct).
    Their contrast is a network's guess, and the thresholds are no better than that."""
    reconstruct_weights: str = "e2vid-small"
    """Weights of that network: a released name, a .safetensors path, or a published checkpoint."""
    plots: bool = True
    """Draw maps and histograms (needs matplotlib)."""
    figures: Literal["png", "pdf", "svg"] = "png"
    """Format of these figures, which fit two columns of a paper."""
    report: bool = True
    """Write report.html: the recording and its re-simulation on a held-out half, in panels (needs
    matplotlib; takes about as long as the estimate), or for a bench the results level by level."""
    simulators: bool = False
    """Also report how well the pixels of v2e, ESIM and DVS-Voltmeter, each with its own best
    constants, predict the held-out half (takes about as long as the report)."""
    checks: bool = True
    """Stop if `evflow check` finds errors."""
    overwrite: bool = False
    """Replace these files if they exist."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> None:
        from evflow.estimation import pipeline  # noqa: F401 - loaded before the modules settle
        from evflow.files.folders import staged
        from evflow.process import early
        from evflow.process.memory import keep
        from evflow.report import plots
        from evflow.report.text import describe

        self._check_options()
        moving = self.protocol == "motion"
        need_packages(self.recording, *self.more, pictures=self.plots or self.report,
                      no_pictures="--no-plots --no-report")
        early.settle()
        with staged(self.out, names=FILES, overwrite=self.overwrite) as out:
            recording, checked, doubts = self._recorded(self.recording)
            if recording.frames.size <= SHORT:
                keep()
            made, facts = self._estimated(recording) if moving else self._on_the_bench(recording)
            words = describe(made.found)  # doubts were already printed to the terminal
            found = dataclasses.replace(made.found, notes=(*doubts, *made.found.notes))
            found.save(out / "camera.npz")
            facts = {**found.as_dict(), "recording": str(self.recording),
                     "protocol": self.protocol,
                     "recording_notes": as_dicts(recording.notes), **facts}
            if self.plots:
                plots.camera_maps(found, out / f"maps.{self.figures}")
                plots.camera_histograms(found, out / f"histograms.{self.figures}")
            tested = self._report(
                out, found, recording, made.first, checked) if self.report else {}
            facts |= {key: tested[key] for key in ("grade", "verdict", "simulators", "nearest")
                      if key in tested}
            write_json(out / "camera.json", facts)
        lines = [f"verdict: {tested['grade']}", *tested["verdict"], *(
            [tested["nearest"]] if self.simulators else [])] if tested else []
        print(json.dumps(facts, indent=2) if self.json else "\n".join([words, *lines]))
        print(f"written to {self.out}/", file=sys.stderr)

    def _check_options(self) -> None:
        """Raise EV020 for options that are out of range or contradict each other."""
        check_finite(self)
        need_folder(self.out)
        need_apart((self.out / name for name in FILES), self.recording, *self.more,
                   self.thresholds, self.triggers, self.frames, self.timestamps)
        if self.budget_s is not None and self.budget_s < 0:
            raise EvflowDataError("EV020", f"--budget-s {self.budget_s:g}.", "It must be >= 0.")
        check_light(self.lux, 1 + len(self.more), self.protocol)
        if self.protocol != "motion":
            refuse(self, ("weights", "window_ms", "reconstruct", *READ),
                   "only useful with --protocol motion")
        if self.protocol != "motion" or not self.report:
            refuse(self, ("simulators",), "only useful in the report of --protocol motion")
        if not self.reconstruct:
            refuse(self, ("reconstruct_weights",), "only useful with --reconstruct")
        for name, protocol in (("thresholds", "static"), ("triggers", "step")):
            if self.protocol != protocol:
                refuse(self, (name,), f"only useful with --protocol {protocol}")

    def _recorded(self, path: Path) -> tuple[Recording, Report, list[Note]]:
        """A recording, the findings of `evflow check`, and its doubts; raises its errors."""
        from evflow.estimation.bench.rests import bench_note
        from evflow.files.spool import SOME, on_disk
        from evflow.process.terminal import bar
        from evflow.recordings.check import check
        from evflow.recordings.dense import thinned
        from evflow.recordings.repeats import without_repeats

        with bar("reading the recording") as progress:
            with on_disk(SOME):
                recording = self.read(path)
            progress(0, 1, "checking")
            report = check(recording, min_window_us=round(self.window_ms * 1000))
        print_notes(recording, beside=report)
        spared = self._spared(recording)
        if self.checks and (failed := [e for e in report.errors if e.code != spared]):
            raise failed[0].error()
        stepping = bench_note(recording) if self.protocol == "motion" else None
        beside = () if self.protocol == "motion" and not stepping else ("EV028",)
        doubts = [*([stepping] if stepping else []), *(
            finding.note() for finding in (*report.errors, *report.warnings)
            if finding.code not in (*SAID_BELOW, *beside))]
        for doubt in doubts:
            print(f"warning: {doubt}", file=sys.stderr)
        recording = without_repeats(recording) if self.protocol == "motion" else recording
        recording = self._reconstructed(recording) if self.reconstruct else recording
        recording = thinned(recording) if self.protocol == "motion" else recording
        return recording, report, doubts

    def _spared(self, recording: Recording) -> str:
        """The error that the protocol explains: frames off by a part of a rest; leak, all ON."""
        both = 0 < int(recording.events.p.sum()) < len(recording.events)
        return {"step": "EV024", "static": "EV022" if both else ""}.get(self.protocol, "")

    def _reconstructed(self, recording: Recording) -> Recording:
        """The recording with frames reconstructed from its events; EV020 if it has frames."""
        from evflow.downstream.video import with_reconstructed_frames
        from evflow.process.terminal import bar

        if recording.has_frames:
            raise EvflowDataError("EV020", f"--reconstruct, but {self.recording} has frames.",
                                  "Leave it out: real frames are better than a network's guess.")
        with bar("reconstructing") as progress:
            return with_reconstructed_frames(
                recording, self.reconstruct_weights, progress=progress)

    def _estimated(self, recording: Recording) -> tuple[Measured, dict[str, Any]]:
        from evflow.estimation.pipeline import measure
        from evflow.network.weights import load_weights, model_card, trained_steps, weights_hash
        from evflow.process.signals import stop_requests
        from evflow.process.terminal import Stages, bar
        from evflow.report.text import thresholds

        params = load_weights(self.weights)
        began = time.monotonic()
        no_requests = contextlib.nullcontext(list[int]())
        interrupts = stop_requests() if self.on_interrupt == "save" else no_requests
        with interrupts as asked, bar("estimating", compiles=True) as progress:
            stages = Stages(progress)

            def enough(summary: Summary, std: Summary) -> bool:
                stages.know(thresholds(summary, std))
                late = self.budget_s is not None and time.monotonic() - began >= self.budget_s
                return late or bool(asked)

            made = measure(
                recording, params, effort=self.effort, progress=stages.count, until=enough,
                min_window_us=round(self.window_ms * 1000), stage=stages.stage)
        if recording.frames_were_made:
            from evflow.downstream.video import doubted

            made = dataclasses.replace(made, found=doubted(made.found))
        return made, {"weights": self.weights, "weights_sha256": weights_hash(self.weights),
                       "weights_steps": trained_steps(model_card(self.weights))}

    def _on_the_bench(self, recording: Recording) -> tuple[Measured, dict[str, Any]]:
        from evflow.estimation.bench.calibration import calibrate_step
        from evflow.estimation.joined import with_thresholds
        from evflow.estimation.pipeline import Measured
        from evflow.estimation.static import estimate_noise, noise_over_light
        from evflow.io.triggers import read_triggers

        if self.protocol == "step":
            triggers = None if self.triggers is None else read_triggers(
                self.triggers, recording.events, self.events_topic)
            return Measured(calibrate_step(recording, lux=self.lux, triggers_us=triggers)), {}
        found = estimate_noise(recording, lux=self.lux[0] if self.lux else None)
        if self.more:
            others = [self._noise(*of) for of in zip(self.more, self.lux[1:], strict=True)]
            found = noise_over_light([found, *(other for other, _ in others)])
            found = dataclasses.replace(found, notes=(*found.notes, *(
                doubt for _, doubts in others for doubt in doubts)))
        facts = {"recordings": [str(p) for p in (self.recording, *self.more)]} if self.more else {}
        found = with_thresholds(found, self.thresholds) if self.thresholds else found
        return Measured(found), facts

    def _noise(self, path: Path, lux: float) -> tuple[CameraEstimate, list[Note]]:
        """The noise of a further recording, and its doubts, which name it."""
        from evflow.estimation.static import estimate_noise

        with naming(path):
            recording, _, doubts = self._recorded(path)
            found = estimate_noise(recording, lux=lux)
            doubts = [*(note for note in found.notes if note.code in OF_EACH), *doubts]
            return found, [
                dataclasses.replace(doubt, text=f"{path}: {doubt.text}") for doubt in doubts]

    def _report(
        self, out: Path, found: CameraEstimate, recording: Recording, first: FirstPart | None,
        checked: Report,
    ) -> dict[str, Any]:
        """Write report.html and return its numbers."""
        from evflow.process.terminal import Stages, bar
        from evflow.report.bench import Source, write_bench_report
        from evflow.report.camera import write_report

        command = shlex.join(["evflow", *sys.argv[1:]])
        if self.protocol != "motion":
            return write_bench_report(out / "report.html", found, recording, source=Source(
                (self.recording, *self.more), command))
        with bar("report", compiles=True) as progress:
            stages = Stages(progress)
            return write_report(
                out / "report.html", found, recording, weights=self.weights,
                source=self.recording, command=command,
                min_window_us=round(self.window_ms * 1000), first=first, checked=checked,
                progress=stages.count, stage=stages.stage, simulators=self.simulators)

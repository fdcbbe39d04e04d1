"""`evflow flow`: the optical flow of a recording."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from evflow.commands.options import check_finite, note_idle, own_first, refuse, value
from evflow.commands.windows import Windowed, frames_amid, lasting
from evflow.commands.writing import need_absent
from evflow.errors import EvflowDataError
from evflow.notes import Note, as_dicts

if TYPE_CHECKING:
    from evflow.downstream.flow import FlowTruth
    from evflow.types import Recording


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Flow(Windowed):
    """Show the optical flow, by EV-FlowNet: hue for direction, saturation for speed, at pixels with
    events; and measure how much it sharpens them (FWL: above 1 is better than no flow).

    Example: evflow flow flight.aedat4 -o flow.mp4
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """File or folder in any known format."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """.mp4, .avi or .gif."""
    weights: str = "evflownet-small"
    """Name of released weights, a .safetensors path, or a published checkpoint (.pth.tar)."""
    truth: Annotated[Path | None, value("FILE")] = None
    """True flow, .npz: flow (T, 2, H, W) = (x, y) px over each window, edges_us (T + 1,) of the
    windows, which replace --sync, and valid (T, H, W) if not all of it is."""
    full_px: Annotated[float | None, value("PX")] = None
    """Motion per window that is shown in full colour; by default 1 % of the pixels exceed it."""

    def run(self) -> None:
        from evflow.downstream.flow import FlowScores, flow_of, full_motion, window_flows
        from evflow.downstream.released import load_network
        from evflow.process.terminal import bar

        check_finite(self)
        self._check()
        trained = flow_of(load_network(self.weights))
        recording, edges, truth = self._read()
        full_px = full_motion(trained, recording.events, edges) if self.full_px is None else (
            self.full_px)
        scores = FlowScores(recording.events, edges, truth)
        with bar("flow") as progress:
            flows = window_flows(trained, recording.events, edges)
            described = self._film(_watched(flows, scores, len(edges) - 1, progress), recording,
                                   edges, full_px)
        result = scores.result()
        notes = list(recording.notes)
        if truth is not None and result.get("aee") is None:
            notes.append(Note("truth.none", f"{self.truth} has no known flow at any pixel with "
                              "events: nothing was measured against it"))
        facts = {"out": str(self.out), "weights": self.weights, "weights_sha256": trained.sha256,
                 "full_px": full_px,
                 "scores": result, "notes": as_dicts(notes)}
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
        print(json.dumps(facts) if self.json else "\n".join(
            (f"{described}, full colour at {full_px:.1f} px a window -> {self.out}",
             *_described(result))))

    def _check(self) -> None:
        """Raise EV013, EV020 before any long work."""
        from evflow.report.video import SUFFIXES

        self.check_film()
        kind = self.out.suffix.lower()
        if kind not in SUFFIXES:
            raise EvflowDataError("EV020", f"{self.out.name} does not end in "
                                           f"{', '.join(SUFFIXES)}.",
                                  "The extension selects the format.")
        if kind != ".mp4":
            refuse(self, ("codec",), f"does not apply to a {kind}")
        if self.truth is not None:
            refuse(self, ("sync", "window_events", "window_ms"), "--truth defines the windows")
        if self.full_px is not None and self.full_px <= 0:
            raise EvflowDataError("EV020", f"--full-px {self.full_px}.", "It must be > 0.")
        need_absent(self.out, self.overwrite, self.recording, self.frames,
                    self.timestamps, self.truth)

    def _read(self) -> tuple[Recording, np.ndarray, FlowTruth | None]:
        """The recording, the edges (T + 1,) of the windows, and the true flow, if given."""
        from evflow.downstream.flow import load_truth
        from evflow.downstream.sync import window_edges

        seen = self.sync in ("auto", "frames") and self.truth is None
        if not seen:
            note_idle(self, "frames are not used")
        recording = self.read(self.recording, with_frames=seen)
        if self.truth is not None:
            truth = load_truth(self.truth, recording.events.size)
            _require_overlap(recording, truth.edges_us, self.truth)
            return recording, truth.edges_us, truth
        times = self.times(recording)
        if times is recording.frame_times:
            frames_amid(recording, times)
        return recording, window_edges(recording, times), None

    def _film(
        self, flows: Iterator[np.ndarray], recording: Recording, edges: np.ndarray, full_px: float
    ) -> str:
        from evflow.report.caption import captioned
        from evflow.report.flow import flow_image
        from evflow.report.page import short
        from evflow.report.video import enlarged, write_video

        def pictures() -> Iterator[np.ndarray]:
            for i, flow in enumerate(flows):
                events = recording.events.slice(int(edges[i]), int(edges[i + 1]))
                picture = enlarged(flow_image(flow, events, full_px), self.scale)
                at_s = (int(edges[i]) + int(edges[i + 1])) / 2e6 - int(recording.events.t[0]) / 1e6
                window_ms = (int(edges[i + 1]) - int(edges[i])) / 1e3
                yield captioned(picture, f"{at_s:.3f} s   {short(window_ms)} ms   full colour: "
                                f"{full_px:.1f} px")

        count = len(edges) - 1
        fps = lasting(count, int(edges[-1] - edges[0])) if self.fps is None else self.fps
        return write_video(self.out, pictures(), count, fps=fps, codec=self.codec,
                           overwrite=self.overwrite)


def _require_overlap(recording: Recording, edges: np.ndarray, truth: Path) -> None:
    """Raise EV012 unless an event lies within the windows of the true flow."""
    t = recording.events.t
    if not len(recording.events.slice(int(edges[0]), int(edges[-1]))):
        covered = f"events cover {t[0]:,}..{t[-1]:,} us" if len(t) else "there are no events"
        raise EvflowDataError(
            "EV012", f"{covered}, but the windows of {truth} {edges[0]:,}..{edges[-1]:,} us.",
            "edges_us are microseconds of the events' clock: is it another clock, or another unit?")


def _watched(
    flows: Iterator[np.ndarray], scores: Any, count: int, progress: Any
) -> Iterator[np.ndarray]:
    """The flows as they pass, each one scored."""
    for i, flow in enumerate(flows):
        scores.add(flow)
        yield flow
        progress(i + 1, count)


def _described(result: dict[str, Any]) -> list[str]:
    """The scores as a line of text."""
    names = {"fwl": "FWL", "rsat": "RSAT", "aee": "AEE [px]", "outlier_percent": "outliers [%]",
             "fwl_truth": "FWL of the truth"}
    numbers = [f"{label} {result[name]:.3f}" for name, label in names.items()
               if result.get(name) is not None]
    if not numbers:
        return []
    how = ", ".join(f"{k} {v}" for k, v in result["convention"].items())
    return [f"{', '.join(numbers)} over {result['windows']} windows of "
            f"{result['window_ms']:.1f} ms and {result['events_per_window']:.0f} events ({how})"]

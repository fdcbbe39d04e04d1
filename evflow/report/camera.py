"""The report on an estimated camera: panels in one HTML file, as evidence for the estimate.

The recording's own frames are simulated with the estimate and compared with the recorded events; an
estimate from the first half is tested on the second. Panels that cannot be shown say why.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.estimation.finish import Stage
from evflow.estimation.halves import FirstPart
from evflow.estimation.pipeline import Progress
from evflow.estimation.refine.frame_exposure import with_exposure
from evflow.estimation.result import CameraEstimate
from evflow.network.weights import load_weights, weights_hash
from evflow.notes import texts
from evflow.process.provenance import one_line, sha256
from evflow.recordings.check import Report, check
from evflow.recordings.check.steps import frame_steps
from evflow.report import page
from evflow.report.extent import extent_panel
from evflow.report.held import NAMES, held_panel
from evflow.report.maps import fault_panel, map_panel, scatter_panel
from evflow.report.page import Panel, bullets, paragraph, plural, spread, table
from evflow.report.plots import require
from evflow.report.receptor import receptor_panel
from evflow.report.resimulate import (
    PIXELS,
    SECONDS,
    Pictures,
    Trial,
    busiest,
    held_out,
    resimulate,
    usable_runs,
)
from evflow.report.streams import count_panel, image_panel, rate_panel, time_panel, verdict_rows
from evflow.report.verdict import (
    HEADLINES,
    RULE,
    Judged,
    advice,
    judge_estimate,
    known,
    overall,
    poorer,
    sentences,
)
from evflow.types import Recording

STAGES = 4


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """trial: the estimate, re-simulated; half: the estimate from the first half; held: its test on
    the second half, and what it explains there. If one is None, the reason is in why_not or
    why_not_held."""

    trial: Trial | None
    half: CameraEstimate | None
    held: Trial | None
    why_not: str = ""
    why_not_held: str = ""
    held_out_shares: tuple[float, float] | None = None


def write_report(
    path: str | os.PathLike, found: CameraEstimate, recording: Recording, *,
    weights: str | os.PathLike = "default", source: str | os.PathLike | None = None,
    command: str = "", min_window_us: int = 40_000, seed: int = 0, overwrite: bool = False,
    progress: Progress | None = None, simulators: bool = False, first: FirstPart | None = None,
    checked: Report | None = None, stage: Stage = lambda _: None,
) -> dict[str, Any]:
    """Write a self-contained HTML report on an estimated camera, and return its numbers.

    The camera is tested: the recording's own frames are simulated with it (at most 3 s, the
    busiest) and compared with what was recorded, and an estimate from the first half is tested on
    the second.

    Args:
        path: of the HTML file.
        found: of `estimate_camera(recording)`.
        recording: the one the camera was estimated from.
        weights: those it was estimated with, for the held-out half; as in `load_weights`.
        source: file or folder of the recording, whose name and sha256 are shown.
        command: the command line, shown.
        min_window_us: as given to `estimate_camera`, integer microseconds.
        seed: of the re-simulations.
        overwrite: replace a file that exists.
        progress: progress(done, total) is called after each stage.
        simulators: also test the pixels of v2e, ESIM and DVS-Voltmeter, each with its own best
            constants from the first half, on the second; takes about as long as the rest.
        first: what the estimate computed from the first half (`measure`); None computes it again,
            from at most its last 5 s.
        checked: from `check(recording)`; None checks again.
        stage: stage(name) is called when one begins.

    Returns:
        JSON-ready numbers, also stored in the page: "grade" ("good", "fair", "poor"), "verdict"
        (what was seen and what to do, one sentence each), "trial" and "held_out" (each None, or the
        result of `compare`, with the "ceiling" of its correlations); "simulators" if they were
        tested, the nearest first, and "nearest", a sentence on them.

    Raises:
        EvflowDataError: EV010 (matplotlib is missing), EV013 (exists), EV015 (a recording of
            another size than the estimate), EV016 (no such weights), EV019 (cannot be written).
    """
    require()
    if (size := found.n_events.shape[::-1]) != recording.events.size:
        raise EvflowDataError(
            "EV015", f"the estimate is of {size} pixels, the recording of {recording.events.size}.",
            "Pass the recording that the camera was estimated from.")
    recording = with_exposure(recording, found.optics.exposure_s)
    done = itertools.count(1)

    def step() -> None:
        (progress or (lambda *_: None))(next(done), STAGES)

    evidence = gather(found, recording, weights, min_window_us, seed, step, first, stage)
    stage("drawing")
    judged = judge_estimate(found, evidence.trial, evidence.held)
    panels = [_verdict(found, evidence, judged), map_panel(found), scatter_panel(found),
              *_trial_panels(recording, evidence), receptor_panel(found, evidence.held_out_shares),
              fault_panel(found), extent_panel(found),
              held_panel(found, evidence.half, evidence.held, evidence.why_not_held),
              _assumptions(
                  found, recording, checked or check(recording), weights, source, command)]
    rivals: dict[str, Any] = {}
    if simulators:
        from evflow.report import simulators as others

        stage("other simulators")
        tried, why_not = others.try_simulators(recording, evidence.half, evidence.held, seed)
        why_not = why_not or evidence.why_not_held
        panels.insert(-1, others.simulators_panel(tried, why_not))
        rivals = {"simulators": others.as_dicts(tried), "nearest": others.verdict(tried, why_not)}
    step()
    numbers = {"grade": overall(judged, tested=evidence.trial is not None),
               "verdict": sentences(judged), "trial": _numbers(evidence.trial),
               "held_out": _numbers(evidence.held), **rivals}
    name = Path(source).name if source else "an event camera"
    page.write_page(path, f"Camera report: {name}", repr(recording), panels, numbers,
                    overwrite=overwrite)
    step()
    return numbers


def gather(
    found: CameraEstimate, recording: Recording, weights: str | os.PathLike, min_window_us: int,
    seed: int, step: Callable[[], None], first: FirstPart | None = None,
    stage: Stage = lambda _: None,
) -> Evidence:
    """Put the estimate to the test; step() is called twice."""
    stage("re-simulating")
    trial = half = held = shares = None
    why = why_held = ""
    try:
        if not (known(found, "on") and known(found, "off")):
            raise EvflowDataError("EV017", "the thresholds are undetermined.")
        runs, pictures = usable_runs(recording), Pictures(recording)
        trial = resimulate(recording, found, busiest(recording, runs), seed, pictures)
    except EvflowDataError as error:
        why = why_held = error.seen
    step()
    if trial:
        try:
            stage("the held-out half")
            params = load_weights(weights) if first is None else None
            half, held, shares = held_out(
                recording, params, runs, min_window_us, seed, first, pictures)
        except EvflowDataError as error:
            why_held = error.seen
    step()
    return Evidence(trial, half, held, why, why_held, shares)


def _numbers(trial: Trial | None) -> dict[str, Any] | None:
    return {**trial.numbers, "ceiling": trial.ceiling} if trial else None


def _verdict(found: CameraEstimate, evidence: Evidence, judged: list[Judged]) -> Panel:
    grade = overall(judged, tested=evidence.trial is not None)
    if evidence.trial:
        worse = poorer(judged)
        gravest = max((j for j in judged if j.about == worse), key=lambda j: j.badness)
        headline, tail = HEADLINES[grade], f"The poorer polarity is {worse}. " + (
            f"Main reason: {gravest.seen}" if gravest.grade != "good" else "")
    else:
        headline = ("Measured, but not tested." if known(found, "on")
                    and known(found, "off") else "Not all of the camera is known.")
        tail = f"The estimate could not be tested: {evidence.why_not}"
    body = (f'<div class="verdict {grade}"><strong class="grade">{headline}</strong>'
            f"{paragraph(f'{_measured(found)} {tail}')}</div>" + verdict_rows(judged)
            + "<h3>What to do</h3>" + bullets(advice(judged) or [
                "Nothing: simulate with it (evflow simulate VIDEO --camera camera.npz -o "
                "synth.h5)." if evidence.trial else "Record with frames in order to test it."]))
    return Panel("verdict", "Verdict", body + paragraph(RULE, "note"))


def _measured(found: CameraEstimate) -> str:
    """The camera's summary in a sentence."""
    def value(name: str) -> str:
        return spread(*(float(getattr(s, name)) for s in (found.summary, found.summary_std)))

    theta = [f"θ {side.upper()} {value(f'theta_{side}')}" for side in ("on", "off")
             if known(found, side)]
    eta = [f"η {side.upper()} {value(f'eta_{side}')}" for side in ("on", "off")]
    where = f"in {plural(found.windows, 'window')}" if found.windows else "of a static scene"
    thresholds = f"{' and '.join(theta)} (natural log), " if theta else ""
    return (f"From {int(found.n_events.sum()):,} events {where}: {thresholds}"
            f"{' and '.join(eta)} Hz per pixel.")


def _trial_panels(recording: Recording, evidence: Evidence) -> list[Panel]:
    """The four panels that compare the re-simulation with the recording."""
    trial = evidence.trial
    if trial is None:
        return [Panel(name, title, paragraph(f"Absent: {evidence.why_not}", "note"))
                for name, title in (("rates", "Event rate over time"), ("images", "The same 30 ms"),
                                    ("counts", "Events per pixel"),
                                    ("intervals", "Intervals between events"))]
    middle = trial.instant_us + 15_000
    index = int(np.argmin(np.abs(recording.frame_times - middle)))
    return [rate_panel(trial.numbers, NAMES, paragraph(_stretch(recording, trial))),
            image_panel(trial.real, trial.made, trial.instant_us, trial.span_us[0], NAMES,
                        recording.frame_dn(index)),
            count_panel(trial.real, trial.made, trial.numbers, NAMES, trial.ceiling),
            time_panel(trial.numbers, NAMES)]


def _stretch(recording: Recording, trial: Trial) -> str:
    """Which part of the recording was simulated, and how."""
    zero = int(recording.events.t[0])
    t0, t1 = (int(recording.frame_times[i]) for i in trial.frames)
    words = (f"The recording's frames {trial.frames[0]} to {trial.frames[1]} "
             f"({(t0 - zero) / 1e6:z.3f} to {(t1 - zero) / 1e6:z.3f} s after its first event), "
             "interpolated by optical flow to half a pixel of motion, seen by the estimated "
             "camera. ")
    if trial.span_us[0] > t0:
        words += (f"The first {(trial.span_us[0] - t0) / 1e3:.0f} ms are left out: there the "
                  "simulation still depends on its first frame. ")
    return words + f"At most {SECONDS:g} s, the busiest, are simulated. " + " ".join(
        text[0].upper() + text[1:] for text in texts(trial.notes))


def _assumptions(
    found: CameraEstimate, recording: Recording, report: Report, weights: str | os.PathLike,
    source: str | os.PathLike | None, command: str,
) -> Panel:
    events = recording.events
    facts = {
        "Units": "θ in natural-log units of brightness; η in Hz per pixel and polarity, at the "
                 "recording's mean intensity; times in microseconds.",
        "Polarity": f"ON = brighter; {events.p.mean():.1%} of the events are ON." + _agreement(
            recording),
        "Alignment": "Frames and events on one clock; frame times taken as mid-exposure.",
        "Response": f"Frames taken as linear in light, {recording.frames.dtype} with white at "
                    f"{recording.full_scale}; logarithm " + (
                        "in dim light too, as in ESIM." if found.sensor.log_map == "log_eps"
                        else "as in v2e, linear below 20 of 255."),
        "Read": " ".join(
            f"{text[0].upper()}{text[1:].rstrip('.')}." for text in texts(recording.notes)) or "–",
        "Re-simulation": f"At most {SECONDS:g} s and {PIXELS / 1e6:.0f} million pixels of frames; "
                         "noise resets a pixel's memory; two keys.",
        "Weights": f"{weights}, sha256 {weights_hash(weights)}",
        "Recording": f"{source}, sha256 {sha256(source)}" if source else "given from Python",
        "Command": command or "–",
        "Versions": one_line()}
    if not recording.has_frames:
        facts["Alignment"] = facts["Response"] = "No frames."
    coded = {"Weights", "Recording", "Command"}
    rows = [[page.text(k), f"<code>{page.text(v)}</code>" if k in coded else page.text(v)]
            for k, v in facts.items()]
    sentences = texts((*found.notes, *(finding.note() for finding in report.findings)))
    return Panel("assumptions", "What was assumed, and where it comes from",
                 table(["", ""], rows, numeric=False) + "<h3>Warnings</h3>"
                 + (bullets(sentences) if sentences else paragraph("None.", "note")))


def _agreement(recording: Recording) -> str:
    """How the events' polarity agrees with the frames."""
    steps = frame_steps(recording, {})
    r = steps.correlation() if steps else float("nan")
    return (f" ON minus OFF correlates with the frames' change of brightness, r = {r:+.2f}."
            if np.isfinite(r) else "")

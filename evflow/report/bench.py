"""The report on a camera measured on a bench: a page to hand to a colleague.

Thresholds in log units and in percent of contrast with their errors, maps and histograms, S-curves,
what each step sent, noise and speed against light.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from evflow.estimation.bench.levels import Bench, cutoff_hz
from evflow.estimation.result import CameraEstimate
from evflow.notes import texts
from evflow.process.provenance import one_line, sha256
from evflow.report import bench_figures, page
from evflow.report.maps import fault_panel, map_panel, scatter_panel
from evflow.report.page import (
    Panel,
    bullets,
    figure,
    grid,
    number,
    paragraph,
    plural,
    spread,
    table,
)
from evflow.report.plots import require
from evflow.report.verdict import ERROR, GRADES, HOT, Grade, graded, known
from evflow.types import Recording

UNITS = {"DN": "DN", "lux": "lux", "light": ""}
BOUNDS = (f"Good (green): thresholds known to {ERROR[0]:.0%}, and no note that impairs them. "
          f"Poor (red): errors above {ERROR[1]:.0%}, or light that is not constant between steps.")
GRAVE: dict[str, Grade] = {"scene.restless": "poor", "pixels.unsure": "fair", "levels.few": "fair",
                          "levels.dark": "fair", "levels.black": "fair", "steps.slow": "poor",
                          "steps.fast": "fair", "steps.small": "fair"}
FEW_NOISE = 100  # noise events of a polarity: with fewer, the rate's error exceeds a tenth


@dataclasses.dataclass(frozen=True)
class Source:
    """Where an estimate comes from. recordings: its files; command: the command line."""

    recordings: tuple[Path, ...] = ()
    command: str = ""


def write_bench_report(
    path: str | os.PathLike, found: CameraEstimate, recording: Recording, *,
    source: Source = Source(), overwrite: bool = False,
) -> dict[str, Any]:
    """Write a self-contained HTML report on a camera measured on a bench.

    Args:
        path: of the HTML file.
        found: from `calibrate_step` or `estimate_noise`.
        recording: the one it was measured from (the first, if there are several).
        source: files and command line, which are shown.
        overwrite: replace a file that exists.

    Returns:
        JSON-ready: "grade" ("good", "fair", "poor") and "verdict", sentences.

    Raises:
        EvflowDataError: EV010 (matplotlib is missing), EV013 (exists), EV019 (cannot be written).
    """
    require()
    grade, sentences = verdict(found)
    panels = [_summary(found, grade, sentences), map_panel(found)]
    if thetas := _thetas(found):
        panels.append(_contrast(found, thetas))
    if found.bench:
        panels += _by_light(found, found.bench, thetas)
    panels += [scatter_panel(found), fault_panel(found), _facts(recording, source)]
    name = source.recordings[0].name if source.recordings else "an event camera"
    numbers = {"grade": grade, "verdict": sentences}
    page.write_page(path, f"Camera on a bench: {name}", repr(recording), panels,
                    {**numbers, **found.as_dict()}, overwrite=overwrite)
    return numbers


def verdict(found: CameraEstimate) -> tuple[Grade, list[str]]:
    """How good the measurement is, and sentences that say why."""
    grades: list[Grade] = ["good"]
    sentences = []
    for side in ("on", "off"):
        name = side.upper()
        theta, error, eta, eta_error = (float(getattr(s, n)) for n in (
            f"theta_{side}", f"eta_{side}") for s in (found.summary, found.summary_std))
        if known(found, side):
            grades.append(graded(error / theta, ERROR))
            sentences.append(f"θ {name} is known to {error / theta:.1%}.")
        elif found.windows:
            grades.append("poor")
            sentences.append(f"θ {name} is undetermined: no step sends {name} events.")
        if not found.windows:
            few = eta < eta_error * np.sqrt(FEW_NOISE)
            grades.append("fair" if few else "good")
            sentences.append(f"Few {name} noise events: their rate is known to "
                        f"{number(eta_error, 2)} Hz per pixel. Record longer to reduce this error."
                        if few else f"η {name} is known to {eta_error / eta:.1%}.")
    grades += [GRAVE[note.code] for note in found.notes if note.code in GRAVE]
    if found.hot.mean() > HOT:
        grades.append("fair")
        sentences.append(f"{found.hot.mean():.1%} of the pixels are hot.")
    return max(grades, key=GRADES.index), sentences


def _summary(found: CameraEstimate, grade: Grade, sentences: list[str]) -> Panel:
    heads = {"good": "Measured well.", "fair": "Measured, with room for improvement.",
             "poor": "Not measured well enough."}
    body = (f'<div class="verdict {grade}"><strong class="grade">{heads[grade]}</strong>'
            f"{paragraph(' '.join([_from(found), *sentences]))}</div>")
    rows = []
    for side in ("on", "off"):
        name = side.upper()
        if known(found, side):
            theta, error, sigma, sigma_error = (float(getattr(s, n)) for n in (
                f"theta_{side}", f"sigma_{side}") for s in (found.summary, found.summary_std))
            slope = 100.0 * np.exp(theta)  # percent per log unit
            rows += [[f"threshold {name}", spread(theta, error) + " log units",
                      spread(bench_figures.contrast(theta), slope * error) + " %"],
                     [f"mismatch {name} (standard deviation over pixels)", spread(
                         sigma, sigma_error), spread(slope * sigma, slope * sigma_error) + " %"]]
        else:
            rows.append([f"threshold {name}", "not measured", "–"])
    rows += [[f"noise {side.upper()}", spread(*(float(getattr(s, f"eta_{side}")) for s in (
        found.summary, found.summary_std))) + " Hz per pixel", ""] for side in ("on", "off")]
    if found.sensor.leak_hz:
        rows.append(["leak, a part of the noise ON", spread(
            found.sensor.leak_hz, found.sensor_std["leak_hz"]) + " Hz per pixel", ""])
    if found.sensor.shot_hz:
        rows.append(["shot noise in the dark, ON and OFF", spread(
            found.sensor.shot_hz, found.sensor_std["shot_hz"]) + " Hz per pixel", ""])
    if found.bench and found.bench.dead.measured:
        rows.append(["dead time", spread(1e3 * found.bench.dead.seconds,
                                         1e3 * found.bench.dead.std_s) + " ms", ""])
    notes = texts(found.notes)
    return Panel("summary", "What was measured", body + table(["", "value", "contrast"], rows)
                 + (f"<h3>Notes</h3>{bullets(notes)}" if notes else "")
                 + paragraph("Contrast in percent is 100 · (exp(θ) − 1): by how much the brighter "
                             f"light exceeds the darker. {BOUNDS}", "note"))


def _from(found: CameraEstimate) -> str:
    """What the measurement is based on."""
    bench = found.bench
    seconds = sum(level.seconds for level in bench.levels) if bench else 0.0
    events = f"{int(found.n_events.sum()):,} events"
    if found.windows and bench:
        return (f"From {events} of {plural(found.windows, 'step')} between "
                f"{plural(len(bench.levels), 'level')} of light, and {seconds:.1f} s at rest; "
                f"{found.valid.mean():.0%} of the pixels were measured individually.")
    if bench and len(bench.levels) > 1:
        return (f"Noise at {len(bench.levels)} illuminances, {seconds:.1f} s in all; maps and "
                f"numbers here are those of the first recording ({events}).")
    return f"From {events} of a static scene{f', {seconds:.1f} s' if bench else ''}."


def _thetas(found: CameraEstimate) -> bench_figures.Sides:
    """Thresholds of the pixels that were measured individually."""
    used = _used(found)
    return {side: np.asarray(getattr(found.camera, f"theta_{side}"))[used]
            for side in ("on", "off") if known(found, side) and used.any()}


def _used(found: CameraEstimate) -> np.ndarray:
    """(H, W) bool: pixels that were measured individually; if none was, all but hot ones."""
    return found.valid if found.valid.any() else ~found.hot


def _contrast(found: CameraEstimate, thetas: bench_figures.Sides) -> Panel:
    drawn = [figure(page.drawing(bench_figures.distribution(thetas), "thresholds in percent"),
                    "Distribution of the pixels' estimates, widened by their errors: humps no "
                    "further apart than these errors come from counting whole events, not from "
                    "kinds of pixels."),
             figure(page.drawing(bench_figures.s_curve(thetas), "S-curves"),
                    "Share of pixels whose threshold a change of light exceeds; dashed: "
                    "half of them.")]
    rows = [[side.upper(), *(number(float(bench_figures.contrast(np.quantile(theta, q))), 3)
                             for q in (0.1, 0.5, 0.9)),
             number(float(np.median(np.asarray(getattr(found.std, f"theta_{side}"))[_used(found)]
                                    * np.exp(theta))) * 100, 2)]
            for side, theta in thetas.items()]
    return Panel("contrast", "Contrast thresholds and S-curves", grid(drawn, 22) + table(
        ["contrast in %", "a tenth of the pixels respond", "half", "nine tenths",
         "error of a pixel"], rows))


def _by_light(found: CameraEstimate, bench: Bench, thetas: bench_figures.Sides) -> list[Panel]:
    """Panels on what depends on the light and on the steps."""
    panels = []
    if bench.steps:
        ups = sum(step.change > 0 for step in bench.steps)
        panels.append(Panel("steps", "What each step sent", grid([figure(
            page.drawing(bench_figures.steps(bench.steps, thetas), "events over size of a step"),
            "Each point is a step, averaged over the pixels. Dashed: size over threshold. A step "
            "that follows one in the other direction sends up to one event less, because the "
            "pixel's memory must first return.")], 26) + paragraph(
                f"{plural(ups, 'step')} up, {len(bench.steps) - ups} down.", "note")))
    several = len(bench.levels) > 1
    unit = f" [{UNITS[bench.unit]}]" if UNITS[bench.unit] else ""
    rows = [[number(v.light), plural(v.rests, "time"), number(v.seconds),
             spread(v.eta_on, v.eta_on_std), spread(v.eta_off, v.eta_off_std)]
            for v in bench.levels]
    drawn = ([figure(page.drawing(bench_figures.noise(bench), "noise over light"),
                     "Means over the pixels that are not hot, with their standard deviations.")]
             if several else [])
    panels.append(Panel("noise", "Noise against light" if several else "Noise", grid(drawn, 26)
                        + table([f"light{unit}", "seen", "seconds", "ON [Hz per pixel]",
                                 "OFF [Hz per pixel]"], rows)))
    lasting = [v for level in bench.levels for v in (level.up_s, level.down_s) if v is not None]
    if lasting:
        panels.append(_speed(bench, unit))
    if bench.latency:
        panels.append(_latency(bench, unit))
    return panels


def _latency(bench: Bench, unit: str) -> Panel:
    rows = [[number(v.light), f"{bench_figures.contrast(v.change):+.0f}", str(v.steps),
             number(1e3 * v.seconds) if v.std_s is None else spread(1e3 * v.seconds, 1e3 * v.std_s),
             number(1e3 * v.jitter_s), f"{v.responded:.0%}"] for v in bench.latency]
    return Panel("latency", "Latency against contrast and light", grid([figure(
        page.drawing(bench_figures.latency(bench), "latency over size of a step"),
        "Bars: jitter. Darker colours: steps to brighter light.")], 26) + table(
            [f"to light{unit}", "change [%]", "steps", "latency [ms]", "jitter [ms]",
             "pixels that answer"], rows) + paragraph(
            "From a step's trigger to a pixel's first event in its direction: median over pixels "
            "and repetitions, with the error that follows from their spread; jitter is half the "
            "width of the central 68 %. It includes the light's own edge and the remaining "
            "distance to the pixel's threshold, which is larger after a step in the other "
            "direction.", "note"))


def _speed(bench: Bench, unit: str) -> Panel:
    def cells(seconds: float | None) -> list[str]:
        return ["–", "–"] if seconds is None else [
            number(1e3 * seconds), f"{cutoff_hz(max(seconds, 1e-6)):.0f}"]

    rows = [[number(v.light), *cells(v.up_s), *cells(v.down_s)] for v in bench.levels]
    seen = "" if bench.latency else (
        " Latency needs the instants of the edges: --triggers.")
    return Panel("speed", "Speed against light", grid([figure(
        page.drawing(bench_figures.speed(bench), "duration of steps over light"))], 26) + table(
            [f"light{unit}", "up to it [ms]", "cutoff at least [Hz]", "down to it [ms]",
             "cutoff at least [Hz]"], rows) + paragraph(
            "Time from half to nine tenths of a step, from its events, for steps of at least three "
            "thresholds; it includes the light's own edge, so the pixels are at least as fast. The "
            "cutoff is that of a first-order low-pass of the same duration. "
            f"{_dead_time(bench)}{seen}", "note"))


def _dead_time(bench: Bench) -> str:
    if bench.dead.measured:
        dead_ms = spread(1e3 * bench.dead.seconds, 1e3 * bench.dead.std_s)
        return f"Dead time of a pixel: {dead_ms} ms."
    if bench.dead.below_s > 0:
        return (f"The dead time of a pixel is at most {number(1e3 * bench.dead.below_s)} ms: these "
                "shortest intervals differ between sizes or directions of steps, or are known for "
                "too few of them, so that they may be those of the light's own edge.")
    return "No dead time is visible: no step makes enough pixels fire as fast as they can."


def _facts(recording: Recording, source: Source) -> Panel:
    facts = {
        "Units": "θ in natural-log units of light; η in Hz per pixel and polarity.",
        "Polarity": f"ON = brighter; {recording.events.p.mean():.1%} of the events are ON.",
        "Read": " ".join(f"{t[0].upper()}{t[1:].rstrip('.')}." for t in texts(recording.notes))
                or "–",
        "Recording": "; ".join(f"{p}, sha256 {sha256(p)}" for p in source.recordings)
                     or "given from Python",
        "Command": source.command or "–", "Versions": one_line()}
    coded = {"Recording", "Command"}
    rows = [[page.text(k), f"<code>{page.text(v)}</code>" if k in coded else page.text(v)]
            for k, v in facts.items()]
    return Panel("assumptions", "What was assumed, and where it comes from",
                 table(["", ""], rows, numeric=False))

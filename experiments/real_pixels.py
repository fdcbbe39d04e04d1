"""Thresholds of cameras whose pixels are slow and whose frames are no measurement of light.

    python -m experiments.real_pixels --preset full --rows rows.json --recordings-at flight.aedat4

Hidden cameras, one condition a row: the relative error of theta, how often its 68 and 95 %
intervals hold the truth; of the first ten of a row also with `estimate_camera(pixel="ideal")`,
which takes pixels for ideal. Then what else was measured: cutoff, dead time, leak, shot noise,
light added, and noise rates over pixels, where a condition has them. Then real recordings: the
share of variance that the pooled regression of one half explains of the other, with an ideal pixel
and with that of the first half. The first camera of all rows is measured before the second of any,
so that an interrupted run (--rows) can be ended with fewer (--recordings). Writes real_pixels.json,
.md and .png. The paper knows ideal pixels alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evflow import CameraEstimate, estimate_camera, read_recording
from evflow.camera.optics import MEASURED
from evflow.estimation.refine import frame_noise, plan_runs, receptor_sample
from evflow.estimation.refine.receptor_search import explained, find
from evflow.network.weights import weights_hash
from evflow.recordings.windows import plan_windows
from evflow.simulator.photoreceptor import IDEAL
from experiments.shared import pages
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.common import StudyOptions, begin, conclude, markdown, run_script
from experiments.shared.kept import Row, resumed
from experiments.shared.many import Setup, made
from experiments.shared.real_cameras import BASE, CHANGES, added_light, shot_rates

FEW = ("ideal", "cutoff 30.0 Hz", "black level +16 DN")
BESIDE = 10  # cameras of a row that are also taken for ideal
LABELS = {"cutoff_hz": "cutoff [Hz]", "refractory_s": "dead time [s]", "leak_hz": "leak [Hz]",
          "shot_hz": "shot noise [Hz]"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Measure cameras that are not ideal."""

    out: Path = Path("out/real_pixels")
    seed: int = 9_000_011
    recordings: int | None = None
    """Cameras a condition (default: the preset's)."""
    recordings_at: tuple[Path, ...] = ()
    """Real recordings with frames."""
    rows: Path | None = None
    """Where to keep the rows, to resume an interrupted run from."""


def thresholds(found: CameraEstimate, truth: np.ndarray) -> Row:
    """Relative errors of theta_on and theta_off, and their stds."""
    theta, std = ([float(s.theta_on), float(s.theta_off)]
                  for s in (found.summary, found.summary_std))
    return {"error": (theta / truth - 1).tolist(), "std": (std / truth).tolist()}


def score(params: Any, hidden: Hidden, protocol: Protocol) -> Row:
    """What was measured of a camera, and what is true."""
    truth = np.array([float(hidden.nominal.theta_on), float(hidden.nominal.theta_off)])
    found = estimate_camera(hidden.recording, params)
    sensor, optics = found.sensor, found.optics
    row: Row = {
        "measured": thresholds(found, truth),
        "sensor": {name: [getattr(sensor, name), told(found.sensor_std.get(name)),
                          getattr(protocol.model, name)] for name in MEASURED},
        "light": [optics.offset_dn, told(optics.offset_dn_std), added_light(protocol)]}
    if protocol.model.shot_hz:
        maps = np.stack([found.camera.eta_on, found.camera.eta_off])
        sides = maps, shot_rates(hidden, protocol)
        row["noise"] = [[[float(of(m)) for m in both] for both in sides]
                        for of in (np.mean, np.median)]
    return row


def told(value: float | None) -> float | None:
    """None for NaN, which JSON does not know."""
    return value if value is not None and np.isfinite(value) else None


def score_both(params: Any, hidden: Hidden, protocol: Protocol) -> Row:
    """The same, beside the estimate that takes pixels for ideal."""
    truth = np.array([float(hidden.nominal.theta_on), float(hidden.nominal.theta_off)])
    ideal = estimate_camera(hidden.recording, params, pixel="ideal")
    return {**score(params, hidden, protocol), "ideal": thresholds(ideal, truth)}


def measured(options: Options, names: Sequence[str], count: int) -> dict[str, list[Row]]:
    """The rows of each condition; the first camera of all before the second of any."""
    setup = Setup(options.weights, options.seed, photos=True)
    jobs = [(i, name) for i in range(count) for name in names]

    def make(left: list[int]) -> Iterable[Row]:
        for first, scored in ((True, score_both), (False, score)):
            chosen = [jobs[k] for k in left if (jobs[k][0] < BESIDE) == first]
            yield from made(scored, setup, [(i, dataclasses.replace(BASE, **CHANGES[name]))
                                            for i, name in chosen], options.workers)

    rows = resumed(options.rows, [weights_hash(options.weights), options.seed],
                   [f"{name} {i}" for i, name in jobs], make, "cameras")
    return {name: rows[k::len(names)] for k, name in enumerate(names)}


def held(error: np.ndarray, std: np.ndarray) -> str:
    """How many per cent of errors lie within 1 and 1.96 std."""
    z = np.abs(error) / std
    return f"{100 * (z < 1).mean():.0f} / {100 * (z < 1.96).mean():.0f} %" if z.size else "–"


def cells(name: str, rows: list[Row]) -> list[str]:
    """A condition's thresholds."""
    line = [name, str(len(rows))]
    for which in ("ideal", "measured"):
        error, std = (np.array([r[which][k] for r in rows if which in r]) for k in ("error", "std"))
        line += [f"{100 * np.median(np.abs(error)):.1f} %", held(error, std)]
    return [*line, f"{100 * np.median(std):.1f} %"]


def sensor_lines(rows: dict[str, list[Row]]) -> list[list[str]]:
    """What was measured of the circuit: what, condition, true value, how often found, median error
    of those, and how often the intervals hold; last, how often it was found where there is none."""
    lines = []
    for name, label in LABELS.items():
        without = []
        for condition, found in rows.items():
            value, std, true = np.array([r["sensor"][name] for r in found], float).T
            there = value > 0
            if not true[0]:
                without += there.tolist()
                continue
            off = value[there] / true[there] - 1
            lines.append([label, condition, f"{true[0]:g}", f"{there.sum()} of {len(found)}",
                          f"{100 * np.median(np.abs(off)):.0f} %" if off.size else "–",
                          held(off, std[there] / true[there])])
        if name != "shot_hz":  # which all noise that falls with light is
            lines.append([label, "all others", "0", f"{sum(without)} of {len(without)}",
                          "", ""])
    return lines


def light_lines(rows: dict[str, list[Row]]) -> list[list[str]]:
    """The same of the light that frames lack, and of noise rates over pixels."""
    lines = []
    for condition, found in rows.items():
        value, std, true = np.array([r["light"] for r in found], float).T
        there = value != 0
        if true[0]:
            off = (value - true)[there]
            lines.append(["light added [DN]", condition, f"{true[0]:g}",
                          f"{there.sum()} of {len(found)}",
                          f"{np.median(np.abs(off)):.1f} DN" if off.size else "–",
                          held(off, std[there])])
        for k, what in enumerate(("mean", "median") if "noise" in found[0] else ()):
            maps, real = np.array([r["noise"][k] for r in found]).transpose(1, 0, 2)
            lines.append([f"η [Hz], {what} of pixels", condition, f"{np.median(real):.2f}", "all",
                          f"{100 * np.median(np.abs(maps / real - 1)):.0f} %", ""])
    return lines


def halves(path: Path) -> list[str] | None:
    """A real recording's cells; None where its halves tell nothing."""
    recording = read_recording(path)
    runs = plan_runs(recording, plan_windows(recording).pairs)
    cuts = [run[k:k + max(2, len(run) // 2)] for run in runs for k in (0, len(run) // 2)]
    noise = frame_noise([(recording, i) for run in runs for i in run])
    first, second = (receptor_sample(
        [(recording, cut) for cut in cuts[k::2]], noise) for k in (0, 1))
    if first is None or second is None:
        return None
    found = find(first)
    return [path.name, *(f"{s:.3f}" for s in (
        explained(second, IDEAL, found.ideal_theta), explained(second, found.seen, found.theta))),
        f"{found.seen.offset_dn:.0f} DN", f"{found.seen.cutoff_hz:.0f} Hz"]


def main(options: Options) -> dict[str, Any]:
    begin(options, "real_pixels")
    count = options.count(options.recordings, debug=1, full=40)
    rows = measured(options, FEW if options.preset == "debug" else tuple(CHANGES), count)
    real = [line for path in options.recordings_at if (line := halves(path))]
    text = "\n\n".join((
        markdown(("condition", "cameras", "ideal: median error of θ", "68 / 95 % hold",
                  "measured: median error", "68 / 95 % hold", "median std"),
                 (cells(n, r) for n, r in rows.items())),
        markdown(("what else", "condition", "true", "found in", "median error", "68 / 95 % hold"),
                 sensor_lines(rows) + light_lines(rows)),
        markdown(("recording", "R2 held out, ideal", "measured", "light added", "cutoff"), real)))
    result = {"conditions": rows, "real": real}
    conclude(options, "real_pixels", result, text)
    pages.slow_pixels(options.out / "real_pixels.png", rows)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

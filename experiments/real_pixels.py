"""Thresholds of cameras whose pixels are slow and whose frames are no measurement of light.

    python -m experiments.real_pixels --preset full --workers 2 --recordings-at flight.aedat4

Hidden cameras, one condition a row: the relative error of theta, how often its 68 and 95 %
intervals hold the truth, and the cutoff that is found, beside the estimate that takes pixels for
ideal (`estimate_camera(pixel="ideal")`). Then real recordings: the share of variance that the
pooled regression of one half explains of the other, with an ideal pixel and with that of the first
half. Writes real_pixels.json, .md and .png. The paper knows ideal pixels alone.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from evflow import estimate_camera, read_recording
from evflow.estimation.refine import frame_noise, plan_runs, receptor_sample
from evflow.estimation.refine.receptor_search import explained, find
from evflow.recordings.windows import plan_windows
from evflow.simulator.photoreceptor import IDEAL
from experiments.shared import pages
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.common import StudyOptions, begin, conclude, markdown, run_script
from experiments.shared.many import Setup, study
from experiments.shared.real_cameras import BASE, CHANGES

FEW = ("ideal", "cutoff 30.0 Hz", "black level +16 DN")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Measure cameras that are not ideal."""

    out: Path = Path("out/real_pixels")
    seed: int = 9_000_011
    recordings: int | None = None
    """Cameras a condition (default: the preset's)."""
    recordings_at: tuple[Path, ...] = ()
    """Real recordings with frames."""


def score(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, Any]:
    """Relative errors (2 estimates, 2 polarities) and stds of theta, and the cutoff found."""
    truth = np.array([float(hidden.nominal.theta_on), float(hidden.nominal.theta_off)])
    errors, stds, cutoff = [], [], 0.0
    for pixel in ("ideal", "measured"):
        found = estimate_camera(hidden.recording, params, pixel=pixel)  # type: ignore[arg-type]
        pairs = [(float(getattr(s, "theta_on")), float(getattr(s, "theta_off")))  # noqa: B009
                 for s in (found.summary, found.summary_std)]
        errors.append(pairs[0] / truth - 1)
        stds.append(pairs[1] / truth)
        cutoff = found.sensor.cutoff_hz
    return {"error": np.array(errors), "std": np.array(stds), "cutoff": cutoff}


def row(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """A condition's cells."""
    error, std = (np.stack([r[k] for r in rows]) for k in ("error", "std"))
    cells = [name]
    for k in range(2):
        off, z = np.abs(error[:, k]), np.abs(error[:, k]) / std[:, k]
        cells += [f"{100 * np.median(off):.1f} %", f"{100 * (z < 1).mean():.0f} / "
                  f"{100 * (z < 1.96).mean():.0f} %"]
    seen = [r["cutoff"] for r in rows if r["cutoff"]]
    return [*cells, f"{np.median(seen):.0f} Hz in {len(seen)} of {len(rows)}" if seen else "none"]


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
    setup = Setup(options.weights, options.seed, photos=True)
    names = FEW if options.preset == "debug" else tuple(CHANGES)
    rows = {name: study(score, setup, [dataclasses.replace(BASE, **CHANGES[name])] * count,
                        options.workers, name) for name in names}
    real = [cells for path in options.recordings_at if (cells := halves(path))]
    heads = ("condition", "ideal: median error", "68 / 95 % hold", "measured: median error",
             "68 / 95 % hold", "cutoff found")
    text = markdown(heads, (row(n, r) for n, r in rows.items())) + "\n\n" + markdown(
        ("recording", "R2 held out, ideal", "measured", "light added", "cutoff"), real)
    result = {"conditions": {n: [{k: np.asarray(v).tolist() for k, v in r.items()} for r in found]
                             for n, found in rows.items()}, "real": real}
    conclude(options, "real_pixels", result, text)
    pages.slow_pixels(options.out / "real_pixels.png", rows)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

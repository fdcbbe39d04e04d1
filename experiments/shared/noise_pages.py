"""Table and figures of noise_rates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots
from experiments.shared.measured_noise import SIDES, Rates
from experiments.shared.table_two import LUX

# Table IV, ON and OFF in Hz. V2E's mean over both cameras is printed as .032, .075; it is .082.
PAPER = {"v2e": {"CeleX5": (0.077, 0.069), "DAVIS346": (0.087, 0.081)},
         "evolt": {"DAVIS346": (0.083, 0.107)},
         "ours": {"CeleX5": (0.037, 0.033), "DAVIS346": (0.026, 0.030)}}
MARKS = {"flat": "o", "still": "s", "moving": "^"}
NOTE = ("v2e: r of the bench, rate as 1 / θ about θ = .2; evolt: the published DAVIS346; evolt, θ: "
        "at the nominal thresholds; constant: the bench's rates everywhere; counting: all events. "
        "± is the 95 % interval over seeds; the paper's figures are of other sensors.")


def table(result: dict[str, Any]) -> str:
    """Markdown: errors of all systems beside the paper's, ours cell by cell, measured data."""
    lines = ["| sensor | scene (cells x seeds) | system | \\|η - truth\\| ON [Hz] | OFF | "
             "answered | paper CeleX5 ON, OFF | paper DAVIS346 |", "|" + "---|" * 8]
    for sensor, scenes in result["simulated"].items():
        for scene, one in scenes.items():
            count = f"{len(one['scp']) * len(one['lux'])} x {len(one['rates']['truth'])}"
            for name, row in one["errors"].items():
                paper = [", ".join(f"{v:.3f}" for v in PAPER.get(name, {}).get(camera, ()))
                         for camera in ("CeleX5", "DAVIS346")]
                lines.append(f"| {sensor} | {scene} ({count}) | {name} | " + " | ".join(
                    f"{row[side][0]:.4f} ± {row[side][1]:.4f}" for side, _ in SIDES)
                    + f" | {row['answered']:.0%} | {' | '.join(paper)} |")
    lines += ["", NOTE, "", "| ours - truth, ON / OFF [mHz] (truth) | " + " | ".join(
        f"{x} lx" for x in LUX) + " | inside 1, 2 std |", "|" + "---|" * (len(LUX) + 2)]
    for sensor, scenes in result["simulated"].items():
        for scene, one in scenes.items():
            truth, found = (one["rates"][k].mean(0) for k in ("truth", "ours"))
            inside = ", ".join(f"{share:.0%}" for share in one["inside"] if np.isfinite(share))
            for i, scp in enumerate(one["scp"]):
                at = {lux: " / ".join(f"{1e3 * (a - b):+.1f} ({1e3 * b:.0f})" for a, b in zip(
                    found[i, j], truth[i, j], strict=True)) for j, lux in enumerate(one["lux"])}
                lines.append(f"| {sensor}, {scene}, SCP {scp} | " + " | ".join(
                    at.get(lux, "") for lux in LUX) + f" | {inside} |")
    real = result["measured"]
    if shape := real.get("iebcs_noise_hist"):
        lines += ["", "| share of the noise, ON / OFF | " + " | ".join(
            f"{x:g} lx" for x in shape["lux"]) + " | distance |", "|" + "---|" * 5]
        lines += [f"| {name} | " + " | ".join(f"{on:.4f} / {off:.4f}" for on, off in v)
                  + f" | {shape['distance'][name]:.3f} |" for name, v in shape["shares"].items()]
        lines += ["", *(f"Ours at {line}" for line in shape["notes"])]
    if rows := real.get("noise_static_dvxplorer640"):
        lines += ["", "| DVXplorer at rest | η ON [Hz] | η OFF |", "|---|---|---|"]
        lines += [f"| {name} | {v[0]:.4f} | {v[1]:.4f} |" for name, v in rows.items()]
    return "\n".join(lines)


def page(path: Path, sensor: str, scenes: dict[str, Any]) -> None:
    """As Figs. 5 and 10: rates against luminance, a panel per threshold; below, against
    threshold, a panel per luminance. Bars are the range over seeds."""
    base = scenes["flat"]
    figure = plots.new_figure(2.6 * len(base["lux"]), 7.5)
    figure.suptitle(f"{sensor}: noise [Hz / pixel], ON red, OFF blue; closed forms may leave "
                    "the panels")
    ways = (("scp", "lux", 1, "SCP {}", "luminance [lx]"), ("lux", "scp", 2, "{} lx", "SCP"))
    for part, (by, over, axis, title, label) in zip(figure.subfigures(2, 1), ways, strict=True):
        for place, value in zip(part.subplots(1, len(base[by]), squeeze=False)[0], base[by],
                                strict=True):
            curves(place, {
                name: (one[over], {k: np.take(v, list(one[by]).index(value), axis)
                                   for k, v in one["rates"].items()})
                for name, one in scenes.items() if value in one[by]})
            place.set(title=title.format(value), xlabel=label)
    by_label = {name: handle for axis in figure.axes
                for handle, name in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(by_label.values(), by_label.keys(), loc="outside right center", fontsize=8)
    plots.save_figure(figure, path)


def curves(axis: Any, scenes: dict[str, tuple[Any, Rates]]) -> None:
    """Truth and closed forms of the first scene as lines, ours of every scene as marks."""
    x, rates = next(iter(scenes.values()))
    for i, (side, colour) in enumerate(SIDES):
        for name, style, width in (("truth", "-", 4), ("v2e", "--", 1), ("evolt, θ", ":", 1.5)):
            axis.plot(x, rates[name][..., i].mean(0), style, color=colour, lw=width,
                      alpha=0.3 if name == "truth" else 1.0, label=f"{name}, {side}")
        for scene, (at, found) in scenes.items():
            seen = found["ours"][..., i]
            middle = seen.mean(0)
            axis.errorbar(at, middle, (middle - seen.min(0), seen.max(0) - middle),
                          fmt=MARKS[scene], color=colour, ms=4,
                          mfc=colour if scene == "flat" else "white", label=f"ours, {scene}")
    most = max(float(np.nanmax(r[k])) for _, r in scenes.values() for k in ("truth", "ours"))
    axis.set_ylim(-0.02 * most, 1.4 * most)

"""Table and picture of `integrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots
from experiments.shared.images import SCORES
from experiments.shared.integrated import Example

PAPER = {  # Table X: RMSE, PSNR, SSIM
    "DAVIS240": {"ecc": (37.56, 16.82, .41), "s2r": (32.37, 18.10, .45),
                 "jaer": (35.10, 17.39, .42), "lgan": (32.30, 18.15, .42),
                 "ours, maps": (32.24, 18.17, .42)},
    "DAVIS346": {"ecc": (54.81, 13.75, .33), "s2r": (50.55, 14.45, .35),
                 "jaer": (57.72, 13.42, .34), "lgan": (45.73, 15.29, .36),
                 "ours, maps": (39.76, 16.37, .37)}}


def table(rows: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Markdown, a block per horizon; the paper's row beside systems that it has."""
    lines = []
    for group, horizons in rows.items():
        kind = group.split(", ")[-1]
        for horizon, systems in horizons.items():
            lines += [f"\n**{group}, {horizon}**\n",
                      "| thresholds | RMSE | PSNR [dB] | SSIM | SSIM global | seconds | "
                      "paper: RMSE, PSNR, SSIM |", "|" + "---|" * 7]
            for name, row in systems.items():
                values = [f"{row[s][0]:.3f}" + (f" ± {row[s][1]:.3f}" if row[s][1] else "")
                          for s in SCORES]
                paper = ", ".join(map(str, PAPER.get(kind, {}).get(name, ())))
                took = "" if row["seconds"] is None else f"{row['seconds']:.1f}"
                lines.append(f"| {name} | {' | '.join(values)} | {took} | {paper} |")
    lines += ["", "± is the 95 % interval over recordings."]
    return "\n".join(lines)


def picture(out: Path, shown: list[Example]) -> None:
    """Frames beside what the systems predict of them, with the RMSE of each."""
    columns = 1 + len(shown[0][2])
    figure = plots.new_figure(3.0 * columns, 2.6 * len(shown))
    axes = figure.subplots(len(shown), columns, squeeze=False)
    for row, (name, frame, images) in zip(axes, shown, strict=True):
        for axis, (title, seen) in zip(row, {name: frame, **images}.items(), strict=True):
            rmse = np.sqrt(np.mean((seen - frame) ** 2))
            axis.imshow(seen, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            axis.set_title(title if title == name else f"{title}: {rmse:.1f}", fontsize=9)
            axis.set_axis_off()
    plots.save_figure(figure, out)

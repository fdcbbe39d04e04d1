"""Table and pictures of `changes`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots
from experiments.shared import change_systems as systems

MEASURES = ("log", "log_255", "magnitude", "fired")
CHANGE: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -0.6, "vmax": 0.6, "interpolation": "nearest"}
TITLES = {"next": "up to the next frame", "middle": "up to the held-out middle of three frames"}
SHOWN = ("AKF", "AKF, latest frame", "complementary", "integration", "encoder")


def picture(out: Path, shown: list[tuple[str, systems.Predicted]]) -> None:
    """Fig. 15: a frame, the change to the held-out next one, and what every system says of it."""
    figure = plots.new_figure(2.6 * (len(SHOWN) + 2), 2.2 * len(shown))
    axes = figure.subplots(len(shown), len(SHOWN) + 2, squeeze=False)
    for row, (name, predicted) in zip(axes, shown, strict=True):
        row[0].imshow(predicted.frame, cmap="gray", vmin=0, vmax=255)
        row[0].set_title(name, fontsize=9)
        row[1].imshow(predicted.true[-1], **CHANGE)
        row[1].set_title("change of the frames", fontsize=9)
        for axis, system in zip(row[2:], SHOWN, strict=True):
            change = predicted.made[system][-1]
            axis.imshow(change, **CHANGE)
            off = np.abs(change - predicted.true[-1]).mean()
            axis.set_title(f"{system}: {off:.3f}", fontsize=9)
        for axis in row:
            axis.set_axis_off()
    plots.save_figure(figure, out)


def table(result: dict[str, Any]) -> str:
    """Markdown: the windows, then each recording by each protocol."""
    lines = ["**windows of simulated scenes, the whole path**\n",
             "| change from | MAE, log units | MAE, log_255 |", "|---|---|---|"]
    lines += [f"| {k} | {v['log']:.4f} | {v['log_255']:.4f} |"
              for k, v in result.items() if k not in ("windows", "recordings")]
    lines.append(f"\n{result['windows']:.0f} windows. Paper: AKF .10, its encoder .06 (IJRR), "
                 ".18 and .13 (EVIMO2v2).")
    for name, tasks in result["recordings"].items():
        for task, rows in tasks.items():
            what = TITLES.get(task, "up to 16 instants before the next frame")
            lines += [f"\n**{name}, {what}**\n", "| change from | MAE, log units | MAE, log_255 | "
                      "of magnitudes, log_255 | where integration says any, log units |",
                      "|" + "---|" * 5]
            for system, row in rows.items():
                cells = [f"{row[m][0]:.4f}" + (f" ± {row[m][1]:.4f}" if row[m][1] else "")
                         for m in MEASURES]
                lines.append(f"| {system} | {' | '.join(cells)} |")
    lines.append("\n± is the 95 % interval over recordings.")
    return "\n".join(lines)

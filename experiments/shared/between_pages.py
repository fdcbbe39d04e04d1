"""Table and picture of `between_frames`."""

from __future__ import annotations

import itertools
import operator
from pathlib import Path
from typing import Any

import numpy as np

from evflow.report import plots
from experiments.shared.common import markdown
from experiments.shared.moving import WAYS

UNITS = {"rotation": "°", "zoom": " %"}


def table(rows: list[dict[str, Any]]) -> str:
    """The means over pictures."""
    lines = []
    for (motion, size, speed), group in itertools.groupby(
            rows, operator.itemgetter("motion", "size", "speed")):
        same = list(group)
        for way in (*WAYS, "evflow"):
            m = {k: np.mean([row[way][k] for row in same]) for k in same[0][way]}
            shares = [row[way]["share"] for row in same]
            lines.append((motion, size, f"{speed:g}{UNITS.get(motion, ' px')}", way,
                          f"{m['share']:.3f} ({min(shares):.2f}–{max(shares):.2f})",
                          f"{m['swept']:.2f}" if "swept" in m else "",
                          f"{m['least']:.2f}–{m['most']:.2f}",
                          f"{m['at_rate']:.1f} / {m['at_double']:.1f}", f"{m['r']:.3f}",
                          f"{np.mean([row['noted'] for row in same]):.0%}" * (way == "evflow")))
    return markdown(("motion", "size", "per frame", "between", "events", "at the edge",
                     "rate by phase", "comb, % at 1x / 2x", "r of counts", "noted"), lines)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Of each motion, over speed: shares of events, and the range of the rate by phase; a colour
    for each way, a point for each picture."""
    motions = list(dict.fromkeys(row["motion"] for row in rows))
    figure = plots.new_figure(2.4 * len(motions) + 1, 5.0)
    for k, motion in enumerate(motions, 1):
        share, rate = (figure.add_subplot(2, len(motions), at) for at in (k, k + len(motions)))
        same = [row for row in rows if row["motion"] == motion]
        speeds = sorted({row["speed"] for row in same})
        for j, way in enumerate((*WAYS, "evflow")):
            at = np.array([speeds.index(row["speed"]) + 0.22 * (j - 1) for row in same])
            of = {name: np.array([row[way][name] for row in same])
                  for name in ("share", "least", "most")}
            share.plot(at, of["share"], ".", label=way)
            rate.vlines(at, of["least"], of["most"], colors=f"C{j}", alpha=0.4)
        for axis, asked in ((share, (0.9, 0.8)), (rate, (0.93, 1.07))):
            axis.hlines(asked, -0.5, len(speeds) - 0.5, colors="0.6", linewidth=0.6)
            axis.set_xticks(range(len(speeds)), [f"{s:g}{UNITS.get(motion, '')}" for s in speeds])
        share.set(title=motion, ylim=(0, 1.3))
        rate.set(ylim=(0.4, 2.0), xlabel="a frame" if motion in UNITS else "pixels a frame")
        if k == 1:
            share.set(ylabel="events, share of the dense")
            rate.set(ylabel="rate by phase of a frame")
            share.legend(fontsize=7)
    plots.save_figure(figure, path)

"""Totals, tables and the verdict of `noise`."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.shared.noise_laws import judged
from experiments.shared.table_two import LUX, MIDDLE, SCP, TABLE_TWO

MODELS = ("noisy", "v2e", "paper", "dvs346", "dvs240")
JUDGED, BOUND = 10_000, 0.02


def totals(result: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Counts to compare with laws that give at least JUDGED events: each screen, and for the noise
    of each sensor and polarity the sums over luminance and over thresholds."""
    sums = {f"{name} SCP {scp} {kind}": cell
            for name, rows in result["table II"].items()
            for scp, row in zip(SCP, rows, strict=True) for kind, cell in row.items()}
    for name, rows in result["figure 5"].items():
        for polarity in ("on", "off"):
            cells = [[(c["events"], c["law"]) for c in row[polarity]] for row in rows]
            for axis, labels in ((1, [f"SCP {s}" for s in SCP]), (0, [f"{x} lx" for x in LUX])):
                for label, pair in zip(labels, np.sum(cells, axis), strict=True):
                    sums[f"{name} at rest {label} {polarity}"] = judged(*pair)
    return {k: v for k, v in sums.items() if v["law"] >= JUDGED}


def cells(result: dict[str, Any]) -> dict[str, float]:
    """The noise cell by cell (sensor, threshold, luminance, polarity; at least JUDGED events): the
    largest deviation, and the largest in standard deviations of a Poisson count."""
    found = np.array([(c["deviation"], c["law"]) for rows in result["figure 5"].values()
                      for row in rows for p in ("on", "off") for c in row[p]
                      if c["law"] >= JUDGED])
    size = np.abs(found[:, 0])
    return {"cells": len(found), "deviation": float(size.max()), "least events": found[:, 1].min(),
            "standard deviations": float((size * np.sqrt(found[:, 1])).max())}


def table(result: dict[str, Any]) -> str:
    """Table II as ratios to SCP 161, noise rates, and the largest deviations."""
    lines = []
    for p in ("on", "off"):
        lines += [f"| θ {p.upper()} | paper, events | paper | 1/θ | "
                  + " | ".join(f"{n} (law, deviation)" for n in MODELS) + " |",
                  "|" + "---|" * (4 + len(MODELS))]
        events = TABLE_TWO[p][:, 2] / TABLE_TWO[p][MIDDLE, 2]
        for row, (theta, sigma, count) in enumerate(TABLE_TWO[p]):
            cells = []
            for rows in (result["table II"][n] for n in MODELS):
                one, base = rows[row][f"{p} ramp"], rows[MIDDLE][f"{p} ramp"]
                cells.append(f"{one['events'] / base['events']:.3f} ("
                             f"{one['law'] / base['law']:.3f}, {one['deviation']:+.2%})")
            lines.append(f"| {theta} ± {sigma} | {count:,.0f} | {events[row]:.3f} | "
                         f"{TABLE_TWO[p][MIDDLE, 0] / theta:.3f} | " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["The paper prints 8,564,635 OFF events at θ .302; its neighbours times their "
              "thresholds say that a digit is too many.", ""]
    lines += ["| noise ON, OFF [Hz] | θ | " + " | ".join(f"{x} lx" for x in LUX) + " |",
              "|" + "---|" * (2 + len(LUX))]
    for name, rows in result["figure 5"].items():
        for row in (0, MIDDLE, 5):
            rates = [[c["events"] / (rows[row]["pixels"] * rows[row]["seconds"])
                      for c in rows[row][p]] for p in ("on", "off")]
            theta = ", ".join(f"{TABLE_TWO[p][row, 0]}" for p in ("on", "off"))
            lines.append(f"| {name} | {theta} | "
                         + " | ".join(f"{a:.3f}, {b:.3f}" for a, b in zip(*rates, strict=True))
                         + " |")
    return "\n".join([*lines, "", verdict(result)])


def verdict(result: dict[str, Any]) -> str:
    name, worst = max(result["totals"].items(), key=lambda kv: abs(kv[1]["deviation"]))
    one = result["cells"]
    return (f"Largest deviation from a law among {len(result['totals'])} totals of at least "
            f"{JUDGED:,} events: {worst['deviation']:+.2%} ({name}, {worst['events']:,.0f} events; "
            f"bound {BOUND:.0%}).\nAmong {one['cells']} single cells of noise, at least "
            f"{one['least events']:,.0f} events each: {one['deviation']:.2%}, "
            f"{one['standard deviations']:.1f} standard deviations.\nThe paper says of "
            "Figures 4 and 5: fewer events at a larger threshold, less noise in brighter light\n"
            "and at a larger threshold. So does its Eq. 12 (paper). v2e's shot noise falls with "
            "light but does not know\nthe nominal threshold, its leak knows neither; "
            "DVS-Voltmeter's leak grows with light and has no OFF.")

"""Two cameras compared: a text table, and a page to hand to a colleague."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from evflow.camera import Camera
from evflow.metrics.cameras import GREY, said_of_cutoff, verdict
from evflow.report import page
from evflow.report.figures import svg
from evflow.report.page import Panel, figure, grid, number, paragraph, spread, table
from evflow.report.plots import require, robust_range

LABELS = {
    "theta_on": "threshold ON", "theta_off": "threshold OFF", "eta_on": "noise ON [Hz/pixel]",
    "eta_off": "noise OFF [Hz/pixel]", "sigma_on": "mismatch ON", "sigma_off": "mismatch OFF",
    "cutoff_hz": "cutoff [Hz]", "refractory_s": "dead time [s]", "leak_hz": "leak [Hz/pixel]",
    "shot_hz": "shot noise [Hz, dark]"}
COLOURS = ("#444b57", "#d98200")
NOTE = ("Apart: the difference in standard deviations; above 3 they differ. r: "
        "correlation of the maps, about 0 for two cameras of one type, high for one camera at two "
        "settings.")


def describe_cameras(numbers: dict[str, Any], names: tuple[str, str]) -> str:
    """One line per parameter, and which ones certainly differ."""
    rows = [["", *(name[:24] for name in names), "ratio", "apart", "r"], *(
        [_named(name, row, name), _shown(row, "a"), _shown(row, "b"), number(row["ratio"]),
         _signed(row["apart"]), number(row["r"], 2)] for name, row in numbers.items())]
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    lines = ["  ".join(cell.ljust(w) if not i else cell.rjust(w) for i, (cell, w) in enumerate(
        zip(row, widths, strict=True))) for row in rows]
    return "\n".join([*lines, *_laws(numbers, names), NOTE, verdict(numbers)])


def write_cameras(
    path: str | os.PathLike, cameras: tuple[Camera, Camera], numbers: dict[str, Any],
    names: tuple[str, str], facts: dict[str, str], *, overwrite: bool = False,
) -> None:
    """compare.html of two cameras: the verdict, all values with their errors, thresholds in percent
    of contrast, histograms. numbers: of `compare_cameras`.

    Raises EV010 (no matplotlib), EV013 (exists), EV019 (cannot be written).
    """
    require()
    rows = []
    for name, row in numbers.items():
        rows.append([_named(name, row, LABELS[name]), _shown(row, "a"), _shown(row, "b"),
                     number(row["ratio"]), _signed(row["apart"]), number(row["r"], 2)])
        if name.startswith("theta"):
            rows.append(["in % of contrast", _percent(row, "a"), _percent(row, "b"), "", "", ""])
    head = ["", *(page.text(name) for name in names), "ratio", "apart", "r"]
    drawn = [figure(page.drawing(histograms(cameras, name, names, numbers[name]), LABELS[name]), "",
                    LABELS[name])
             for name in ("theta_on", "theta_off", "eta_on", "eta_off")
             if numbers[name]["a"] is not None or numbers[name]["b"] is not None]
    panels = [
        Panel("verdict", "Side by side", paragraph(verdict(numbers, LABELS)) + table(head, rows)
              + "".join(paragraph(line, "note") for line in [*_laws(numbers, names), NOTE])),
        Panel("pixels", "Their pixels", grid(drawn, 22) + paragraph(
            "All pixels of the maps; those without events of their own show the camera's value. "
            "Vertical lines: the values of the table above.", "note")),
        Panel("facts", "What was compared", table(
            ["", ""], [[page.text(k), f"<code>{page.text(v)}</code>"] for k, v in facts.items()],
            numeric=False))]
    page.write_page(path, f"{names[0]} and {names[1]}", "two cameras", panels, numbers,
                    overwrite=overwrite)


def _named(name: str, row: dict[str, Any], label: str) -> str:
    """A row's label; of the cutoff with the light for which it holds."""
    return f"{label} {said_of_cutoff(row)}" if name == "cutoff_hz" else label


def _laws(numbers: dict[str, Any], names: tuple[str, str]) -> list[str]:
    """A sentence where the cutoffs of the two depend on light in different ways."""
    row = numbers.get("cutoff_hz", {})
    if row.get("at_dn") != GREY:
        return []
    first, second = names if row["a_by_light"] else names[::-1]
    return [f"The cutoff of {first} is proportional to light, that of {second} is the same in any: "
            f"compared at {GREY:g} DN."]


def _shown(row: dict[str, Any], side: str) -> str:
    """value ± std; a dash where it was not measured."""
    value, std = row[side], row[f"{side}_std"]
    return "–" if value is None else number(value) if std is None else spread(value, std)


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.1f}"


def _percent(row: dict[str, Any], side: str) -> str:
    """A threshold in percent of contrast."""
    if row[side] is None:
        return "–"
    slope = 100.0 * np.exp(row[side])
    return (number(slope - 100.0) if row[f"{side}_std"] is None else
            spread(slope - 100.0, slope * row[f"{side}_std"]))


def histograms(
    cameras: tuple[Camera, Camera], name: str, names: tuple[str, str], row: dict[str, Any]
) -> bytes:
    """Distributions of a parameter over the pixels of both cameras, with lines at the values of
    its row of the table. A map that was not measured holds the prior and is named, not drawn."""
    maps = [None if row[side] is None else np.asarray(getattr(camera, name)).ravel()
            for side, camera in zip("ab", cameras, strict=True)]

    def draw(axis: Any) -> None:
        spans = [robust_range(values, 0.5) for values in maps if values is not None]
        bins = np.linspace(min(s[0] for s in spans), max(s[1] for s in spans), 50)
        for side, values, colour, label in zip("ab", maps, COLOURS, names, strict=True):
            if values is None:
                axis.plot([], [], " ", label=f"{label}: not measured")
                continue
            axis.hist(np.clip(values, bins[0], bins[-1]), bins=bins, color=colour, alpha=0.45,
                      weights=np.full(values.size, 100.0 / values.size), label=label)
            axis.axvline(row[side], color=colour, lw=1.2)
        axis.locator_params(axis="x", nbins=5)  # more labels run together
        axis.set(xlabel="natural log units" if name.startswith("theta") else "Hz per pixel",
                 ylabel="pixels [%]")
        axis.legend()

    return svg(draw, 4.4, 2.6)

"""Events and noise against threshold and luminance (paper, Table II, Figures 4 and 5).

    python -m experiments.noise --preset full

Screens that brighten or darken ninefold (a step and a ramp, at the paper's six thresholds) and
screens at rest (500 to 4000 lx, which is 255 DN), seen by known sensors. Every count is held
against a law (laws.py): thresholds passed, Eq. 12, v2e's shot noise, the leak, the passage times
of DVS-Voltmeter. The paper's events are of a CeleX5 whose contrast and exposure it does not
state, so that only ratios between its rows compare. Writes noise.json, noise.md, noise.png
(laws), events.png (as Figure 4) and sources.png (each noise source by itself).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from evflow.process.terminal import bar
from evflow.report import plots
from experiments.shared import pages
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.noise_counts import figure_five, table_two
from experiments.shared.noise_tables import MODELS, cells, table, totals
from experiments.shared.sources import figure_four, sources
from experiments.shared.table_two import LUX, SCP, TABLE_TWO


@dataclasses.dataclass(frozen=True)
class Options:
    """Hold the simulated events of five sensors against their laws."""

    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/noise")
    seed: int = 41

    @property
    def size(self) -> int:
        """Side of the sensor in pixels."""
        return {"debug": 64, "full": 128}[self.preset]

    @property
    def events(self) -> int:
        """Least number of noise events per luminance, threshold and polarity."""
        return {"debug": 6_000, "full": 60_000}[self.preset]

    @property
    def intervals(self) -> int:
        return {"debug": 160, "full": 1000}[self.preset]


def main(options: Options) -> dict[str, Any]:
    begin(options, "noise")
    plots.require()
    key = jax.random.key(options.seed)
    result: dict[str, Any] = {"table II": {n: [] for n in MODELS},
                              "figure 5": {n: [] for n in MODELS}}
    with bar("cameras") as progress:
        for k, name in enumerate(MODELS):
            for row in range(len(SCP)):
                k_step, k_rest = jax.random.split(jax.random.fold_in(key, 100 * k + row))
                result["table II"][name].append(table_two(k_step, options.size, name, row))
                result["figure 5"][name].append(figure_five(
                    k_rest, options.size, name, row, options.events, options.intervals))
                progress(k * len(SCP) + row + 1, len(MODELS) * len(SCP))
    result |= {"totals": totals(result), "cells": cells(result)}
    text = table(result)
    print(text)
    scenes = figure_four(jax.random.fold_in(key, 1))
    alone = sources(jax.random.fold_in(key, 2))
    result["figure 4"] = {s["title"]: {"events": len(s["events"]), "seconds": s["seconds"]}
                          for s in scenes}
    result["sources"] = {s["title"]: {k: np.asarray(s[k]).tolist() for k in (
        "x", "measured", "law")} for s in alone}
    pages.noise_laws(options.out / "noise.png", result, TABLE_TWO, LUX)
    pages.event_rates(options.out / "events.png", scenes)
    pages.noise_sources(options.out / "sources.png", alone)
    write_result(options.out / "noise.json", result, dataclasses.asdict(options))
    write_text(options.out / "noise.md", text)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""Noise rates against luminance and threshold by three systems (paper, Table IV; Figs. 5, 10, 11).

    python -m experiments.noise_rates --preset full

Two sensors of known noise, at the thresholds of Table II and 500 to 4000 lx (25 to 200 DN): `eq12`,
a v2e pixel with the noise of Eq. 12, and `dvs346`, the leak of DVS-Voltmeter. Scenes: `flat`,
events alone; `still`, a texture at rest, with frames; `moving`, a disc crosses it. Ours sees the
recording alone; the closed forms see the nominal thresholds and the luminance, and v2e's one
constant is that of the bench: the truth at 2000 lx, SCP 161. Scored is |η - truth| of the camera.
The paper's figures are of other sensors. Measured noise (IEBCS, a DVXplorer at rest) follows where
EVFLOW_DATA has it. Writes noise_rates.json, .md, a page per sensor and measured.png.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from evflow import load_weights
from evflow.process.terminal import bar
from evflow.report import plots
from experiments.shared import alone
from experiments.shared.common import begin, plain, run_script, write_result, write_text
from experiments.shared.measured_noise import measured, measured_page, ours
from experiments.shared.noise_pages import page, table
from experiments.shared.noise_scenes import MODELS, SCENES, counting, law, record
from experiments.shared.noise_systems import BENCH, DN, SYSTEMS, THETA, closed_forms, inside, scored
from experiments.shared.table_two import LUX, SCP


@dataclasses.dataclass(frozen=True)
class Options:
    """Compare noise rates by closed forms and by estimates."""

    preset: Literal["debug", "full"] = "debug"
    weights: str = "default"
    out: Path = Path("out/noise_rates")
    seed: int = 7_000_061
    seeds: int | None = None
    """Cameras, textures and draws of noise per cell (default: the preset's)."""
    size: int = 64

    def grid(self, scene: str) -> tuple[list[int], list[int]]:
        """Thresholds (of 6) and luminances (of 8) of a scene: those with frames take seconds."""
        if scene == "flat":
            return list(range(6)), list(range(8))
        return ([0, 3], [0, 3, 7]) if self.preset == "full" else ([3], [3])

    @property
    def repeats(self) -> int:
        return self.seeds or {"debug": 2, "full": 5}[self.preset]


def table_of(params: Any, sensor: str, scene: str, options: Options) -> dict[str, Any]:
    """Rates (seeds, thresholds, luminances, 2) of the truth, of every system, and ours' std."""
    rows, columns = options.grid(scene)
    bench = law(sensor, THETA[BENCH[0]], DN[BENCH[1]])
    key, found = jax.random.key(options.seed), []
    key = jax.random.fold_in(key, 10 * list(MODELS).index(sensor) + SCENES.index(scene))
    with bar(f"{sensor}, {scene}") as progress:
        for number, (seed, row, column) in enumerate(
                np.ndindex(options.repeats, len(rows), len(columns)), 1):
            place = 1000 * seed + 10 * rows[row] + columns[column]
            theta, dn = THETA[rows[row]], float(DN[columns[column]])
            recording, truth = record(
                jax.random.fold_in(key, place), sensor, scene, theta, dn, options.size)
            found.append({"truth": truth, **closed_forms(theta, dn, bench),
                          "counting": counting(recording), **alone.rates(params, recording),
                          **ours(params, recording)})
            progress(number, options.repeats * len(rows) * len(columns))
    shape = (options.repeats, len(rows), len(columns), 2)
    rates = {name: np.array([f[name] for f in found]).reshape(shape) for name in found[0]}
    return {"scp": [SCP[r] for r in rows], "theta": THETA[rows], "lux": LUX[columns],
            "rates": rates, "errors": {name: scored(rates, name) for name in SYSTEMS},
            "inside": inside(rates)}


def main(options: Options) -> dict[str, Any]:
    begin(options, "noise_rates")
    plots.require()
    params = load_weights(options.weights)
    result: dict[str, Any] = {"simulated": {sensor: {
        scene: table_of(params, sensor, scene, options) for scene in SCENES} for sensor in MODELS}}
    result["measured"] = measured(params, jax.random.key(options.seed))
    text = table(result)
    print(text)
    for sensor, scenes in result["simulated"].items():
        page(options.out / f"{sensor}.png", sensor, scenes)
    if result["measured"]:
        measured_page(options.out / "measured.png", result["measured"])
    config = dataclasses.asdict(options) | {"repeats": options.repeats}
    write_result(options.out / "noise_rates.json", plain(result), config)
    write_text(options.out / "noise_rates.md", text)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

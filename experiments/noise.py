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

from evflow import simulate
from evflow.camera import Camera, Summary, noise_of_threshold, sample_pixels
from evflow.camera.sensors import SENSORS, SensorModel
from evflow.process.terminal import bar
from evflow.report import plots
from experiments.shared import laws, pages
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.sources import figure_four, sources
from experiments.shared.table_two import LEVELS, LUX, MIDDLE, SCP, TABLE_TWO

MODELS = ("noisy", "v2e", "paper", "dvs346", "dvs240")
DARK, BRIGHT = 25.0, 225.0  # DN of the changing screen
SCREEN_DT_S, RAMP_S, HOLD_S = 0.002, 0.1, 0.3
JUDGED, BOUND = 10_000, 0.02


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


def camera_of(key: jax.Array, name: str, row: int, size: int, spread: bool) -> Camera:
    """A camera with the thresholds of a row of Table II, and their spread or the sensor's own.
    The noise of "paper" is Eq. 12 at the mean luminance of LEVELS."""
    own = SENSORS[name].mismatch
    theta = [TABLE_TWO[p][row, 0] for p in ("on", "off")]
    sigma = [TABLE_TWO[p][row, 1] if spread else own for p in ("on", "off")]
    eta = [0.0, 0.0]
    if name == "paper":
        factor = float(laws.dimmed(LEVELS.mean()))
        eta = [float(noise_of_threshold(jax.numpy.float32(t))) * factor for t in theta]
    values = (np.float32(v) for v in (*theta, *eta, *sigma))
    return sample_pixels(key, Summary(*map(jax.numpy.asarray, values)), (size, size))


def model_of(name: str) -> SensorModel:
    model = SENSORS[name].model
    return dataclasses.replace(model, eta_intensity=True) if name == "paper" else model


def judged(found: float, law: float) -> dict[str, float]:
    """A count beside its law."""
    return {"events": float(found), "law": float(law),
            "deviation": float(found / law - 1) if law > 0 else 0.0}


def shot_weight(camera: Camera) -> np.ndarray:
    """Noise of a pixel relative to one of nominal thresholds, ON and OFF, (2, N)."""
    theta = np.stack([np.ravel(camera.theta_on), np.ravel(camera.theta_off)]).astype(float)
    return np.median(theta, axis=1, keepdims=True) / theta


def screen(way: str, up: bool) -> np.ndarray:
    """DN over time (T,) of a screen that changes and then rests."""
    change = 1 if way == "step" else round(RAMP_S / SCREEN_DT_S)
    share = np.clip(np.arange(change + round(HOLD_S / SCREEN_DT_S) + 1) / change, 0, 1)
    first, last = (DARK, BRIGHT) if up else (BRIGHT, DARK)
    return first * (last / first) ** share


def screen_law(model: SensorModel, camera: Camera, dn: np.ndarray, up: bool) -> float:
    """Expected signal events of all pixels on a screen `dn` (T,)."""
    sign, seconds = (1 if up else -1), SCREEN_DT_S * (len(dn) - 1)
    theta = np.ravel(camera.theta_on if up else camera.theta_off).astype(float)
    if model.kind == "voltmeter":
        path = sign * laws.voltage(model.voltmeter, dn, SCREEN_DT_S)
        return float(np.floor(path.max() / theta).sum())
    path = sign * laws.low_passed(model, dn, SCREEN_DT_S)
    path -= path[0]
    leak = sign * model.leak_hz * 10 ** (0.5 * np.log(10) * model.leak_fpn_decades**2) * seconds
    total = path[-1] + leak * np.ravel(camera.theta_on)
    shot = model.shot_hz if model.noise_resets_memory else 0.0
    between = shot * laws.dimmed(dn[1:]) * SCREEN_DT_S
    resets = np.concatenate([[0.0], np.cumsum(between)])
    return float(laws.steady_rise(theta, total, path / path[-1], resets,
                                  shot_weight(camera).mean(0)).sum())


def table_two(key: jax.Array, options: Options, name: str, row: int) -> dict[str, Any]:
    """Signal events of a brightening (ON) and a darkening (OFF) screen, each as step and ramp."""
    k_camera, key = jax.random.split(key)
    camera, model = camera_of(k_camera, name, row, options.size, spread=True), model_of(name)
    found: dict[str, Any] = {}
    for polarity, up in (("on", True), ("off", False)):
        for way in ("step", "ramp"):
            dn = screen(way, up)
            frames = np.broadcast_to(dn[:, None, None].astype(np.float32),
                                     (len(dn), *camera.shape))
            times = np.arange(len(dn)) * round(1e6 * SCREEN_DT_S)
            events, noise = simulate(jax.random.fold_in(key, 2 * up + (way == "step")), frames,
                                     times, camera, model=model, labels=True)
            found[f"{polarity} {way}"] = judged(((events.p == up) & ~noise).sum(),
                                                screen_law(model, camera, dn, up))
    return found


def rest_rates(model: SensorModel, camera: Camera) -> np.ndarray:
    """Noise rates at rest, leak apart, mean over the pixels of each vertical band, Hz (2, levels):
    of a few hundred pixels, the few with a very low threshold count."""
    factor = laws.dimmed(LEVELS)
    eta = np.array([np.mean(camera.eta_on), np.mean(camera.eta_off)])[:, None]
    weight = shot_weight(camera).reshape(2, camera.shape[0], len(LEVELS), -1)
    shot = 0.5 * model.shot_hz * weight.mean((1, 3))
    return (eta / factor.mean() + shot) * factor


def rest_law(model: SensorModel, camera: Camera, seconds: float) -> np.ndarray:
    """Expected events per pixel of a scene at rest, (2, levels)."""
    if model.kind == "voltmeter":
        theta = np.ravel(camera.theta_on)[:1].astype(float)  # these sensors have no mismatch
        on = [laws.diffused(model.voltmeter, theta, dn, seconds)[0] for dn in LEVELS]
        return np.stack([on, np.zeros(len(on))])
    rates = rest_rates(model, camera)
    leak = [laws.leaked(model, float(hz), seconds) for hz in rates.sum(0)]
    return rates * seconds + np.stack([leak, np.zeros(len(leak))])


def duration(model: SensorModel, camera: Camera, options: Options) -> float:
    """Seconds in which each of the noise sources sends `events` at each luminance."""
    pixels = options.size**2 / len(LEVELS)
    hz = rest_law(model, camera, 3000.0) / 3000.0
    return float(np.clip(options.events / pixels / hz[hz > 0.005].min(), 5.0, 3000.0))


def figure_five(key: jax.Array, options: Options, name: str, row: int) -> dict[str, Any]:
    """Noise of vertical bands at rest, by luminance."""
    k_camera, key = jax.random.split(key)
    camera, model = camera_of(k_camera, name, row, options.size, spread=False), model_of(name)
    seconds = duration(model, camera, options)
    times = np.linspace(0, seconds * 1e6, options.intervals + 1).round().astype(np.int64)
    band = np.repeat(LEVELS, options.size // len(LEVELS)).astype(np.float32)
    frames = np.broadcast_to(band, (len(times), *camera.shape))
    counts = simulate(key, frames, times, camera, model=model).count_map()
    counts = counts.reshape(2, options.size, len(LEVELS), -1).sum((1, 3))
    pixels = options.size**2 / len(LEVELS)
    law = rest_law(model, camera, seconds) * pixels
    return {"seconds": seconds, "pixels": pixels,
            **{p: [judged(*pair) for pair in zip(counts[i], law[i], strict=True)]
               for i, p in enumerate(("on", "off"))}}


def totals(result: dict[str, Any]) -> dict[str, dict[str, float]]:
    """What is judged, where the law gives at least JUDGED events: each screen, and of the noise
    of each sensor and polarity the sums over luminance and the sums over thresholds."""
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
    """Table II as ratios to SCP 161, then what deviates."""
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
                result["table II"][name].append(table_two(k_step, options, name, row))
                result["figure 5"][name].append(figure_five(k_rest, options, name, row))
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

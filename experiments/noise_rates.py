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

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from evflow import Recording, load_weights, simulate
from evflow.baselines import v2e_noise, voltmeter_noise
from evflow.camera import Summary, noise_of_threshold, sample_pixels
from evflow.camera.sensors import SENSORS, SensorModel
from evflow.light.log_maps import noise_factor, normalised_intensity
from evflow.process.terminal import bar
from evflow.report import plots
from experiments.shared import alone
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.images import mean_ci
from experiments.shared.measured_noise import SIDES, Rates, measured, measured_page, ours
from experiments.shared.table_two import LUX, MIDDLE, SCP, TABLE_TWO

MODELS = {"eq12": SensorModel(eta_intensity=True), "dvs346": SENSORS["dvs346"].model}
SCENES = ("flat", "still", "moving")
SYSTEMS = ("v2e, r = 1", "v2e", "evolt", "evolt, θ", "constant", "counting",
           *alone.RATES, "ours")
THETA = np.stack([TABLE_TWO[p][:, 0] for p in ("on", "off")], -1)  # (6, 2)
SIGMA = 0.03  # mismatch, log units: v2e's default
DN = LUX / 20.0  # 4000 lx are 200 DN: a texture about them is not saturated
BENCH = (MIDDLE, 3)  # threshold, luminance: the one known rate of "v2e" and "constant"
NOMINAL = SENSORS["v2e"].theta  # the threshold at which v2e's rate is r / 2
WARM_US, WARM = 100_000_000, 10  # before the recording: leaks of all pixels get out of step
FLAT_S, FRAME_MS, INTERVALS = 10, 40, 24
TEXTURE, DISC, RADIUS, SPEED = 0.2, 0.5, 8.0, 40.0  # contrast, brightness; px, px/s
FRAME_NOISE_DN = 0.5
# Table IV, ON and OFF in Hz. V2E's mean over both cameras is printed as .032, .075; it is .082.
PAPER = {"v2e": {"CeleX5": (0.077, 0.069), "DAVIS346": (0.087, 0.081)},
         "evolt": {"DAVIS346": (0.083, 0.107)},
         "ours": {"CeleX5": (0.037, 0.033), "DAVIS346": (0.026, 0.030)}}
MARKS = {"flat": "o", "still": "s", "moving": "^"}
NOTE = ("v2e: r of the bench, rate as 1 / θ about θ = .2; evolt: the published DAVIS346; evolt, θ: "
        "at the nominal thresholds; constant: the bench's rates everywhere; counting: all events. "
        "± is the 95 % interval over seeds; the paper's figures are of other sensors.")


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


def law(sensor: str, theta: Any, dn: Any) -> np.ndarray:
    """Noise rates (2, ...) in Hz of a sensor at thresholds (ON, OFF) and luminance; broadcasts."""
    if sensor == "dvs346":
        return np.stack(voltmeter_noise(dn, theta[0], theta[1]))
    factor = noise_factor(normalised_intensity(jnp.asarray(dn, jnp.float32)))
    return np.stack([noise_of_threshold(jnp.float32(t)) * factor for t in theta])


def closed_forms(theta: np.ndarray, dn: float, bench: np.ndarray) -> Rates:
    """What simulators say of nominal thresholds (2,) in this light. bench: rates (2,) of BENCH."""
    def shot(thresholds: np.ndarray, light: float) -> np.ndarray:
        return np.array([float(v2e_noise(t, light, nominal=NOMINAL)) for t in thresholds])

    rate = bench.sum() / shot(THETA[BENCH[0]], DN[BENCH[1]]).sum()
    one = shot(theta, dn)
    return {"v2e, r = 1": one, "v2e": rate * one, "constant": bench,
            "evolt": np.array([float(r) for r in voltmeter_noise(dn)]),
            "evolt, θ": np.array([float(r) for r in voltmeter_noise(dn, *theta)])}


def video(key: jax.Array, scene: str, dn: float, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T, H, W) in DN and their times in us, from 0."""
    if scene == "flat":
        return (np.full((FLAT_S + 1, size, size), dn, np.float32),
                1_000_000 * np.arange(FLAT_S + 1))
    k_texture, k_turn = jax.random.split(key)
    texture = cv2.GaussianBlur(np.array(jax.random.normal(k_texture, (size, size))), (0, 0), 2.0)
    texture -= texture.mean()
    back = dn * (1 + TEXTURE * texture / np.abs(texture).max())
    if scene == "still":
        frames = np.broadcast_to(back, (INTERVALS + 1, size, size))
        return frames, 1000 * FRAME_MS * np.arange(INTERVALS + 1)
    times = 1000 * np.arange(FRAME_MS * INTERVALS + 1)
    y, x = np.mgrid[:size, :size].astype(np.float32)
    centre = 0.2 * size + SPEED * 1e-6 * times[:, None, None].astype(np.float32)
    away = np.hypot(x - centre, y - size / 2) - RADIUS
    inside = np.clip(0.5 - away, 0, 1)
    frames = np.rot90(back * (1 - inside) + DISC * dn * inside,
                      int(jax.random.randint(k_turn, (), 0, 4)), (1, 2))
    return np.ascontiguousarray(frames, np.float32), times


def record(
    key: jax.Array, sensor: str, scene: str, theta: np.ndarray, dn: float, size: int
) -> tuple[Recording, np.ndarray]:
    """A recording of a camera that has been running, and its noise: mean rates (2,) in Hz."""
    k_video, k_pixels, k_events, k_frames = jax.random.split(key, 4)
    frames, times = video(k_video, scene, dn, size)
    nominal = (jnp.float32(v) for v in (*theta, 0.0, 0.0, SIGMA, SIGMA))
    camera = sample_pixels(k_pixels, Summary(*nominal), (size, size))
    known = theta if sensor == "eq12" else (camera.theta_on, camera.theta_off)
    truth = law(sensor, known, frames.mean(0)).mean((1, 2))
    if sensor == "eq12":  # else the leak is the sensor's own
        eta = law(sensor, theta, frames[0].mean())
        on, off = (jnp.full(camera.shape, rate) for rate in eta)
        camera = dataclasses.replace(camera, eta_on=on, eta_off=off)
    before = np.broadcast_to(frames[:1], (WARM, size, size))
    clock = np.concatenate([WARM_US // WARM * np.arange(WARM), WARM_US + times])
    events = simulate(k_events, np.concatenate([before, frames]), clock, camera,
                      model=MODELS[sensor]).slice(WARM_US, int(clock[-1]) + 1)
    if scene == "flat":
        return Recording.of_events(events), truth
    kept = slice(None, None, FRAME_MS if scene == "moving" else 1)
    noisy = frames[kept] + FRAME_NOISE_DN * np.asarray(
        jax.random.normal(k_frames, frames[kept].shape))
    gray = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return Recording(events, gray, WARM_US + times[kept]), truth


def counting(recording: Recording) -> np.ndarray:
    """Events per pixel and second (2,), whatever sent them."""
    return recording.events.count_map().mean((1, 2)) / (1e-6 * recording.events.duration_us)


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
            "inside": [float((np.abs(rates["ours"] - rates["truth"]) <= k * rates["std"]).mean())
                       for k in (1, 2)]}


def scored(rates: Rates, name: str) -> dict[str, Any]:
    """Mean |η - truth| over the cells, ON and OFF, with its 95 % interval over seeds; the share of
    cells that the system has an answer for (only these are scored)."""
    error = np.abs(rates[name] - rates["truth"])
    told = np.isfinite(error).all(-1)
    means = np.array([e[t].mean(0) for e, t in zip(error, told, strict=True) if t.any()])
    nothing = (float("nan"), 0.0)
    return {"told": float(told.mean()), **{
        side: mean_ci(means[:, i]) if len(means) else nothing for i, (side, _) in enumerate(SIDES)}}


def table(result: dict[str, Any]) -> str:
    """Markdown: errors of all systems beside the paper's, ours cell by cell, measured data."""
    lines = ["| sensor | scene (cells x seeds) | system | \\|η - truth\\| ON [Hz] | OFF | told | "
             "paper CeleX5 ON, OFF | paper DAVIS346 |", "|" + "---|" * 8]
    for sensor, scenes in result["simulated"].items():
        for scene, one in scenes.items():
            count = f"{len(one['scp']) * len(one['lux'])} x {len(one['rates']['truth'])}"
            for name, row in one["errors"].items():
                paper = [", ".join(f"{v:.3f}" for v in PAPER.get(name, {}).get(camera, ()))
                         for camera in ("CeleX5", "DAVIS346")]
                lines.append(f"| {sensor} | {scene} ({count}) | {name} | " + " | ".join(
                    f"{row[side][0]:.4f} ± {row[side][1]:.4f}" for side, _ in SIDES)
                    + f" | {row['told']:.0%} | {' | '.join(paper)} |")
    lines += ["", NOTE, "", "| ours - truth, ON / OFF [mHz] (truth) | " + " | ".join(
        f"{x} lx" for x in LUX) + " | inside 1, 2 std |", "|" + "---|" * (len(LUX) + 2)]
    for sensor, scenes in result["simulated"].items():
        for scene, one in scenes.items():
            truth, found = (one["rates"][k].mean(0) for k in ("truth", "ours"))
            inside = ", ".join(f"{share:.0%}" for share in one["inside"])
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
        lines += ["", *(f"Ours at {line}" for line in shape["told"])]
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


def plain(value: Any) -> Any:
    """The same with lists in place of arrays."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return value.tolist() if isinstance(value, np.ndarray) else value


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

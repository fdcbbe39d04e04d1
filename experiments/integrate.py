"""Direct integrated images by the thresholds of every system (paper, Table X).

    python -m experiments.integrate --preset debug
    python -m experiments.integrate --recording ijrr/boxes_6dof --span-s 5 20   # IJRR, whole
    python -m experiments.integrate --recording mvsec/indoor_flying1 --span-s 10 70

A frame plus the contrast of the events after it predicts a later frame: the better the thresholds,
the better the image. Scored at 1, 5 and 10 frames and after 1e5 and 5e5 events (the first frame
after them): RMSE and PSNR on 0..255, windowed SSIM (Gaussian, sigma 1.5) and ECC's SSIM of one
window, averaged over images. Thresholds are those of the first half of a recording, images are of
the second; a system's log map is that of its calibration. "ours, maps" is the whole estimate; the
set network, the flow and the paper's flow stand beside it by themselves. "no events" is the old
frame itself. The paper averages over recordings that it names only in part.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from evflow import Recording, estimate_camera, load_weights, read_recording
from evflow.baselines import SYSTEMS
from evflow.baselines.base import usable
from evflow.baselines.integration import Integration
from evflow.camera import Camera, CameraPrior, Summary
from evflow.errors import EvflowDataError
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes import SceneConfig, make_bank
from experiments.shared import alone
from experiments.shared.cameras import Protocol, hidden_recording
from experiments.shared.change_systems import cut
from experiments.shared.common import begin, conclude, run_script
from experiments.shared.images import SCORES, mean_ci, score
from experiments.shared.recordings import held_recordings

HORIZONS = {"1 frame": 1, "5 frames": 5, "10 frames": 10, "1e5 events": 100_000,
            "5e5 events": 500_000}  # frames, or events from 1000 on
SIZES = {"DAVIS240": (180, 240), "DAVIS346": (260, 346), "VGA": (480, 640)}
SCENE = SceneConfig(speed_px_s=(60.0, 300.0), static_fraction=0.0, contrast=(0.6, 1.0))
PAPER = {  # Table X: RMSE, PSNR, SSIM
    "DAVIS240": {"ecc": (37.56, 16.82, .41), "s2r": (32.37, 18.10, .45),
                 "jaer": (35.10, 17.39, .42), "lgan": (32.30, 18.15, .42),
                 "ours, maps": (32.24, 18.17, .42)},
    "DAVIS346": {"ecc": (54.81, 13.75, .33), "s2r": (50.55, 14.45, .35),
                 "jaer": (57.72, 13.42, .34), "lgan": (45.73, 15.29, .36),
                 "ours, maps": (39.76, 16.37, .37)}}
# In the picture, beside the systems that were asked for
SHOWN = ("no events", "default .2", "ecc", "ecc median", "ours, maps")


@dataclasses.dataclass(frozen=True)
class Options:
    """Score direct integrated images."""

    preset: Literal["debug", "full"] = "debug"
    recording: tuple[Path, ...] = ()
    """Recordings with frames (default: those under $EVFLOW_DATA, and simulated ones)."""
    span_s: tuple[float, float] | None = None
    """Seconds of the recordings to use, from their first frame."""
    systems: tuple[str, ...] = ()
    """Systems of evflow.baselines to compare (default: the preset's)."""
    weights: str = "default"
    out: Path = Path("out/integrate")
    seed: int = 9_000_003
    seeds: int | None = None
    """Simulated cameras of each size (default: the preset's)."""
    held_out: bool = True
    """Calibrate on the first half of a recording, score on the second; else, and where it is too
    short, both on all of it ("in sample"), as published: per-pixel fits gain most by that."""
    images: int = 24
    """Images per recording and horizon at most, evenly spread."""


LEAST = 4  # usable intervals of a half: fewer tell no thresholds
QUICK = ("ecc", "ecc offset 40", "ecc median", "jaer normalised", "s2r")
# All but what learns from each recording for minutes; `--systems lgan` asks for that.
EACH = tuple(name for name, system in SYSTEMS.items() if math.isinf(system.most_recordings))


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A recording and, where it was simulated, its true camera. camera: its row of Table X."""

    name: str
    camera: str
    recording: Recording
    truth: Camera | None = None
    nominal: Summary | None = None


def cases(options: Options) -> Iterator[Case]:
    """Real recordings, then simulated ones of cameras of each size (debug: one, and a small
    one)."""
    full = options.preset == "full"
    for path in options.recording or held_recordings()[:None if full else 1]:
        recording = cut(read_recording(path), options.span_s)
        kind = {240: "DAVIS240", 346: "DAVIS346"}.get(recording.events.size[0], "")
        yield Case(path.stem, kind, recording)
    if options.recording:
        return
    k_bank, k_data = jax.random.split(jax.random.key(options.seed))
    bank = make_bank(k_bank, 96, photos=False)
    prior = CameraPrior(theta=(0.1, 0.4), mismatch=(0.03, 0.03))
    for size, (kind, shape) in enumerate(SIZES.items() if full else [("DAVIS240", (90, 120))]):
        protocol = Protocol(prior=prior, scene=SCENE, shape=shape, intervals=12)
        for seed in range(options.seeds or (5 if full else 3)):
            key = jax.random.fold_in(jax.random.fold_in(k_data, size), seed)
            hidden = hidden_recording(key, bank, protocol)
            yield Case(f"simulated {shape[1]}x{shape[0]}", kind, hidden.recording,
                       hidden.camera, hidden.nominal)


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """The recording up to the middle of its usable frames, and from it on."""
    times, events, good = recording.frame_times, recording.events, usable(recording)
    middle = good[len(good) // 2]
    cuts = (min(times[0], events.t[0]), times[middle], max(times[-1], events.t[-1]))
    first, second = (events.slice(int(a) + late, int(b) + 1)
                     for a, b, late in ((cuts[0], cuts[1], 0), (cuts[1], cuts[2], 1)))
    return (Recording(first, recording.frames[:middle + 1], times[:middle + 1]),
            Recording(second, recording.frames[middle:], times[middle:]))


@dataclasses.dataclass(frozen=True, eq=False)
class Thresholds:
    """A camera to integrate with (None: no events at all), its log map's offset, and for how many
    seconds it was sought."""

    camera: Camera | None
    offset_dn: float = 0.0
    seconds: float = 0.0


def thresholds(
    case: Case, part: Recording, params: Any, systems: tuple[str, ...]
) -> dict[str, Thresholds]:
    """By name; measured on a part of the recording, or all of it."""
    shape = part.frames.shape[1:]
    found = {"no events": Thresholds(None), "default .2": Thresholds(Camera.constant(shape))}
    for name in systems:
        fitted = SYSTEMS[name].fit(part)
        found[name] = Thresholds(fitted.camera, getattr(SYSTEMS[name], "offset_dn", 0.0),
                                 fitted.seconds)
    ours = estimate_camera(part, params)
    found |= {name: Thresholds(fitted.camera)
              for name, fitted in alone.fitted(params, part, ours).items() if name != alone.SUMMARY}
    found["ours, summary"] = Thresholds(constant(shape, ours.summary))
    found["ours, maps"] = Thresholds(ours.camera)
    if case.truth is not None and case.nominal is not None:
        found["true, nominal"] = Thresholds(constant(shape, case.nominal))
        found["true, maps"] = Thresholds(case.truth)
    return found


def constant(shape: tuple[int, ...], summary: Summary) -> Camera:
    return Camera.constant(shape, float(summary.theta_on), float(summary.theta_off))


def spans(recording: Recording, horizon: int, most: int) -> list[tuple[int, int]]:
    """(first, last) frames of the images of a horizon: through usable intervals only."""
    good = set(usable(recording))
    at = np.searchsorted(recording.events.t, recording.frame_times, side="right")
    found = []
    for first in sorted(good):
        last = (first + horizon if horizon < 1000
                else int(np.searchsorted(at, at[first] + horizon)))
        if last < len(at) and all(i in good for i in range(first, last)):
            found.append((first, last))
    step = np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(int)
    return [found[i] for i in step]


def image(recording: Recording, span: tuple[int, int], by: Thresholds) -> np.ndarray:
    """The frame at the end of a span (H, W) as predicted from the one at its begin."""
    frame = recording.frame_dn(span[0])
    if by.camera is None:
        return frame
    t0, t1 = (int(recording.frame_times[i]) for i in span)
    events = recording.events.slice(t0 + 1, t1 + 1)
    return Integration(by.offset_dn).reconstruct(
        events, frame[None], np.array([t0]), by.camera, np.array([t1]))[0]


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
                lines.append(f"| {name} | {' | '.join(values)} | {row['seconds']:.1f} | {paper} |")
    return "\n".join(lines)


def picture(out: Path, shown: list[tuple[str, np.ndarray, dict[str, np.ndarray]]]) -> None:
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


def scored(case: Case, by: dict[str, Thresholds], most: int) -> dict[str, dict[str, list[float]]]:
    """Mean scores of each system at each horizon that the recording is long enough for."""
    rows: dict[str, dict[str, list[float]]] = {}
    for horizon, amount in HORIZONS.items():
        chosen = spans(case.recording, amount, most)
        for name, one in by.items() if chosen else ():
            images = np.stack([image(case.recording, span, one) for span in chosen])
            frames = np.stack([case.recording.frame_dn(span[1]) for span in chosen])
            means = score(images, frames).mean(0).tolist()
            rows.setdefault(horizon, {})[name] = [*means, len(chosen)]
    return rows


def main(options: Options) -> dict[str, Any]:
    begin(options, "integrate")
    plots.require()
    params = load_weights(options.weights)
    systems = options.systems or (QUICK if options.preset == "debug" else EACH)
    unknown = sorted(set(systems) - set(SYSTEMS))
    if unknown:
        raise EvflowDataError("EV020", f"systems {unknown}.", f"Choose from {sorted(SYSTEMS)}.")
    seen = (*SHOWN, *options.systems)
    collected: dict[str, dict[str, dict[str, list[Any]]]] = {}
    shown: dict[str, tuple[str, np.ndarray, dict[str, np.ndarray]]] = {}
    with bar("recordings") as progress:
        for number, case in enumerate(cases(options), 1):
            part, title = case.recording, f"{case.name} (in sample)"
            if options.held_out and len(usable(part)) >= 2 * LEAST:
                part, rest = halves(part)
                case, title = dataclasses.replace(case, recording=rest), case.name
            by = thresholds(case, part, params, systems)
            group = f"{title}, {case.camera}"
            for horizon, row in scored(case, by, options.images).items():
                for name, values in row.items():
                    place = collected.setdefault(group, {}).setdefault(horizon, {})
                    place.setdefault(name, []).append([*values, by[name].seconds])
            chosen = spans(case.recording, 5, 1) or spans(case.recording, 1, 1)
            if chosen and group not in shown:
                shown[group] = (case.name, case.recording.frame_dn(chosen[0][1]), {
                    n: image(case.recording, chosen[0], by[n]) for n in by if n in seen})
            progress(number, number)
    result = {group: {horizon: {name: {
        **{s: mean_ci(np.array(found)[:, i]) for i, s in enumerate(SCORES)},
        "images": sum(r[-2] for r in found), "seconds": float(np.mean([r[-1] for r in found]))}
        for name, found in row.items()} for horizon, row in horizons.items()}
        for group, horizons in collected.items()}
    conclude(options, "integrate", result, table(result))
    picture(options.out / "integrate.png", list(shown.values()))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""Thresholds of the compared systems on the same recordings (paper, Table III).

    python -m experiments.compare_systems --preset debug
    python -m experiments.compare_systems --preset full --data data/recordings

The held-out recordings of `experiments.evaluate` (64x64, 8-bit frames every 25 ms), .2 s as there
and 1 s, at both mismatches: the first `sequences` of them with 200 signal events of each polarity.
Every system of `evflow.baselines.SYSTEMS` (LGAN, which learns from each recording for a minute, on
six of them; in debug for 20 iterations), `estimate_camera` and its parts by themselves (the set
network, the flow, the summary in every pixel, and the paper's flow), the constant .3, and MATCH
with the true 1000 frames/s video (no method that sees the frames alone can do as well). Scored per
polarity: `mae_sequence` (map against the sequence's value: the paper's footnote 1), `mae_pixel`
(map against each pixel's own), and |median - θ|. What a system cannot tell counts with the value
it gives; `told` is the share of recordings where it told both.

Real recordings have no truth: each system sees the first half of the frames, and its thresholds
foretell the changes between the frames of the second half, beside a regression on those changes
themselves. That favours least squares, whose criterion it is: what counts cannot explain (noise,
blur, a gamma of the frames) makes the best two numbers for it no thresholds. It describes, it does
not rank. Writes compare_systems.json, .md and .png.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from evflow import Recording, estimate_camera, load_weights, read_recording
from evflow.baselines import SYSTEMS, Fitted, Lgan, Match, System
from evflow.baselines.base import intervals, usable
from evflow.camera import Camera
from evflow.errors import EvflowDataError
from evflow.report import plots
from experiments.shared import alone
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.many import Setup, scores
from experiments.shared.protocols import ENOUGH, protocols

OURS, CONSTANT, KNOWN = "ours", "constant .3", "match, true video"
POLARITIES = ("on", "off")
METRICS = ("mae_sequence", "mae_pixel", "median")
# Table III, synthetic data, ON and OFF.
PAPER = {"ecc": (0.043, 0.128), "s2r": (0.049, 0.131), "jaer": (0.025, 0.055),
         "lgan": (0.117, 0.128), OURS: (0.023, 0.022)}
REAL = ("newton_cradle_davis346.aedat4", "ijrr_slider_depth")
CHANGED = 0.1  # log units: pixels that change by less between two frames say little
SMOOTH = 1.0  # pixels: frames and counts are blurred alike, against noise and misregistration


@dataclasses.dataclass(frozen=True)
class Options:
    """Compare all systems."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/compare_systems")
    seed: int = 1_000_003
    """The recordings of `experiments.evaluate`."""
    sequences: int | None = None
    """Recordings per row (default: the preset's)."""
    data: Path | None = None
    """Folder with the real recordings; left out without it."""


def rows(options: Options) -> dict[str, Protocol]:
    """Protocols by name: those of `evaluate` at both mismatches, and the same for a second."""
    known = protocols()
    found = {f"{m}, .2 s": known[m] for m in ("0.03", "0.15")}
    if options.preset == "full":
        found |= {f"{m}, 1 s": dataclasses.replace(known[m], intervals=40)
                  for m in ("0.03", "0.15")}
    return found


def systems_of(options: Options) -> dict[str, System]:
    """What is compared; a debug run does not wait for what learns."""
    if options.preset == "full":
        return SYSTEMS
    return SYSTEMS | {"lgan": Lgan(iterations=20)}


def all_fits(params: Any, recording: Recording, systems: dict[str, System]) -> dict[str, Fitted]:
    """Every system and ours on one recording."""
    return {name: s.fit(recording) for name, s in systems.items()} | ours(params, recording)


def ours(params: Any, recording: Recording) -> dict[str, Fitted]:
    """`estimate_camera` as one of the systems, whose thresholds are those of the summary, after
    what is in it by itself."""
    start = time.perf_counter()
    span = min(40_000, int(recording.frame_times[-1] - recording.frame_times[0]))
    found = estimate_camera(recording, params, min_window_us=span)
    seconds = time.perf_counter() - start
    theta = np.array([float(found.summary.theta_on), float(found.summary.theta_off)])
    return alone.fitted(params, recording, found, span) | {
        OURS: Fitted(found.camera, np.stack([found.valid] * 2), theta, seconds)}


def flat(recording: Recording, theta: float) -> Fitted:
    """A constant, as one of the systems."""
    width, height = recording.events.size
    return Fitted(Camera.constant((height, width), theta, theta),
                  np.zeros((2, height, width), bool), np.full(2, theta), 0.0)


def lively(_params: Any, hidden: Hidden, _protocol: Protocol) -> Hidden | None:
    """A recording with enough events of both polarities."""
    return hidden if (hidden.signal_events() >= ENOUGH).all() else None


def score(params: Any, hidden: Hidden, systems: dict[str, System]) -> dict[str, Any]:
    """Errors of every system on one recording."""
    recording = hidden.recording
    fits = all_fits(params, recording, systems)
    fits[CONSTANT] = flat(recording, 0.3)
    dense = Recording(recording.events, hidden.video.astype(np.float32),
                      1000 * np.arange(len(hidden.video)))
    fits[KNOWN] = Match("given", start="fresh").fit(dense)
    result: dict[str, Any] = {"signal": hidden.signal_events().tolist()}
    for name, fit in fits.items():
        row: dict[str, Any] = {"seconds": fit.seconds, "told": bool(fit.found.all())}
        for i, polarity in enumerate(POLARITIES):
            seen = np.asarray(getattr(fit.camera, f"theta_{polarity}"))
            pixels = np.asarray(getattr(hidden.camera, f"theta_{polarity}"))
            true = float(getattr(hidden.nominal, f"theta_{polarity}"))
            row |= {f"mae_sequence/{polarity}": float(np.abs(seen - true).mean()),
                    f"mae_pixel/{polarity}": float(np.abs(seen - pixels).mean()),
                    f"median/{polarity}": float(abs(fit.theta[i] - true)),
                    f"signed/{polarity}": float(fit.theta[i] - true)}
        result[name] = row
    return result


def averages(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Means per system over its recordings, with the standard error of |median - θ|."""
    result: dict[str, Any] = {}
    for name in (n for n in found[0] if n != "signal"):
        mine = [r[name] for r in found if name in r]
        one = {k: float(np.mean([r[k] for r in mine])) for k in mine[0] if "/" in k}
        one |= {f"error/{p}": float(np.std([r[f"median/{p}"] for r in mine])
                                    / np.sqrt(len(mine))) for p in POLARITIES}
        # A median: the first recording compiles.
        one["seconds"] = float(np.median([r["seconds"] for r in mine]))
        one["told"] = float(np.mean([r["told"] for r in mine]))
        result[name] = one | {"recordings": len(mine)}
    return result


def halves(recording: Recording) -> tuple[Recording, Recording]:
    """The usable part of a recording before and from its middle frame on: they share that frame
    and no event."""
    found, events = usable(recording), recording.events
    cuts = [found[0], found[(len(found) + 1) // 2], found[-1] + 1]
    times = recording.frame_times
    first, second = (
        Recording(events.slice(int(times[a]), int(times[b])), recording.frames[a:b + 1],
                  times[a:b + 1]) for a, b in itertools.pairwise(cuts))
    return first, second


def changes(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """ON and OFF events (N, 2, H, W) and log changes (N, H, W) between usable frames, blurred."""
    parts = [(p.counts, p.after - p.before) for p in intervals(recording)]
    n, d = (np.stack(x) for x in zip(*parts, strict=True))
    return np.stack([[blurred(c) for c in pair] for pair in n]), np.stack([blurred(x) for x in d])


def blurred(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(np.ascontiguousarray(image, np.float32), (0, 0), SMOOTH)


def held_out(
    params: Any, recording: Recording, systems: dict[str, System]
) -> dict[str, Any]:
    """Each system's thresholds from the first half, and how well they foretell the second:
    residual over the change, root mean squares, of pixels that changed; `frame regression` is
    fitted to the second half itself and bounds what two numbers can do."""
    first, second = halves(recording)
    n, d = changes(second)
    used = np.abs(d) > CHANGED
    design = np.stack([n[:, 0][used], -n[:, 1][used]], -1).astype(np.float64)
    best, *_ = np.linalg.lstsq(design, d[used].astype(np.float64), rcond=None)
    size = float(np.sqrt(np.mean(d[used] ** 2)))

    def left(on: np.ndarray, off: np.ndarray) -> float:
        rest = d - carried(n, on, off)
        return float(np.sqrt(np.mean(rest[used] ** 2)) / size)

    result = {"frame regression": {"theta": best.tolist(), "left": left(*(np.full(
        d.shape[1:], t, np.float32) for t in best)), "seconds": 0.0, "notes": [
            f"{used.sum()} changes of {len(usable(second))} frame intervals"]}}
    for name, fit in all_fits(params, first, systems).items():
        maps = (np.asarray(getattr(fit.camera, f"theta_{p}")) for p in POLARITIES)
        result[name] = {"theta": fit.theta.tolist(), "left": left(*maps),
                        "seconds": fit.seconds, "notes": list(fit.notes)}
    return result


def carried(n: np.ndarray, on: np.ndarray, off: np.ndarray) -> np.ndarray:
    """What the events carry (N, H, W) at thresholds (H, W)."""
    return n[:, 0] * on[None] - n[:, 1] * off[None]


def table(result: dict[str, Any]) -> str:
    """Markdown: a table of the simulated recordings, one of each real recording."""
    lines = ["| recordings | system | \\|median - θ\\| ON | OFF | mae_sequence ON | OFF | "
             "mae_pixel ON | OFF | bias ON | OFF | told | s | paper ON | OFF |",
             "|" + "---|" * 14]
    for protocol, systems in result["simulated"].items():
        for name, r in systems.items():
            paper = PAPER.get(name)
            cells = [f"{r[f'median/{p}']:.3f} ± {r[f'error/{p}']:.3f}" for p in POLARITIES]
            cells += [f"{r[f'{m}/{p}']:.3f}" for m in METRICS[:2] for p in POLARITIES]
            cells += [f"{r[f'signed/{p}']:+.3f}" for p in POLARITIES]
            cells += [f"{r['told']:.0%}", f"{r['seconds']:.2f}"]
            cells += [f"{x:.3f}" for x in paper] if paper else ["", ""]
            lines.append(f"| {protocol} ({r['recordings']}) | {name} | {' | '.join(cells)} |")
    for recording, systems in result["real"].items():
        lines += ["", f"| {recording} | θ ON | θ OFF | change left over | s |", "|" + "---|" * 5]
        lines += [f"| {name} | {r['theta'][0]:.3f} | {r['theta'][1]:.3f} | {r['left']:.1%} | "
                  f"{r['seconds']:.2f} |" for name, r in systems.items()]
    return "\n".join(lines)


def picture(result: dict[str, Any], path: Path) -> None:
    """|median - θ| of every system, one panel per protocol; crosses are the paper's figures,
    which are of mae_sequence."""
    panels = result["simulated"]
    figure = plots.new_figure(5.5 * len(panels), 5.5)
    axes = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
    for axis, (protocol, systems) in zip(axes, panels.items(), strict=True):
        names = list(systems)[::-1]
        for i, (p, colour) in enumerate(zip(POLARITIES, (plots.ON_COLOUR, plots.OFF_COLOUR),
                                            strict=True)):
            y = np.arange(len(names)) + 0.2 * (0.5 - i)
            axis.errorbar([systems[n][f"median/{p}"] for n in names], y,
                          xerr=[systems[n][f"error/{p}"] for n in names], fmt="o", color=colour,
                          label=f"θ {p.upper()}")
            known = [(PAPER[n][i], at) for n, at in zip(names, y, strict=True) if n in PAPER]
            axis.plot(*zip(*known, strict=True), "x", color=colour)
        axis.set_yticks(np.arange(len(names)), names)
        axis.set_xscale("log")
        axis.set_xlabel("|median − θ|  (x: paper, mae_sequence)")
        axis.set_title(f"mismatch {protocol}")
        axis.grid(alpha=0.3)
    axes[0].legend()
    plots.save_figure(figure, path)


def main(options: Options) -> dict[str, Any]:
    begin(options, "compare_systems")
    plots.require()
    if options.data is not None and not options.data.is_dir():
        raise EvflowDataError("EV016", f"there is no folder {options.data}.", "Check --data.")
    count = options.sequences or {"debug": 3, "full": 30}[options.preset]
    setup, params = Setup(options.weights, options.seed), load_weights(options.weights)
    systems = systems_of(options)
    result: dict[str, Any] = {"simulated": {}, "real": {}}
    for name, protocol in rows(options).items():
        jobs = [(i, protocol) for i in range(4 * count)]
        drawn = (h for h in scores(lively, setup, jobs, 1, f"mismatch {name}") if h is not None)
        result["simulated"][name] = averages([
            score(params, hidden, {n: s for n, s in systems.items() if i < s.most_recordings})
            for i, hidden in enumerate(itertools.islice(drawn, count))])
    if options.data is not None:
        for name in REAL:
            try:
                recording = read_recording(options.data / name)
            except EvflowDataError as error:
                print(f"{name} left out: {error}")
                continue
            result["real"][name] = held_out(params, recording, systems)
    text = table(result)
    print(text)
    config = dataclasses.asdict(options) | {"systems": {k: repr(v) for k, v in systems.items()}}
    write_result(options.out / "compare_systems.json", result, config)
    write_text(options.out / "compare_systems.md", text)
    picture(result, options.out / "compare_systems.png")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

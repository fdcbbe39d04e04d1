"""Events of a video of 30 frames/s against those of what it shows, seen at 32 times the rate.

    python -m experiments.between_frames --preset debug
    python -m experiments.between_frames --preset full --workers 2 --rows rows.jsonl

Photographs and textures move by known amounts; their frames, 8 bit, are faded into each other,
warped bilinearly along straight paths in steps of a pixel, or filled up by `upsample`, and
simulated by the camera that sees the dense video. Columns: share of the dense events, mean and
range over pictures, and where an object's edge goes; rate by the phase of a frame over the dense
one, least and most of 16 (1 is no comb); amplitude at the frame rate and its double, in per cent of
the mean rate, that the dense events lack; correlation of counts per pixel; share of the intervals
whose flow a note tells of. Writes between_frames.json, .md and .png.
"""

from __future__ import annotations

import dataclasses
import itertools
import operator
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from evflow import Camera, Events
from evflow.camera import CameraPrior
from evflow.process.workers import worker_pool
from evflow.report import plots
from evflow.simulator import simulate_stream
from evflow.simulator.between import intervals
from evflow.simulator.interpolate import FAILED, unzip, upsample
from experiments.shared.common import begin, conclude, markdown, run_script
from experiments.shared.kept import resumed
from experiments.shared.moving import WAYS, Pairs, Seen, moving, pictures, scores, seen, video

Scene = tuple[str, str, float, tuple[int, int]]  # motion, picture, speed, size

FRAMES = {"debug": 4, "full": 12}
SMALL, LARGE = (346, 260), (640, 480)
PICTURES = ("coffee", "discs")
FEWER = 1  # pictures, in large frames and of what is hard
SPEEDS = (5.0, 10.0, 20.0, 30.0)  # pixels per frame
EASY = ("pan", "hand", "turn", "object")
HARD = {"crossing": SPEEDS, "rotation": (5.0, 10.0, 15.0, 20.0), "zoom": (2.0, 5.0, 10.0, 15.0)}
UNITS = {"rotation": "°", "zoom": " %"}
DENSE, STEP_PX = 32, 0.6  # of the dense video: times the frame rate, and what moves in a step


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Measure what lies between the frames."""

    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/between_frames")
    seed: int = 0
    workers: int = 1
    """Processes side by side."""
    rows: Path | None = None
    """Where to keep the rows, to resume an interrupted run from."""


def scenes(preset: str) -> Iterator[Scene]:
    """What moves how; only pictures that are there."""
    if preset == "debug":
        yield from itertools.product(("pan", "hand"), ("camera",), (10.0,), (SMALL,))
        return
    there = [name for name in PICTURES if name in pictures()]
    for motion, speeds in {**dict.fromkeys(EASY, SPEEDS), **HARD}.items():
        some = there if motion in EASY else there[:FEWER]
        for speed, picture in itertools.product(speeds, some):
            yield motion, picture, speed, SMALL
    for motion, speed, picture in itertools.product(EASY, SPEEDS, there[:FEWER]):
        yield motion, picture, speed, LARGE


def measured(scene: Scene, frames: int, seed: int) -> dict[str, Any]:
    """Scores of each way on one scene."""
    motion, picture, speed, size = scene
    prior = CameraPrior((0.2, 0.2), (0.03, 0.03), noise="none")
    camera = Camera.sample(jax.random.key(seed), size[::-1], prior)
    shown = moving(motion, picture, speed, size)
    dense = max(DENSE, round(speed / STEP_PX))

    def simulated(pairs: Pairs) -> Seen:
        made = simulate_stream(jax.random.key(seed), *unzip(iter(pairs)), camera)
        return seen(Events.concatenate(list(made)))

    film = list(video(shown, frames, size, dense))
    truth, swept = simulated(iter(film)), shown.swept(frames, size)
    given = [(np.clip(np.rint(frame), 0, 255).astype(np.uint8), t) for frame, t in film[::dense]]
    whole = [(frame.astype(np.float32), t) for frame, t in given]
    told = [interval.motion.failed > FAILED for interval in intervals(whole)]
    ways = {**WAYS, "evflow": upsample}
    return {"motion": motion, "picture": picture, "speed": speed, "size": f"{size[0]}x{size[1]}",
            "told": float(np.mean(told)),
            **{name: scores(simulated(way(given)), truth, swept) for name, way in ways.items()}}


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
                          f"{np.mean([row['told'] for row in same]):.0%}" * (way == "evflow")))
    return markdown(("motion", "size", "per frame", "between", "events", "at the edge",
                     "rate by phase", "comb, % at 1x / 2x", "r of counts", "told"), lines)


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


def main(options: Options) -> dict[str, Any]:
    begin(options, "between_frames")
    frames, wanted = FRAMES[options.preset], list(scenes(options.preset))
    measure = partial(measured, frames=frames, seed=options.seed)

    with worker_pool(options.workers) as pool:
        def make(left: list[int]) -> Iterable[dict[str, Any]]:
            chosen = [wanted[i] for i in left]
            return map(measure, chosen) if options.workers == 1 else pool.map(measure, chosen)

        rows = resumed(options.rows, [frames, options.seed], [repr(s) for s in wanted], make,
                       "scenes")
    conclude(options, "between_frames", {"rows": rows}, table(rows))
    draw(rows, options.out / "between_frames.png")
    return {"rows": rows}


if __name__ == "__main__":
    run_script(main, Options, __doc__)

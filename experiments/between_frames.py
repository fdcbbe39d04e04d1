"""Events of a video of 30 frames/s against those of what it shows, seen at 32 times the rate.

    python -m experiments.between_frames --preset debug
    python -m experiments.between_frames --preset full --workers 2

Photographs and textures move by known amounts; their frames, 8 bit, are faded into each other,
warped bilinearly along straight paths in steps of a pixel, or filled up by `upsample`, and
simulated by the camera that sees the dense video. Columns: share of the dense events; rate by the
phase of a frame over the dense one, least and most of 16 (1 is no comb); amplitude at the frame
rate and its double, in per cent of the mean rate, that the dense events lack; correlation of
counts per pixel. Writes between_frames.json, .md and .png.
"""

from __future__ import annotations

import dataclasses
import itertools
import operator
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from evflow import Camera, Events
from evflow.camera import CameraPrior
from evflow.process.terminal import bar
from evflow.process.workers import worker_pool
from evflow.report import plots
from evflow.simulator import simulate_stream
from evflow.simulator.interpolate import unzip, upsample
from experiments.shared.common import begin, conclude, markdown, run_script
from experiments.shared.moving import PERIOD_US, WAYS, Pairs, moving, pictures, scores, video

FRAMES = {"debug": 4, "full": 10}
SIZES = {"debug": ((346, 260),), "full": ((346, 260), (640, 480))}
SPEEDS = {"debug": (10.0,), "full": (5.0, 10.0, 20.0, 30.0)}  # pixels per frame
PICTURES = {"debug": ("camera",), "full": ("camera", "coffee", "000000000785", "waves", "discs")}
MOTIONS = {"debug": ("pan", "hand"), "full": ("pan", "hand", "turn", "object")}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Measure what lies between the frames."""

    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/between_frames")
    seed: int = 0
    workers: int = 1
    """Processes side by side."""


def measured(job: tuple[Any, ...]) -> dict[str, Any]:
    """Scores of each way on one scene. job: motion, picture, speed, size, frames, seed."""
    motion, picture, speed, size, count, seed = job
    prior = CameraPrior((0.2, 0.2), (0.03, 0.03), noise="none")
    camera = Camera.sample(jax.random.key(seed), size[::-1], prior)
    dense = max(32, round(speed / 0.6))
    film = video(moving(motion, picture, speed, size), count, size, dense)
    times = np.round(np.arange(len(film)) * PERIOD_US / dense).astype(int).tolist()
    frames = np.clip(np.rint(film[::dense]), 0, 255).astype(np.uint8)

    def seen(pairs: Pairs) -> Events:
        made = simulate_stream(jax.random.key(seed), *unzip(iter(pairs)), camera)
        return Events.concatenate(list(made))

    truth = seen(zip(film, times, strict=True))
    ways, given = {**WAYS, "evflow": upsample}, list(zip(frames, times[::dense], strict=True))
    return {"motion": motion, "picture": picture, "speed": speed, "size": f"{size[0]}x{size[1]}",
            **{name: scores(seen(way(given)), truth) for name, way in ways.items()}}


def table(rows: list[dict[str, Any]]) -> str:
    """The means over pictures."""
    lines = []
    for (motion, size, speed), group in itertools.groupby(
            rows, operator.itemgetter("motion", "size", "speed")):
        same = list(group)
        for way in (*WAYS, "evflow"):
            m = {k: np.mean([row[way][k] for row in same]) for k in same[0][way]}
            lines.append((motion, size, f"{speed:g}", way, f"{m['share']:.3f}",
                          f"{m['least']:.2f}–{m['most']:.2f}",
                          f"{m['at_rate']:.1f} / {m['at_double']:.1f}", f"{m['r']:.3f}"))
    return markdown(("motion", "size", "px/frame", "between", "events", "rate by phase",
                     "comb, % at 1x / 2x", "r of counts"), lines)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Shares of events over speed, a line for each way, of pans and of the other motions."""
    figure = plots.new_figure(8.0, 3.2)
    motions = list(dict.fromkeys(row["motion"] for row in rows))
    for k, motion in enumerate(motions, 1):
        axis = figure.add_subplot(1, len(motions), k)
        for way in (*WAYS, "evflow"):
            points = [(row["speed"], row[way]["share"]) for row in rows if row["motion"] == motion]
            axis.plot(*np.array(sorted(points)).T, ".", label=way)
        axis.set(title=motion, xlabel="pixels per frame", ylim=(0, 1.3))
    axis.legend()
    plots.save_figure(figure, path)


def main(options: Options) -> dict[str, Any]:
    begin(options, "between_frames")
    known, rows = pictures(), list[dict[str, Any]]()
    scenes = itertools.product(*(of[options.preset] for of in (MOTIONS, SIZES, SPEEDS, PICTURES)))
    jobs = [(motion, picture, speed, size, FRAMES[options.preset], options.seed)
            for motion, size, speed, picture in scenes if picture in known]
    with bar("scenes") as progress, worker_pool(options.workers) as pool:
        for row in (map if options.workers == 1 else pool.map)(measured, jobs):
            rows.append(row)
            progress(len(rows), len(jobs))
    conclude(options, "between_frames", {"rows": rows}, table(rows))
    draw(rows, options.out / "between_frames.png")
    return {"rows": rows}


if __name__ == "__main__":
    run_script(main, Options, __doc__)

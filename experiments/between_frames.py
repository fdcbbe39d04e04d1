"""Events of a video of 30 frames/s against those of what it shows, seen at 32 times the rate.

    python -m experiments.between_frames --preset debug
    python -m experiments.between_frames --preset full --workers 2 --rows rows.jsonl

Photographs and textures move by known amounts; their frames, 8 bit, are faded into each other,
warped bilinearly along straight paths in steps of a pixel, or filled up by `upsample`, and
simulated by the camera that sees the dense video. Columns: share of the dense events, mean and
range over pictures, and where an object's edge goes; rate by the phase of a frame over the dense
one, least and most of 16 (1 is no comb); amplitude at the frame rate and its double, in per cent of
the mean rate, that the dense events lack; correlation of counts per pixel; share of the intervals
whose flow a note reports as lost or wrong. Writes between_frames.json, .md and .png.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from evflow import Camera, Events
from evflow.camera import CameraPrior
from evflow.process.workers import worker_pool
from evflow.simulator import simulate_stream
from evflow.simulator.between import intervals
from evflow.simulator.interpolate import FAILED, unzip, upsample
from experiments.shared.between_pages import draw, table
from experiments.shared.common import begin, conclude, run_script
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
    noted = [interval.motion.failed > FAILED for interval in intervals(whole)]
    ways = {**WAYS, "evflow": upsample}
    return {"motion": motion, "picture": picture, "speed": speed, "size": f"{size[0]}x{size[1]}",
            "noted": float(np.mean(noted)),
            **{name: scores(simulated(way(given)), truth, swept) for name, way in ways.items()}}


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

"""Do networks see better if trained for the camera they will use (paper, Tables V, VI, VII, IX)?

    python -m experiments.see_better --preset small
    python -m experiments.see_better --preset small --task flow --out out/flow_better
    python -m experiments.see_better --preset full --max-seconds 25000

The same network is trained for each condition (shared/conditions.py): default parameters, wide
randomisation (thresholds uniform on .1 to 1, and log-uniform on .05 to 1), evflow's estimate of the
target camera from a 2 s recording of it, and the target's true maps (oracle); in `full` also what
the compared systems estimate and, for video, the thresholds of the original E2VID (e2vid), for flow
the target's own recordings (raw). evflow ideal takes pixels for ideal, as the compared systems do.
evflow+circuit and oracle+circuit train with the target's circuit and the light that its frames
lack; all others with one that no target has (shared/targets.py). Seeds are paired: scenes, initial
parameters and batches are the same for all conditions of a seed but raw. Images are scored in the
later windows of held-out scenes, clipped to [0, 1]: SSIM (preset evreal), MSE, PSNR, LPIPS where
installed, and MSE of log(1 + 255 I) / log 256; flow by its error at pixels with events, and FWL
beside that of the true flow. --recordings NAME=PATH: real ones, scored by their frames, or by FWL.

A finished training stays in --out with its scores: the same command goes on with what is missing,
and one that asks for more adds to it. One that asks for less than the tables there is refused.
Tables VII and IX: weights that `experiments.ablate` keeps, as --estimators "8 steps=PATH" ...; any
camera file (maps and circuit) is a condition by --cameras, the generator of `train_eventgan` by
--eventgan. Writes see_better.json, .md, .png and _clips.png.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path
from typing import Any, Literal

from evflow.report import plots
from evflow.training.config import as_dict
from experiments.shared import gains, held_out
from experiments.shared.common import at_least, run_script, write_result, write_text
from experiments.shared.conditions import Files, named_files
from experiments.shared.same_runs import nothing_lost, same_setting
from experiments.shared.see_better_settings import Preset, Setting, Task, heading, preset_of
from experiments.shared.trainings import Trainings


@dataclasses.dataclass(frozen=True)
class Options:
    """Train networks for a camera, and test them on it."""

    out: Path = Path("out/see_better")
    """Folder of the results, the trained networks and the estimates."""
    task: Task = "video"
    preset: Preset = "debug"
    seeds: int | None = None
    """Paired trainings of every condition (default: the preset's)."""
    steps: int | None = None
    """Steps of each training (default: the preset's)."""
    names: tuple[str, ...] = ()
    """Conditions (default: the preset's)."""
    targets: tuple[Literal["high", "low", "middle"], ...] = ()
    """Target cameras (default: the preset's)."""
    circuits: tuple[Literal["noisy", "voltmeter", "esim"], ...] = ()
    """Their circuits (default: noisy)."""
    recordings: tuple[str, ...] = ()
    """Real targets in place of those, NAME=PATH."""
    normalised: bool = False
    """Event tensors of deviation 1, which hide thresholds' scale (flow's in `small` anyway)."""
    cameras: tuple[str, ...] = ()
    """More conditions, NAME=camera.npz, tested on all targets."""
    estimators: tuple[str, ...] = ()
    """More conditions, NAME=weights.safetensors: what their network alone sees."""
    weights: str = "default"
    """Of evflow's estimator."""
    eventgan: tuple[str, ...] = ()
    """More conditions, NAME=generator.safetensors: EventGAN's events, of no camera."""
    max_seconds: float = math.inf
    """Begin no other training after this long."""


def chosen(options: Options) -> Setting:
    """The preset with what the options change; EV020 where they contradict each other."""
    at_least(1, seeds=options.seeds, steps=options.steps)
    setting = preset_of(options.task, options.preset)
    learning = dataclasses.replace(
        setting.learning, normalised=options.normalised or setting.learning.normalised,
        steps=options.steps or setting.learning.steps)
    given: dict[str, Any] = {"names": options.names, "cameras": options.targets,
                             "circuits": options.circuits, "seeds": options.seeds}
    return dataclasses.replace(setting, learning=learning, **{k: v for k, v in given.items() if v})


def main(options: Options) -> dict[str, Any]:
    """Train and test what is missing; returns the tables' figures of all there is."""
    plots.require()
    at_least(0, max_seconds=options.max_seconds)
    began, setting = time.monotonic(), chosen(options)
    runs = Trainings(setting, options.out, options.weights, named_files(options.recordings))
    conditions = runs.conditions(
        Files(*map(named_files, (options.estimators, options.eventgan, options.cameras))))
    same_setting(options.out, options.task, options.weights, setting, runs.lpips is not None)
    nothing_lost(options.out, conditions, setting.seeds)
    left = runs.complete_all(conditions, began + options.max_seconds)
    result = {k: gains.compared(scores) for k, scores in runs.scores(conditions).items()}
    untrained = runs.untrained(options.task)
    report = gains.report(result, options.task, runs.camera_medians(conditions), left, untrained)
    text = f"{heading(options.task, options.preset, setting, len(options.recordings))}\n\n{report}"
    write_result(
        options.out / "see_better.json",
        {"targets": result, "without_network": untrained, "missing": left,
         "scored_by": held_out.scored_by(options.task, runs.lpips is not None)},
        as_dict(options) | {"setting": as_dict(setting)})
    write_text(options.out / "see_better.md", text)
    gains.picture(result, options.out / "see_better.png")
    if options.task == "video":
        gains.examples(runs.examples(conditions, runs.targets[0]),
                       options.out / "see_better_clips.png")
    print(text)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

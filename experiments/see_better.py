"""Do networks see better that were trained on events of the camera they will use (paper, Tables V,
VI, VII and IX)?

    python -m experiments.see_better --preset small
    python -m experiments.see_better --preset small --task flow --out out/flow_better
    python -m experiments.see_better --preset full --max-seconds 25000

The same network is trained for each condition: default parameters, wide randomisation (thresholds
uniform on .1 to 1, and log-uniform on .05 to 1), evflow's estimate of the target camera from a 2 s
recording of it, and the target's true maps (oracle); in `full` also what the compared systems
estimate and, for video, the thresholds of the original E2VID (e2vid), for flow the target's own
recordings, from whose frames EV-FlowNet learns (raw). Seeds are paired: scenes,
initial parameters and batches are the same for all conditions of a seed, only the camera differs
(not so of `raw`). Events for training come from one sensor model, those of the targets from others
(shared/targets.py). Images are scored in the later windows of held-out scenes, clipped to
[0, 1]: SSIM (preset evreal), MSE, PSNR, LPIPS where its weights are installed, and MSE of
log(1 + 255 I) / log 256; flow by its error at pixels with events, and FWL (votes rounded to the
nearest pixel) beside that of the true flow.

A finished training stays in --out with its scores: the same command goes on with what is missing,
and one that asks for more adds to it. One that asks for less than the tables there have is refused.
Tables VII and IX: weights that `experiments.ablate` keeps, as --estimators "8 steps=PATH" ...; any
camera file is a condition by --cameras NAME=PATH, EventGAN by --eventgan eventgan=PATH (the
generator.safetensors of `experiments.train_eventgan`). Writes see_better.json, .md, .png and
_clips.png.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path
from typing import Any, Literal

from evflow.errors import EvflowDataError
from evflow.network.weights import weights_path
from evflow.process.provenance import provenance
from evflow.report import plots
from evflow.training.config import as_dict
from experiments.shared import gains, held_out
from experiments.shared.common import at_least, run_script, write_result, write_text
from experiments.shared.conditions import Files, digest
from experiments.shared.same_runs import nothing_lost, same_setting
from experiments.shared.see_better_settings import Preset, Task, preset_of
from experiments.shared.trainings import Setting, Trainings


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
    normalised: bool = False
    """Event tensors of deviation 1, which hide the scale of thresholds; `small` has them for flow
    in any case."""
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
    learning = setting.learning
    if options.normalised:
        learning = dataclasses.replace(learning, normalised=True)
    if options.steps is not None:
        learning = dataclasses.replace(learning, steps=options.steps)
    given: dict[str, Any] = {"names": options.names, "cameras": options.targets,
                             "circuits": options.circuits, "seeds": options.seeds}
    return dataclasses.replace(
        setting, learning=learning, **{k: v for k, v in given.items() if v})


def files(given: tuple[str, ...]) -> dict[str, Path]:
    """NAME=PATH by name; EV020 for anything else."""
    found: dict[str, Path] = {}
    for entry in given:
        name, _, path = entry.partition("=")
        if not name or not path or name in found:
            raise EvflowDataError("EV020", f"{entry!r}.", "Give NAME=PATH, each name once.")
        found[name] = Path(path)
    return found


def heading(options: Options, setting: Setting) -> str:
    """What was trained how, on what."""
    learning, made = setting.learning, provenance()
    data = learning.data
    return (f"# {options.task}, preset {options.preset}\n\n"
            f"{type(setting.network).__name__} of base {setting.network.base}, {setting.seeds} "
            f"seeds, {learning.steps} steps of {data.sequences} sequences of {data.windows} windows"
            f" of {1e3 * data.window_s:g} ms at {data.crop} px; {setting.scenes} held-out clips. "
            f"evflow {made['evflow']}, jax {made['versions']['jax']}, "
            f"{made['machine']['device']}, {made['machine']['cpus']} CPUs.")


def main(options: Options) -> dict[str, Any]:
    """Train and test what is missing; returns the tables' figures of all there is."""
    plots.require()
    began, setting = time.monotonic(), chosen(options)
    shared = {"task": options.task, "weights": options.weights,
              "estimator": digest(weights_path(options.weights))}
    runs = Trainings(setting, options.out, options.weights)
    conditions = runs.conditions(
        Files(*map(files, (options.estimators, options.eventgan, options.cameras))))
    same_setting(options.out, shared, setting)
    nothing_lost(options.out, conditions, setting.seeds)
    left = setting.seeds * len(conditions)
    for seed in range(setting.seeds):
        for condition in conditions:
            if time.monotonic() - began > options.max_seconds and not runs.done(condition, seed):
                continue
            runs.complete(condition, seed)
            left -= 1
    scores = runs.scores(conditions)
    result = {target: gains.compared(of_target) for target, of_target in scores.items()}
    untrained = runs.untrained(options.task)
    text = "\n\n".join((heading(options, setting), gains.report(
        result, options.task, runs.told(conditions), left, untrained)))
    how = held_out.scored_by(options.task, runs.lpips is not None)
    write_result(options.out / "see_better.json",
                 {"targets": result, "without_network": untrained, "missing": left,
                  "scored_by": how},
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

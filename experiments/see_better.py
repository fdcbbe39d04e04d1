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
import json
import math
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from evflow.downstream import E2VID, E2VID_PLUS, E2VID_SMALL, EVFlowNet
from evflow.downstream.simulated import SequenceConfig
from evflow.downstream.train import LearningConfig
from evflow.errors import EvflowDataError
from evflow.network.weights import weights_path
from evflow.process.provenance import provenance
from evflow.report import plots
from evflow.training.config import as_dict
from experiments.shared import gains, held_out
from experiments.shared.common import at_least, run_script, write_result, write_text
from experiments.shared.conditions import E2V, RAW, Condition, Files, digest
from experiments.shared.targets import CAMERAS, SCENES
from experiments.shared.trainings import SIMULATED, Setting, Trainings

Task = Literal["video", "flow"]
Preset = Literal["debug", "small", "full"]
# One motion, of pixels rather than parts of one in a window, and contrasts that cross thresholds:
# of scenes as those of images, few steps of a small network learned no flow.
MOVING = dataclasses.replace(
    SCENES, contrast=(0.5, 1.0), foregrounds=0, speed_px_s=(50.0, 250.0))
COMPARED = ("s2r", "jaer", "ecc median", "match", "lgan")
ALONE: dict[Task, str] = {"video": E2V, "flow": RAW}  # what the paper has beside them


def preset_of(task: Task, preset: Preset) -> Setting:
    data = SequenceConfig(scene=SCENES)
    if preset == "debug":
        data = dataclasses.replace(data, sequences=2, windows=4, steps_per_window=2, crop=16)
        learning = LearningConfig(data, steps=6, warmup=2, skip=1)
        network = E2VID(base=4, encoders=1, blocks=0) if task == "video" else EVFlowNet(base=4)
        return Setting(network, learning, seeds=2, shape=(32, 32), textures=8, drawn=8,
                       seconds=0.5, scenes=2, windows=8, skipped=3)
    if preset == "small":  # 25 trainings of 220 steps of .45 s take 45 minutes on two cores
        if task == "video":
            return Setting(E2VID_SMALL, LearningConfig(data, steps=220))
        # Two windows hold hardly a pause, 20 of a clip many: no scene stops. 25 trainings of
        # 3000 steps of .05 s take an hour of one core; 800 steps learned little flow.
        data = dataclasses.replace(data, scene=MOVING, sequences=12, windows=2, crop=40,
                                   pause=0.0, noise=0.0)
        return Setting(EVFlowNet(base=16, encoders=3), LearningConfig(
            data, steps=3000, warmup=20, rate=2e-3, skip=0, elsewhere=0.0, normalised=True))
    large = dataclasses.replace(data, sequences=4, windows=40, crop=128)
    setting = Setting(
        E2VID_PLUS, LearningConfig(large, steps=5000, warmup=200, rate=3e-4),
        (*SIMULATED, ALONE[task], *COMPARED), tuple(CAMERAS),
        shape=(180, 240), textures=512, drawn=64, windows=40, skipped=10, perceptual=True)
    if task == "video":
        return setting
    large = dataclasses.replace(large, windows=4, sequences=16, noise=0.0, hot_pixels=0.0)
    return dataclasses.replace(setting, network=EVFlowNet(), learning=LearningConfig(
        large, steps=5000, warmup=200, rate=2e-4))


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


def same_setting(out: Path, shared: dict[str, Any], setting: Setting) -> None:
    """Write down what the runs in `out` share; EV013 where they were made by another setting."""
    # What may grow from one command to the next: everything is trained and scored by itself.
    free = ("names", "cameras", "circuits", "seeds")
    wanted = shared | {k: v for k, v in as_dict(setting).items() if k not in free}
    wanted = json.loads(json.dumps(wanted))
    path = out / "setting.json"
    if path.is_file():
        before = json.loads(path.read_text())["config"]
        if before != wanted:
            differ = [k for k in wanted if before.get(k) != wanted[k]]
            raise EvflowDataError("EV013", f"{out} holds runs of another setting ({differ}).",
                                  "Choose another --out.")
        return
    write_result(path, {}, wanted)


def nothing_lost(out: Path, conditions: Iterable[Condition], seeds: int) -> None:
    """EV013 where the tables in `out` have targets, conditions or seeds that these leave out."""
    path = out / "see_better.json"
    if not path.is_file():
        return
    made = {(t.name, c.label) for c in conditions for t in c.targets}
    targets, lost = {target for target, _ in made}, set()
    for target, rows in json.loads(path.read_text())["result"]["targets"].items():
        if target not in targets:
            lost.add(target)
            continue
        lost |= {label for label in rows if (target, label) not in made}
        lost |= {f"seed {seed}" for measures in rows.values() for entry in measures.values()
                 for seed in entry["seeds"] if seed >= seeds}
    if lost:
        raise EvflowDataError(
            "EV013", f"{path} has {', '.join(sorted(lost))}, which this command leaves out.",
            "Give all --names, --targets and other conditions that it has, or another --out.")


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

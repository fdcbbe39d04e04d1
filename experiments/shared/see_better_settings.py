"""Networks, trainings and cameras of `see_better` by task and preset."""

from __future__ import annotations

import dataclasses
from typing import Literal

from evflow.downstream import E2VID, E2VID_PLUS, E2VID_SMALL, EVFlowNet, Network
from evflow.downstream.simulated import SequenceConfig
from evflow.downstream.train import LearningConfig
from evflow.process.provenance import provenance
from experiments.shared.conditions import DEFAULT, E2V, ORACLE, OURS, RAW, WIDE, WIDE_LOG
from experiments.shared.targets import CAMERAS, SCENES

Task = Literal["video", "flow"]
Preset = Literal["debug", "small", "full"]
# One motion, of pixels rather than parts of one in a window, and contrasts that cross thresholds:
# of scenes as those of images, few steps of a small network learned no flow.
MOVING = dataclasses.replace(
    SCENES, contrast=(0.5, 1.0), foregrounds=0, speed_px_s=(50.0, 250.0))
SIMULATED = (DEFAULT, WIDE, WIDE_LOG, OURS, ORACLE)
COMPARED = ("s2r", "jaer", "ecc median", "match", "lgan")
ALONE: dict[Task, str] = {"video": E2V, "flow": RAW}  # what the paper has beside them


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is trained and how it is tested. names: of conditions; cameras, circuits: of targets;
    seeds: paired trainings; shape: of the targets' sensors; textures: procedural ones of
    training; drawn: K of `conditions`; seconds: of the recording to estimate from; scenes,
    windows, skipped: clips, their length, and the windows that are not scored; perceptual:
    LPIPS is also what video is trained by, where its weights are."""

    network: Network
    learning: LearningConfig
    names: tuple[str, ...] = SIMULATED
    cameras: tuple[str, ...] = ("high",)
    circuits: tuple[str, ...] = ("noisy",)
    seeds: int = 5
    shape: tuple[int, int] = (64, 64)
    textures: int = 128
    drawn: int = 256
    seconds: float = 2.0
    scenes: int = 48
    windows: int = 20
    skipped: int = 6
    perceptual: bool = False


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


def heading(task: Task, preset: Preset, setting: Setting, recorded: int) -> str:
    """The title of the tables: network, training, data, and the machine. recorded: targets that
    are recordings."""
    learning, made = setting.learning, provenance()
    data = learning.data
    return (f"# {task}, preset {preset}\n\n"
            f"{type(setting.network).__name__} of base {setting.network.base}, {setting.seeds} "
            f"seeds, {learning.steps} steps of {data.sequences} sequences of {data.windows} windows"
            f" of {1e3 * data.window_s:g} ms at {data.crop} px; "
            f"{f'{recorded} recordings' if recorded else f'{setting.scenes} held-out clips'}. "
            f"evflow {made['evflow']}, jax {made['versions']['jax']}, "
            f"{made['machine']['device']}, {made['machine']['cpus']} CPUs.")

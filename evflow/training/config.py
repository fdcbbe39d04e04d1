"""Configurations of a training run and their presets: `default` and its `pixels` (ours), `paper`
(the paper's network, where one core can train it) and `literal` (all of it as printed), `debug`.

They are frozen and hashable, overridden with dataclasses.replace or from the command line, and
saved as JSON with every result.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, Literal

from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.network.config import PAPER_MODEL, ModelConfig
from evflow.network.flow.config import FlowConfig
from evflow.network.inputs import LONGEST_WINDOW_S
from evflow.scenes.config import SceneConfig

PARTS = ("summary", "encoder", "flow", "spread")


def _check(kind: str, rules: Iterable[tuple[str, Any, bool, str]]) -> None:
    """Raise EV020 at the first (name, value, whether it is good, what it must be) that is not."""
    for name, value, good, rule in rules:
        if not good:
            raise EvflowDataError("EV020", f"{kind}: {name} {value!r}.", f"It must be {rule}.")


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the losses (Eq. 11), and how they are evaluated.

    Attributes:
        condition: weight of L_C (Eq. 6), the intensity changes that the encoder predicts.
        change_l1: weight of a Charbonnier loss beside it, whose gradient does not vanish near the
            target (most targets are about .01).
        parameter: weight of L_P (Eq. 7), the pixels' parameters.
        flow: weight of L_F (Eq. 8), the likelihood of the events.
        event: weight of L_E (Eq. 9), generated against recorded events.
        inverse_flow: weight of L_F' (Eq. 10). It is minus the log-det part of L_F, so it cancels
            or runs away unless small.
        summary: weight of the camera's summary.
        spread: weight of the pixels' standard deviations.
        adaptive: scale each loss by a power of ten into 0..10 (Section IV-D3).
        confidence: weight L_P by the sample's share of the batch's events (lambda of Eq. 7).
        dequantise: standard deviation of the noise added to the counts of the flow.
        events: what L_E compares: "rate" the expected events, "edges" the paper's Eq. 9.
        patches: side lengths of the local patches of Eq. 9.
        edge: change or gradient in log units (per pixel) at which a patch counts fully.
        edges: how moving patches are detected: by the "change" of log intensity over the window, or
            the "gradient" of the image (the paper).
        elu: compare ELU of the generated events in Eq. 9 (sigma_3, as printed), else asinh of both.
    """

    condition: float = 1.0
    change_l1: float = 1.0
    parameter: float = 1.0
    flow: float = 0.05
    event: float = 1.0
    inverse_flow: float = 0.0
    summary: float = 2.0
    spread: float = 0.2
    adaptive: bool = True
    confidence: bool = False
    dequantise: float = 0.01
    events: Literal["rate", "edges"] = "rate"
    patches: tuple[int, ...] = (4, 8)
    edge: float = 0.1
    edges: Literal["change", "gradient"] = "change"
    elu: bool = False

    def __post_init__(self) -> None:
        weights = {field.name for field in dataclasses.fields(self) if field.type == "float"}
        _check("LossConfig", (
            *((name, getattr(self, name), 0 <= getattr(self, name) < math.inf,
               "0 or more, and finite") for name in sorted(weights - {"edge"})),
            ("edge", self.edge, 0 < self.edge < math.inf, "above 0, and finite"),
            ("events", self.events, self.events in ("rate", "edges"), '"rate" or "edges"'),
            ("edges", self.edges, self.edges in ("change", "gradient"), '"change" or "gradient"'),
            ("patches", self.patches, bool(self.patches) and min(self.patches) > 0,
             "one or more sides in pixels")))


@dataclasses.dataclass(frozen=True)
class NuisanceConfig:
    """Imperfections of real recordings; drawn anew for every sequence or scene.

    Attributes:
        fresh: share of sequences whose pixel memory starts at the first frame, as in a simulation.
        odd_pixels: share of pixels whose thresholds are off, whatever the camera's mismatch.
        odd_factor: range of the factor by which these thresholds are off.
        hot_pixels: largest share of hot pixels per polarity; half of the cameras have none.
        hot_hz: range of the hot pixels' rates.
        jitter_s: largest standard deviation of the frame times' error.
        exposure_s: longest exposure.
        exposures: instants that are averaged over an exposure.
        frame_noise_dn: standard deviation of the frames' noise before rounding to 8 bits.
    """

    fresh: float = 0.3
    odd_pixels: float = 0.0
    odd_factor: tuple[float, float] = (0.4, 2.5)
    hot_pixels: float = 0.002
    hot_hz: tuple[float, float] = (5.0, 100.0)
    jitter_s: float = 0.001
    exposure_s: float = 0.01
    exposures: int = 4
    frame_noise_dn: float = 0.5

    def __post_init__(self) -> None:
        _check("NuisanceConfig", (
            *((name, getattr(self, name), 0 <= getattr(self, name) <= 1, "a share, 0 to 1")
              for name in ("fresh", "odd_pixels", "hot_pixels")),
            *((name, getattr(self, name), 0 <= getattr(self, name) < math.inf,
               "0 or more, and finite") for name in ("jitter_s", "exposure_s", "frame_noise_dn")),
            *((name, (low, high), 0 < low <= high < math.inf, "a range above 0")
              for name in ("odd_factor", "hot_hz") for low, high in [getattr(self, name)]),
            ("exposures", self.exposures, self.exposures > 0, "at least 1")))

    @property
    def sharp(self) -> bool:
        """Whether frames have neither exposure nor errors of their time stamps."""
        return self.jitter_s == 0 and self.exposure_s == 0

    @staticmethod
    def none() -> NuisanceConfig:
        """Sharp frames, with noise alone, of a camera that has been running."""
        return NuisanceConfig(fresh=0.0, hot_pixels=0.0, jitter_s=0.0, exposure_s=0.0,
                              exposures=1)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One training run. Content of step i depends on (config, seed, i) alone.

    Attributes:
        sensors: pixel models; a step draws as many neighbours among them as it has cameras, and
            splits the cameras evenly.
        parts: parts of the network that learn ("summary", "encoder", "flow", "spread"); the losses
            that touch none of them are not computed.
        summary_noise: the pixels' parts train without the summary on the true one plus N(0, this^2)
            in its coordinates y.
        crop: side of the crop in pixels, all of which the summary sees.
        block: height and width in pixels of the part of each crop that the flow sees.
        scenes: scenes per step.
        cameras: cameras that share a scene (rendering is the dearer part).
        windows: windows per sequence.
        window_s: range of a window's length in seconds (log-uniform).
        steps_per_window: rendered frames per window; motion stays near 1 px per frame.
        textures: textures and photographs in the bank that scenes are made of.
        sequences: number of fixed sequences, drawn once (the paper's 300); 0 draws new ones in
            every step.
        images: of the scenes, a folder of pictures or a COCO json of objects; None is procedural
            textures and scikit-image's photographs. A run goes on with the same alone: a folder's
            by the names and sizes of its files, a json by its bytes.
        steps: optimiser steps.
        warmup: steps over which the learning rates rise from 0; then they fall as a cosine.
        learning_rate: highest learning rate of the encoder and the spread.
        summary_rate: highest learning rate of the summary.
        flow_rate: highest learning rate of the flow.
        clip: largest norm of each part's gradient.
        ema: decay of the moving average of the weights, which is what is saved.
        seed: of data and first parameters.
    """

    model: ModelConfig = ModelConfig()
    loss: LossConfig = LossConfig()
    prior: CameraPrior = CameraPrior(
        theta=(0.05, 0.6), mismatch=(0.0, 0.15), noise="mixed", eta=(0.02, 2.0), eta_spread=0.1)
    scene: SceneConfig = SceneConfig(speed_px_s=(5.0, 350.0), contrast=(0.2, 1.0))
    sensors: tuple[SensorModel, ...] = (
        SensorModel(eta_intensity=True), SensorModel(noise_resets_memory=True),
        SensorModel(timestamps="v2e", noise_resets_memory=True),
        SensorModel(cutoff_hz=200.0, refractory_s=5e-4, leak_hz=0.1, noise_resets_memory=True))
    nuisances: NuisanceConfig = NuisanceConfig()
    parts: tuple[str, ...] = PARTS
    summary_noise: float = 0.1
    crop: int = 64
    block: tuple[int, int] = (8, 16)
    scenes: int = 8
    cameras: int = 2
    windows: int = 3
    window_s: tuple[float, float] = (0.02, 0.1)
    steps_per_window: int = 16
    textures: int = 192
    sequences: int = 0
    images: str | None = None
    steps: int = 3000
    warmup: int = 100
    learning_rate: float = 1e-3
    summary_rate: float = 2e-3
    flow_rate: float = 5e-4
    clip: float = 1.0
    ema: float = 0.998
    seed: int = 0

    def __post_init__(self) -> None:
        models, changes = len(self.sensors), self.model.changes
        group, patch = max(1, min(self.cameras, models)), max(self.loss.patches, default=1)
        step = self.scenes * self.cameras
        _check("TrainConfig", (
            ("parts", self.parts, bool(self.parts) and set(self.parts) <= set(PARTS),
             f"some of {PARTS}"),
            ("steps", self.steps, self.steps > 0, "at least 1"),
            ("sensors", models, models > 0 and models % group == 0,
             "as many as the cameras, or a multiple"),
            ("cameras", self.cameras, self.cameras > 0 and self.cameras % group == 0,
             "as many as the sensors of a step, or a multiple"),
            ("sequences", self.sequences, self.sequences == 0 or (
                self.sequences >= step and self.sequences % self.cameras == 0
                and group == models),
             f"0, or a multiple of the {self.cameras} cameras and {step}, those of a step, or more "
             "(of no more sensors than cameras)"),
            ("block", self.block, patch <= min(self.block) and max(self.block) <= self.crop,
             f"at least {patch}, the largest patch, to {self.crop}, the crop"),
            ("steps_per_window", self.steps_per_window,
             self.steps_per_window > 0 and self.steps_per_window % changes == 0,
             f"a multiple of the model's {changes} changes"),
            ("windows", self.windows, self.windows > 0, "at least 1"),
            ("window_s", self.window_s,
             0 < self.window_s[0] <= self.window_s[1] <= LONGEST_WINDOW_S,
             f"a shortest and a longest length in seconds, up to {LONGEST_WINDOW_S:g}"),
            ("warmup", self.warmup, self.warmup >= 0, "0 or more"),
            ("textures", self.textures, self.textures > 0, "at least 1"),
            ("ema", self.ema, 0 <= self.ema < 1, "from 0 to below 1"),
            ("clip", self.clip, self.clip > 0, "above 0; math.inf clips nothing"),
            ("seed", self.seed, -2**31 <= self.seed < 2**32, "one of at most 32 bits"),
            *((name, value, 0 <= value < math.inf, "0 or more, and finite") for name, value in (
                (name, getattr(self, name)) for name in (
                    "learning_rate", "summary_rate", "flow_rate", "summary_noise"))),
            *((f"model.{name}", value, value > 0, "at least 1") for name, value in (
                ("encoder_hidden", self.model.encoder_hidden),
                ("summary_hidden", self.model.summary_hidden)))))


# The paper's network and losses, where one core can train them in an hour.
PAPER = TrainConfig(
    model=PAPER_MODEL,
    loss=LossConfig(
        events="edges", change_l1=0.0, inverse_flow=0.5, flow=1.0, summary=0.0, spread=0.0,
        confidence=True),
    prior=CameraPrior(theta=(0.1, 0.5), mismatch=(0.15, 0.15), noise="eq12"),
    scene=SceneConfig.preset("paper"),
    sensors=(SensorModel(eta_intensity=True),), nuisances=NuisanceConfig.none(),
    parts=("encoder", "flow"), window_s=(0.032, 0.032), steps_per_window=32,
    windows=1)

PRESETS: dict[str, TrainConfig] = {
    "default": TrainConfig(),
    # The default's parts that see pixels one by one: many small scenes rather than few large ones.
    # Counts are also compared pixel by pixel, as `generate` may change a single pixel's thresholds.
    # They must follow from the video and (theta, eta): so the camera is running, has no low-pass or
    # dead time, and is simulated at several frames per bin.
    "pixels": TrainConfig(
        loss=LossConfig(event=3.0, dequantise=0.005, patches=(1, 4, 8)),
        sensors=(*TrainConfig.sensors[:3], TrainConfig.sensors[0]),
        nuisances=NuisanceConfig(fresh=0.0, odd_pixels=0.15),
        parts=("encoder", "flow", "spread"), crop=32, block=(8, 8), windows=1, scenes=16,
        steps_per_window=32, steps=4500),
    "paper": PAPER,
    # As printed, 34 core-hours and more: all pixels of 64x64 in the flow and L_E, its patches of
    # several sizes detected by the image's gradients, ELU; L_I in both directions, L_F' like L_F;
    # 300 sequences of a camera each (of 8 windows), 300 epochs, and none of our changes.
    "literal": dataclasses.replace(
        PAPER, block=(64, 64), scenes=10, cameras=1, windows=8, sequences=300, steps=9000,
        warmup=300, clip=math.inf, ema=0.0,
        loss=dataclasses.replace(
            PAPER.loss, condition=2.0, inverse_flow=1.0, dequantise=0.0, patches=(8, 16, 32),
            edges="gradient", elu=True),
        learning_rate=1e-4, flow_rate=1e-4),
    "debug": TrainConfig(
        model=ModelConfig(
            flow=FlowConfig(condition=41, steps=2, hidden=16), summary_hidden=32,
            encoder_hidden=32),
        sensors=TrainConfig.sensors[:2], nuisances=NuisanceConfig.none(),
        crop=32, scenes=2, cameras=2, windows=2, textures=16, steps=20, warmup=5),
}


def preset(name: str) -> TrainConfig:
    """A named configuration; unknown names raise EV020 with the known ones."""
    if name not in PRESETS:
        raise EvflowDataError(
            "EV020", f"no preset {name!r}.", f"Choose one of {sorted(PRESETS)}.")
    return PRESETS[name]


def as_dict(config: Any) -> dict[str, Any]:
    """A configuration as JSON-ready nested dicts."""
    return dataclasses.asdict(config)

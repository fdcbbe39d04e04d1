"""The configuration of a data set; with a seed it determines every byte of every sequence.

`DatasetConfig` is hashable and goes into the manifest as JSON; presets are `full` (the size of
the source paper's set: 300 sequences to train on, 30 to test on) and `debug` (seconds).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from evflow.camera import CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.checks import MOST_SIDE, require
from evflow.dataset.sequence import sequence_names
from evflow.scenes.config import SceneConfig


@dataclasses.dataclass(frozen=True)
class DatasetConfig:
    """A set of sequences of hidden cameras that watch moving scenes.

    train, test: number of sequences; those for testing share no texture or photograph with those
        for training.
    width, height: of the sensor, pixels. seconds: of every sequence, rounded to whole frame
        intervals.
    render_hz: rate of frames that the simulator sees (the paper: 1000 per second); frame_hz: rate
        of frames that are kept, between which flow and intensity changes are given; divides
        render_hz.
    lead_s: how long the camera has been running when the sequence begins.
    frame_noise_dn: standard deviation of the frames' noise before rounding to 8 bits.
    prior, model, scene: cameras, the pixel circuit, and the scenes, in which something always
        moves, as in the paper; the mismatch ranges from v2e's default to the paper's.
    textures, photos: number drawn for each sequence, whose layers are chosen among them;
        texture_px, cutout_px: their sizes in texels.
    """

    train: int = 300
    test: int = 30
    width: int = 346
    height: int = 260
    seconds: float = 1.0
    render_hz: int = 1000
    frame_hz: int = 40
    lead_s: float = 0.02
    frame_noise_dn: float = 0.5
    prior: CameraPrior = CameraPrior(mismatch=(0.03, 0.15))
    model: SensorModel = SensorModel(eta_intensity=True)
    scene: SceneConfig = SceneConfig(
        speed_px_s=(5.0, 350.0), contrast=(0.2, 1.0), static_fraction=0.0)
    textures: int = 3
    photos: int = 1
    texture_px: int = 512
    cutout_px: int = 192

    def __post_init__(self) -> None:
        for name, least in (("train", 0), ("test", 0), ("width", 8), ("height", 8),
                            ("textures", 0), ("photos", 0), ("texture_px", 16), ("cutout_px", 16)):
            require(self, name, getattr(self, name) >= least, f">= {least}")
        for name in ("width", "height"):
            require(self, name, getattr(self, name) <= MOST_SIDE, f"<= {MOST_SIDE}")
        require(self, "train", self.train + self.test > 0, "> 0 if test is 0")
        require(self, "textures", self.textures + self.photos > 0, "> 0 if photos is 0")
        for name in ("lead_s", "frame_noise_dn"):
            require(self, name, 0 <= getattr(self, name) < math.inf, ">= 0")
        for name, whole in (("render_hz", 1_000_000), ("frame_hz", self.render_hz)):
            rate = getattr(self, name)
            require(self, name, rate > 0 and whole % rate == 0, f"a divisor of {whole}")
        require(self, "seconds", 1 <= self.seconds * self.frame_hz < math.inf,
                f"at least one frame interval, {1 / self.frame_hz:g} s")

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width

    @property
    def lead(self) -> int:
        """Rendered frames before the sequence begins."""
        return round(self.lead_s * self.render_hz)

    @property
    def every(self) -> int:
        """Rendered frames per kept frame."""
        return self.render_hz // self.frame_hz

    @property
    def intervals(self) -> int:
        """Frame intervals of a sequence."""
        return round(self.seconds * self.frame_hz)

    @property
    def names(self) -> tuple[str, ...]:
        """All sequences: "train/00000", ..., "test/00000", ..., ordered by number."""
        return sequence_names(self.train, self.test)

    def as_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


PRESETS = {
    "full": DatasetConfig(),
    "debug": DatasetConfig(
        train=4, test=2, width=48, height=32, seconds=0.1, texture_px=96, cutout_px=48),
}

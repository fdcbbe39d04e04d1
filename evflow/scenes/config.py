"""Distributions of scenes: ranges of speeds, sizes, contrasts and trajectories.

Units are those of the sensor: pixels, seconds, degrees. Every range is (low, high), inclusive;
those marked "log" are drawn log-uniformly, so that each octave is equally likely.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from evflow.checks import require
from evflow.errors import EvflowDataError

Range = tuple[float, float]

_POSITIVE = ("speed_px_s", "diameter_px", "zoom", "contrast", "gamma", "shake_hz")
_PROBABILITIES = ("foreground_probability", "static_fraction", "resting_fraction",
                  "shake_probability")


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """The distribution of scenes.

    Attributes:
        speed_px_s: speed of the background and of each foreground, drawn separately (log).
        foregrounds: how many cut-outs at most.
        foreground_probability: the chance of each cut-out.
        diameter_px: largest extent of a cut-out in a 64-pixel frame; scales with the shorter side.
        rotation_deg_s: rate of the rotation.
        scale_rate_per_s: rate r of the scaling, exp(r t).
        zoom: background texels per sensor pixel (log).
        static_fraction: share of scenes in which nothing moves at all.
        resting_fraction: share of scenes whose background stands still behind what moves, as a
            camera at rest sees the world.
        contrast: span of a layer as a fraction of 255 DN (log); above 1 it clips.
        brightness: where that span lies between as dark (0) and as bright (1) as fits into 255 DN.
        gamma: exponent of the whole scene (log), DN = 255 x^gamma: below 1 bright, above 1 dark.
        shake_probability: share of scenes with a sinusoidal shake on top of the constant velocity.
        shake_px: amplitude of the shake; its peak speed is held below the highest of `speed_px_s`.
        shake_hz: frequency of the shake.
    """

    speed_px_s: Range = (2.0, 350.0)
    foregrounds: int = 3
    foreground_probability: float = 0.75
    diameter_px: Range = (12.0, 50.0)
    rotation_deg_s: Range = (-30.0, 30.0)
    scale_rate_per_s: Range = (-0.3, 0.3)
    zoom: Range = (0.5, 2.0)
    static_fraction: float = 0.1
    resting_fraction: float = 0.0
    contrast: Range = (0.1, 1.0)
    brightness: Range = (0.0, 1.0)
    gamma: Range = (0.5, 2.0)
    shake_probability: float = 0.3
    shake_px: Range = (0.0, 6.0)
    shake_hz: Range = (2.0, 20.0)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            if isinstance(field.default, tuple):
                require(self, name, isinstance(value, tuple), "a pair, (low, high)")
                low = 0.0 if name in ("shake_px", "brightness") else -math.inf
                require(self, name, len(value) == 2 and all(map(math.isfinite, value))
                        and low <= value[0] <= value[1], "two finite numbers, low <= high")
        for name in _POSITIVE:
            require(self, name, getattr(self, name)[0] > 0, "a range above 0")
        for name in _PROBABILITIES:
            require(self, name, 0 <= getattr(self, name) <= 1, "a number in [0, 1]")
        require(self, "brightness", self.brightness[1] <= 1, "a range within [0, 1]")
        require(self, "foregrounds", isinstance(self.foregrounds, int) and self.foregrounds >= 0,
                "an integer >= 0")

    @staticmethod
    def preset(name: Literal["default", "paper"]) -> SceneConfig:
        """`default`, or `paper`: Section IV-E, where a background and one or several cut-outs
        translate, rotate and scale steadily, and something always moves."""
        if name == "default":
            return SceneConfig()
        if name == "paper":
            return SceneConfig(
                foreground_probability=1.0, static_fraction=0.0, shake_probability=0.0)
        raise EvflowDataError("EV020", f"scene preset {name!r}.", "Choose 'default' or 'paper'.")

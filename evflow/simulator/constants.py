"""The pixel circuit as an argument of compiled programs: a pytree whose leaves are its numbers.

Choices and switched-off parts are static structure. Derived constants are computed here, on the
host and in double precision for known numbers, so that programs use the same float32 as if the
number were a literal in them.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from evflow.camera.numbers import is_off
from evflow.camera.sensors import NUMBERS, SensorModel

Number = Any  # a float, what is traced, or None where it is off

CHOICES = ("kind", "timestamps", "log_map", "cutoff_by_light", "eta_is_all", "eta_intensity",
           "noise_resets_memory", "dead_contrast")

AT_ONCE = 1e30  # per second: corner of a low-pass without effect
NO_TIME = 1e-12  # seconds: dead time without effect


@partial(
    jax.tree_util.register_dataclass, meta_fields=CHOICES, data_fields=(
        "corner", *(name for name in NUMBERS if name != "cutoff_hz"), "voltmeter", "photoreceptor"))
@dataclasses.dataclass(frozen=True)
class Constants:
    """A `SensorModel`, whose numbers are None where they are off. corner: of the low-pass at 255
    DN, radians per second. dead_contrast: "keeps" without a dead time. voltmeter: a `Voltmeter`,
    None for other kinds. photoreceptor: a `SecondOrder`, or None."""

    kind: str
    timestamps: str
    log_map: str
    cutoff_by_light: bool
    eta_is_all: bool
    eta_intensity: bool
    noise_resets_memory: bool
    dead_contrast: str
    corner: Number
    refractory_s: Number
    leak_hz: Number
    leak_jitter: Number
    leak_fpn_decades: Number
    shot_hz: Number
    shot_eta_hz: Number
    voltmeter: Any
    photoreceptor: Any

    @staticmethod
    def of(model: SensorModel) -> Constants:
        """The constants of a model, of floats or traced numbers. Raises EV020 for invalid numbers,
        to which a gradient step may lead; traced ones become NaN."""
        inner = {name: dataclasses.replace(part) for name in ("voltmeter", "photoreceptor")
                 if (part := getattr(model, name)) is not None}
        model = dataclasses.replace(model, **inner)  # validates; jit and tree.map do not
        on: dict[str, Any] = {
            name: None if is_off(value := getattr(model, name)) else value for name in NUMBERS}
        on |= {name: getattr(model, name) for name in CHOICES}
        on["dead_contrast"] = model.in_dead_time if on["refractory_s"] is not None else "keeps"
        return Constants(
            corner=_corner(on.pop("cutoff_hz")), refractory_s=_dead(on.pop("refractory_s")), **on,
            voltmeter=model.voltmeter if model.kind == "voltmeter" else None,
            photoreceptor=model.photoreceptor)

    @property
    def is_still(self) -> bool:
        """Whether a pixel's memory changes at events only."""
        return (self.corner is None is self.leak_hz and self.photoreceptor is None
                and not self.is_reset)

    @property
    def is_reset(self) -> bool:
        """Whether a pixel's memory is set anew at the end of a dead time."""
        return self.dead_contrast == "resets"

    @property
    def is_dead_between(self) -> bool:
        """Whether `PixelState.last` counts the seconds since an event."""
        return self.refractory_s is not None and self.timestamps == "crossing"

    @property
    def carries_leak(self) -> bool:
        """Whether leak too small for float32 is carried on; v2e loses it."""
        return self.leak_hz is not None and self.timestamps == "crossing"

    @property
    def waits(self) -> bool:
        """Whether an event within the refractory period of another is delayed, not lost."""
        return self.is_dead_between and self.dead_contrast == "keeps"

    def on_device(self) -> Constants:
        """A copy on the device, for calls of many programs."""
        return jax.tree.map(jnp.asarray, self)


def _corner(cutoff_hz: Number) -> Number:
    if isinstance(cutoff_hz, jax.core.Tracer):  # which may be 0
        return jnp.where(cutoff_hz == 0, AT_ONCE, (2 * math.pi) * cutoff_hz)
    return None if cutoff_hz is None else 2 * math.pi * cutoff_hz


def _dead(refractory_s: Number) -> Number:
    if isinstance(refractory_s, jax.core.Tracer):
        return jnp.maximum(refractory_s, NO_TIME)
    return refractory_s

"""Sensor models: what of an event camera is not per pixel, and known sensors by name.

`SensorModel` is a frozen description of the pixel circuit, and a pytree: its choices, and which of
its numbers are off (0), are static structure; the other numbers are leaves. So jit compiles once
for all cameras of one structure, and grad and vmap reach the numbers. `SENSORS` holds published
settings, each with its thresholds.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import numpy as np

from evflow.camera.numbers import Numbers, is_off, settle
from evflow.checks import require
from evflow.errors import EvflowDataError

SENSOR_SIZES: dict[str, tuple[int, int]] = {  # (width, height)
    "dvs128": (128, 128), "davis240": (240, 180), "atis": (304, 240), "davis346": (346, 260),
    "dvxplorerlite": (320, 240), "genx320": (320, 320), "dvxplorer": (640, 480), "gen3": (640, 480),
    "gen31": (640, 480), "gen4": (1280, 720), "imx636": (1280, 720), "evk4": (1280, 720),
    "celex5": (1280, 800)}
LogMap = Literal["auto", "linlog", "log_eps"]
DeadContrast = Literal["keeps", "drops", "resets"]
KINDS = ("v2e", "esim", "voltmeter", "paper")
# Options that do not apply to a kind of circuit.
WITHOUT = {
    "v2e": (),
    "esim": ("cutoff_hz", "leak_hz", "leak_jitter", "leak_fpn_decades", "shot_hz", "shot_eta_hz"),
    "voltmeter": ("cutoff_hz", "refractory_s", "leak_hz", "leak_jitter", "leak_fpn_decades",
                  "shot_hz", "shot_eta_hz", "noise_resets_memory"),
    "paper": ("cutoff_hz", "refractory_s", "leak_hz", "leak_jitter", "leak_fpn_decades", "shot_hz",
              "shot_eta_hz", "noise_resets_memory"),
}


NUMBERS = ("cutoff_hz", "refractory_s", "leak_hz", "leak_jitter", "leak_fpn_decades", "shot_hz",
           "shot_eta_hz")
SWITCHES = ("cutoff_by_light", "eta_is_all", "eta_intensity", "noise_resets_memory")


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True)
class Voltmeter(Numbers):
    """Constants of DVS-Voltmeter (Lin et al., ECCV 2022, Eq. 10 and 11), for DN on 0..255 and
    times in us; a pytree.

    mu = k1 dL/dt / (L + k2) + k4 + k5 L per us, sigma = k3 sqrt(L) / (L + k2) + k6 per sqrt(us),
    in units of the published threshold. A contrast theta is the level k1 theta, so that
    theta = 1 / k1 (.190 for DVS346, .226 for DVS240) is the published pixel.
    """

    k1: float
    k2: float
    k3: float
    k4: float
    k5: float
    k6: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "leaves", tuple(f.name for f in dataclasses.fields(self)))
        for name in self.leaves:  # the leak, k4 + k5 L, may have either sign
            low = {"k1": 1e-30, "k2": 1e-30, "k4": -np.inf, "k5": -np.inf}.get(name, 0.0)
            settle(self, name, low, f"finite, and at least {low:g}")


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True)
class SecondOrder(Numbers):
    """Time constants in seconds of a photoreceptor of second order, its source follower, and a
    differencing amplifier that events reset (Low and Lee, "Deblur e-NeRF", ECCV 2024); a pytree.

    The photoreceptor has the natural frequency w, w^2 = (loop_gain + 1) / ((input + miller)
    output), and the damping (input + output + (gain + 1) miller) / (2 w (input + miller) output),
    where input_s and miller_s are given at 255 DN and are proportional to 1 / light: in the dark it
    is a first-order low-pass whose corner is proportional to light, and in bright light it may
    ring. With the default values that corner is at 199 Hz for 255 DN.
    """

    input_s: float = 0.03
    miller_s: float = 2e-4
    output_s: float = 5e-4
    gain: float = 49.0
    loop_gain: float = 49.0
    follower_s: float = 1.6e-4
    amplifier_s: float = 1.6e-4

    def __post_init__(self) -> None:
        object.__setattr__(self, "leaves", tuple(f.name for f in dataclasses.fields(self)))
        for name in self.leaves:
            low = 1e-9 if name in ("input_s", "output_s") else 0.0
            settle(self, name, low, f"finite, and at least {low:g}")

    def at(self, cutoff_hz: float) -> SecondOrder:
        """The same with a faster or slower photoreceptor, such that in the dark it is a first-order
        low-pass whose corner would be `cutoff_hz` at 255 DN."""
        slow_s = (self.input_s + (self.gain + 1) * self.miller_s) / (self.loop_gain + 1)
        by = 1.0 / (2 * np.pi * cutoff_hz * slow_s)
        return dataclasses.replace(self, input_s=by * self.input_s, miller_s=by * self.miller_s,
                                   output_s=by * self.output_s)


DVS346 = Voltmeter(5.265, 20.0, 1e-4, 1e-7, 5e-9, 1e-5)
DVS240 = Voltmeter(4.4241, 23.0, 2e-4, 1e-7, 5e-8, 1e-5)


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, repr=False)
class SensorModel(Numbers):
    """The pixel circuit: what is not per pixel. Frozen, and a pytree of the numbers that are on.

    The default is v2e's noise-free pixel with true crossing times. A number that is 0 is off and
    not a leaf; all others are leaves, `voltmeter` only for that `kind`. Pass a model to jit, grad
    or vmap like any other argument. A number that is traced when a model is made counts as on;
    where its value is 0, the result is that of 0, and where it is impossible, NaN.

    Attributes:
        kind: "v2e": all of the below; "esim": log-eps intensity, and events that come within the
            refractory period are lost; "voltmeter": Brownian motion with drift (DVS-Voltmeter),
            its constants in `voltmeter`; "paper": thresholds and noise rates alone (Section
            IV-E). Whatever the kind, the camera's eta is added.
        timestamps: "crossing" = the instant at which the (linearly interpolated) log intensity
            crosses the threshold; "v2e" = v2e's slots, shared by the k-th event of every pixel.
        log_map: "linlog" (v2e: linear below 20 DN) or "log_eps" (ESIM: log(I/255 + 1e-3));
            "auto" becomes the kind's own.
        cutoff_hz: corner frequency of the first-order low-pass at 255 DN; 0 = off.
        cutoff_by_light: let the corner be proportional to intensity, as in v2e; False: the same at
            any light, as when a later stage, not the photoreceptor, limits the bandwidth.
        refractory_s: dead time after an event of light or leak in seconds. Noise events (eta,
            shot_hz) neither wait for it nor begin it.
        leak_hz: ON leak events per second.
        leak_jitter: relative jitter of each leak step.
        leak_fpn_decades: spread of the leak's fixed pattern over pixels, in decades.
        shot_hz: v2e's shot-noise rate in Hz, both polarities together, on top of the camera's eta.
        shot_eta_hz: the eta without leak, mean of ON and OFF, of pixels whose shot noise is
            shot_hz, with eta_is_all; 0: the mean of the camera's maps, hot pixels included.
        eta_is_all: the camera's eta is all of its noise, as for a measured camera: leak is a part
            of eta_on and has run before the first frame, and shot_hz says how large the rest would
            be in the dark, spread over pixels as eta is. False: leak and shot noise come on top.
        eta_intensity: let eta follow ((F-1) I01 + 1) of Eq. 12 (F = 0.25), relative to the mean
            of the first frame.
        noise_resets_memory: a noise event stores the present log intensity (v2e, real pixels);
            False adds it to the stream (the paper).
        voltmeter: constants of kind "voltmeter".
        photoreceptor: a `SecondOrder` in place of the first-order low-pass, for kind "v2e" with
            crossing times.
        dead_contrast: what becomes of contrast that changes in the dead time: "keeps" = it fires
            later (v2e); "drops" = events that fall into it are lost (ESIM); "resets" = the pixel
            begins anew at its end, as an amplifier held in reset (Lichtsteiner et al. 2008).
            "auto" is the kind's own, and "resets" with a second-order photoreceptor. Kind "v2e"
            with crossing times has the choice.

    Raises:
        EvflowDataError: EV020 (an unknown choice, a negative value, a field of another type, or an
            option that does not apply to this kind).

    Example:
        >>> model = ef.SensorModel(cutoff_hz=200.0, refractory_s=5e-4, leak_hz=0.1)
    """

    kind: Literal["v2e", "esim", "voltmeter", "paper"] = "v2e"
    timestamps: Literal["crossing", "v2e"] = "crossing"
    log_map: LogMap = "auto"
    cutoff_hz: float = 0.0
    cutoff_by_light: bool = True
    refractory_s: float = 0.0
    leak_hz: float = 0.0
    leak_jitter: float = 0.0
    leak_fpn_decades: float = 0.0
    shot_hz: float = 0.0
    shot_eta_hz: float = 0.0
    eta_is_all: bool = False
    eta_intensity: bool = False
    noise_resets_memory: bool = False
    voltmeter: Voltmeter = DVS346
    photoreceptor: SecondOrder | None = None
    dead_contrast: DeadContrast | Literal["auto"] = "auto"

    def __repr__(self) -> str:
        """The fields that differ from the default."""
        plain = type(self)(kind=self.kind)
        shown = [] if self.kind == "v2e" else [f"kind={self.kind!r}"]
        for field in dataclasses.fields(self)[1:]:
            value = getattr(self, field.name)
            usual = isinstance(value, str | int | float | None) and value == getattr(
                plain, field.name)
            if self.kind == "voltmeter" if field.name == "voltmeter" else not usual:
                shown.append(f"{field.name}={value!r}")
        return f"SensorModel({', '.join(shown)})"

    def __post_init__(self) -> None:
        if self.log_map == "auto":
            object.__setattr__(self, "log_map", "log_eps" if self.kind == "esim" else "linlog")
        allowed = {"kind": KINDS, "log_map": ("linlog", "log_eps"), "timestamps": (
            ("crossing", "v2e") if self.kind in ("v2e", "paper") else ("crossing",)),
            "dead_contrast": ("auto", *self._dead_contrasts())}
        for name, values in allowed.items():
            if getattr(self, name) not in values:
                kind = f"kind={self.kind!r}, " * (name == "dead_contrast")
                raise EvflowDataError(
                    "EV020", f"SensorModel({kind}{name}={getattr(self, name)!r}).",
                    f"Choose {values}." + " Other kinds, v2e's time stamps and a second-order "
                    "photoreceptor have one choice each: 'auto'." * bool(kind))
        for name in NUMBERS:
            settle(self, name, 0.0, ">= 0")
        for name in SWITCHES:
            value = getattr(self, name)
            require(self, name, isinstance(value, bool | int | np.bool_) and value in (0, 1),
                    "True or False")
        require(self, "voltmeter", isinstance(self.voltmeter, Voltmeter), "a Voltmeter")
        require(self, "photoreceptor", isinstance(self.photoreceptor, SecondOrder | None),
                "a SecondOrder, or None")
        on = tuple(name for name in NUMBERS if not is_off(getattr(self, name)))
        voltmeter = ("voltmeter",) if self.kind == "voltmeter" else ()
        second = ("photoreceptor",) if self.photoreceptor is not None else ()
        object.__setattr__(self, "leaves", (*on, *voltmeter, *second))
        if second and (self.kind, self.timestamps, "cutoff_hz" in on) != ("v2e", "crossing", False):
            raise EvflowDataError(
                "EV020", f"SensorModel(kind={self.kind!r}, timestamps={self.timestamps!r}, "
                f"cutoff_hz={self.cutoff_hz}) with a second-order photoreceptor.",
                "It replaces the low-pass, in pixels of kind 'v2e' with crossing times: "
                "photoreceptor=SecondOrder().at(cutoff_hz).")
        for name in WITHOUT[self.kind]:
            if not is_off(getattr(self, name)):
                raise EvflowDataError(
                    "EV020", f"SensorModel(kind={self.kind!r}, {name}={getattr(self, name)}).",
                    "It does not apply to this kind: leave it out, or use kind='v2e'.")


    def _dead_contrasts(self) -> tuple[DeadContrast, ...]:
        """The choices that this circuit has, its own first."""
        if self.photoreceptor is not None:
            return ("resets",)
        if self.kind == "esim":
            return ("drops",)
        chosen = self.kind == "v2e" and self.timestamps == "crossing"
        return ("keeps", "drops", "resets") if chosen else ("keeps",)

    @property
    def in_dead_time(self) -> DeadContrast:
        """`dead_contrast`, "auto" resolved."""
        own = self._dead_contrasts()[0]
        return own if self.dead_contrast == "auto" else self.dead_contrast


@dataclasses.dataclass(frozen=True)
class KnownSensor:
    """A published sensor: the model and its thresholds.

    Attributes:
        model: its pixel circuit.
        theta: median threshold of both polarities, natural-log units.
        mismatch: standard deviation of the threshold over pixels, natural-log units.
        source: where the values come from.
    """

    model: SensorModel
    theta: float
    mismatch: float
    source: str


_NOISY = SensorModel(cutoff_hz=30.0, leak_hz=0.1, leak_jitter=0.1, leak_fpn_decades=0.1,
                     shot_hz=5.0, noise_resets_memory=True)
SENSORS: dict[str, KnownSensor] = {
    "clean": KnownSensor(SensorModel(), 0.2, 0.02, "v2e --dvs_params clean"),
    "noisy": KnownSensor(_NOISY, 0.2, 0.05, "v2e --dvs_params noisy"),
    "v2e": KnownSensor(
        dataclasses.replace(_NOISY, cutoff_hz=300.0, leak_hz=0.01, shot_hz=0.001,
                            refractory_s=5e-4), 0.2, 0.03, "v2e's command-line defaults"),
    "esim": KnownSensor(SensorModel(kind="esim"), 0.2, 0.0, "ESIM, noise-free"),
    "dvs346": KnownSensor(SensorModel(kind="voltmeter", voltmeter=DVS346), 1 / DVS346.k1, 0.0,
                          "DVS-Voltmeter, calibrated on a DAVIS346"),
    "dvs240": KnownSensor(SensorModel(kind="voltmeter", voltmeter=DVS240), 1 / DVS240.k1, 0.0,
                          "DVS-Voltmeter, calibrated on a DAVIS240"),
    "paper": KnownSensor(SensorModel(kind="paper"), 0.3, 0.15, "TPAMI 2024, Section IV-E"),
}


def known_sensor(name: str) -> KnownSensor:
    """The sensor of this name; raises EV020."""
    if name not in SENSORS:
        raise EvflowDataError("EV020", f"no sensor {name!r}.", f"Choose {tuple(SENSORS)}.")
    return SENSORS[name]

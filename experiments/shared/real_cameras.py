"""Cameras that are not ideal (slow pixels, frames with offset, noise or exposure), by condition."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from evflow.camera import CameraPrior
from evflow.camera.sensors import SENSORS, SecondOrder, SensorModel
from evflow.errors import EvflowDataError
from evflow.scenes.config import SceneConfig
from experiments.shared.cameras import Protocol

BASE = Protocol(
    prior=CameraPrior(theta=(0.12, 0.45)), shape=(120, 160), frame_ms=40, intervals=24,
    scene=SceneConfig(speed_px_s=(20.0, 200.0), contrast=(0.4, 1.0), static_fraction=0.0),
    exact=True)
REAL = SensorModel(cutoff_hz=100.0, leak_hz=0.1, shot_hz=1.0, refractory_s=1e-3,
                   noise_resets_memory=True)
CHANGES: dict[str, dict[str, Any]] = {
    "ideal": {},
    **{f"cutoff {hz} Hz": {"model": SensorModel(cutoff_hz=hz, noise_resets_memory=True)}
       for hz in (300.0, 100.0, 30.0)},
    "cutoff 40 Hz in any light": {"model": SensorModel(
        cutoff_hz=40.0, cutoff_by_light=False, noise_resets_memory=True)},
    "second order, 100 Hz": {"model": SensorModel(
        photoreceptor=SecondOrder().at(100.0), noise_resets_memory=True)},
    **{f"exposed {ms} ms": {"exposure_ms": ms} for ms in (10, 20)},
    **{f"exposed {ms} ms, known": {"exposure_ms": ms, "exposure_known": True} for ms in (10, 20)},
    **{f"frame noise {dn} DN": {"frame_noise_dn": dn} for dn in (1.0, 3.0)},
    **{f"black level {dn:+.0f} DN": {"black_dn": dn} for dn in (-8.0, 8.0, 16.0)},
    "dark light 24 DN": {"dark_dn": 24.0},
    "ESIM's logarithm": {"model": SensorModel(log_map="log_eps", noise_resets_memory=True)},
    **{f"dead time {ms} ms": {"model": SensorModel(refractory_s=ms * 1e-3)} for ms in (1, 5)},
    "dead time 2 ms, held in reset": {"model": SensorModel(
        photoreceptor=SecondOrder().at(5000.0), refractory_s=2e-3)},
    "dead time 5 ms, ESIM's": {"model": SensorModel(kind="esim", refractory_s=5e-3)},
    "leak .3 Hz": {"model": SensorModel(leak_hz=0.3, leak_jitter=0.1, noise_resets_memory=True)},
    "leak .3 Hz, 10 s, background at rest": {
        "model": SensorModel(leak_hz=0.3, leak_jitter=0.1, noise_resets_memory=True),
        "intervals": 250,
        "scene": dataclasses.replace(BASE.scene, resting_fraction=1.0,
                                     foreground_probability=1.0)},
    "shot noise 5 Hz": {"model": SensorModel(shot_hz=5.0, noise_resets_memory=True)},
    "shot noise 1 Hz, mismatch .15": {
        "model": SensorModel(shot_hz=1.0, noise_resets_memory=True),
        "prior": dataclasses.replace(BASE.prior, mismatch=(0.15, 0.15))},
    "noise independent of θ": {"prior": dataclasses.replace(
        BASE.prior, noise="independent", eta=(0.005, 2.0))},
    "no noise": {"prior": dataclasses.replace(BASE.prior, noise="none")},
    "v2e's noisy": {"model": SENSORS["noisy"].model, "exact": False},
    "as a real camera": {"model": REAL, "exposure_ms": 10, "frame_noise_dn": 2.0, "black_dn": 4.0},
    "DVS-Voltmeter's DVS346": {"model": SENSORS["dvs346"].model},
}


def known(conditions: Sequence[str]) -> Sequence[str]:
    """The names of conditions; EV020 where there is no such one."""
    if unknown := sorted(set(conditions) - set(CHANGES)):
        raise EvflowDataError("EV020", f"no condition {', '.join(unknown)}.",
                              f"There are: {'; '.join(CHANGES)}.")
    return conditions


def added_light(protocol: Protocol) -> float:
    """DN of light that pixels see in addition to the frames'."""
    return protocol.dark_dn - protocol.black_dn


def draw_real(rng: np.random.Generator) -> Protocol:
    """A camera of the mixture: a quarter are ideal, the others have random imperfections."""
    protocol = dataclasses.replace(
        BASE, prior=_prior(rng), shape=(96, 128), frame_noise_dn=0.5,
        frame_ms=int(rng.choice((20, 25, 33, 40))), intervals=int(rng.choice((8, 16, 24))))
    if rng.random() < 0.25:
        return protocol

    def some(share: float, low: float, high: float) -> float:
        """0, or log-uniform."""
        drawn = _between(rng, low, high)
        return drawn if rng.random() < share else 0.0

    sensor = SensorModel(
        cutoff_hz=some(0.7, 25.0, 600.0), refractory_s=some(0.5, 1e-4, 4e-3),
        leak_hz=some(0.5, 0.02, 0.3), shot_hz=some(0.5, 0.1, 5.0), noise_resets_memory=True)
    black, dark = float(rng.uniform(-8.0, 20.0)), some(0.4, 3.0, 40.0)
    if rng.random() < 0.3:
        sensor = dataclasses.replace(
            sensor, cutoff_hz=0.4 * sensor.cutoff_hz, cutoff_by_light=False)
    return dataclasses.replace(
        protocol, model=sensor, exposure_ms=int(some(0.6, 3.0, 20.0)),
        frame_noise_dn=0.5 + some(0.5, 0.3, 2.5), dark_dn=dark,
        black_dn=black if rng.random() < 0.5 else 0.0)


def draw_single(rng: np.random.Generator) -> Protocol:
    """A camera of one imperfection, or of none, seen for .5 or 1 s."""
    even = rng.random() < 0.3
    protocol = dataclasses.replace(
        BASE, prior=_prior(rng), intervals=int(rng.choice((12, 24))))
    cutoff_hz, dead_s = _between(rng, 25.0, 400.0), _between(rng, 1e-3, 5e-3)
    noise = SensorModel(shot_hz=_between(rng, 0.3, 6.0), leak_hz=_between(rng, 0.03, 0.3),
                        noise_resets_memory=True)
    exposure_ms = int(rng.integers(5, 25))
    changes: list[tuple[int, dict[str, Any]]] = [  # and how often
        (4, {}),
        (4, {"black_dn": float(rng.uniform(-12.0, 20.0))}),
        (2, {"dark_dn": _between(rng, 3.0, 40.0)}),
        (3, {"model": SensorModel(cutoff_hz=cutoff_hz * (0.4 if even else 1.0),
                                  cutoff_by_light=not even, noise_resets_memory=True)}),
        (2, {"exposure_ms": exposure_ms}),
        (1, {"exposure_ms": exposure_ms, "exposure_known": True}),
        (2, {"frame_noise_dn": _between(rng, 0.8, 3.5)}),
        (1, CHANGES["ESIM's logarithm"]),
        (1, {"model": SensorModel(refractory_s=dead_s)}),
        (2, {"model": noise}),
        (1, CHANGES["v2e's noisy"]),
        (1, CHANGES["DVS-Voltmeter's DVS346"]),
    ]
    often = np.array([weight for weight, _ in changes]) / sum(weight for weight, _ in changes)
    return dataclasses.replace(protocol, **changes[rng.choice(len(changes), p=often)][1])


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _prior(rng: np.random.Generator) -> CameraPrior:
    """Of one camera. Noise that always followed the thresholds (Eq. 12) would tell them."""
    mismatch = _between(rng, 0.005, 0.15)
    kinds: tuple[Literal["eq12", "independent", "none"], ...] = ("eq12", "independent", "none")
    noise = kinds[rng.choice(3, p=(0.25, 0.65, 0.1))]
    return CameraPrior(theta=(0.1, 0.5), mismatch=(mismatch, mismatch), noise=noise,
                       eta=(0.003, 3.0))


def draw_exposed(rng: np.random.Generator) -> Protocol:
    """One of `draw_real` whose frames are exposed for a time that the recording tells."""
    protocol = draw_real(rng)
    exposure_ms = round(_between(rng, 2.0, 30.0))
    return dataclasses.replace(
        protocol, exposure_ms=min(exposure_ms, protocol.frame_ms), exposure_known=True)


def draw_other(rng: np.random.Generator) -> Protocol:
    """Cameras beside `draw_real`: DVS-Voltmeter's pixels, else one of `draw_real` seen for 5 s."""
    protocol = draw_real(rng)
    if rng.random() < 0.2:
        return dataclasses.replace(protocol, intervals=round(5e3 / protocol.frame_ms))
    walk = SENSORS[str(rng.choice(("dvs346", "dvs240")))].model
    seconds = float(rng.choice((0.2, 0.5, 1.0)))
    return dataclasses.replace(
        BASE, prior=protocol.prior, model=walk, frame_ms=protocol.frame_ms, frame_noise_dn=0.5,
        intervals=round(1e3 * seconds / protocol.frame_ms),
        shape=((96, 128), (64, 64))[int(rng.integers(2))])

"""Joins two estimates: thresholds from a moving scene or steps, noise from a static scene."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from evflow.camera import PARAMETERS, Camera
from evflow.camera.exports.common import Settings
from evflow.camera.optics import read_sensor, read_summary, read_undetermined
from evflow.errors import EvflowDataError
from evflow.estimation.result import THRESHOLDS, CameraEstimate
from evflow.files.archives import load_npz
from evflow.notes import Note

CIRCUIT = ("cutoff_hz", "refractory_s")  # what a scene at rest does not show
NOISE = ("leak_hz", "shot_hz", "shot_eta_hz")  # and what it shows


def with_thresholds(found: CameraEstimate, path: str | os.PathLike) -> CameraEstimate:
    """The estimate with the thresholds, circuit and optics of the camera.npz at `path`.

    Raises EV015 (another size), EV020 (no standard deviations, or thresholds that were not
    measured there), and what reading a camera raises.
    """
    camera, std = Camera.load_with_std(path)
    undetermined = read_undetermined(path)
    if std is None or undetermined:
        raise EvflowDataError(
            "EV020", f"{path} holds no {'standard deviations' if std is None else 'measured '}"
            f"{'' if std is None else ' and '.join(undetermined)}.",
            "Pass the camera.npz of a recording in which something moves, or of steps of light.")
    if camera.shape != found.camera.shape:
        raise EvflowDataError(
            "EV015", f"{path} is a camera of {camera.shape} pixels, the recording of "
            f"{found.camera.shape}.", "Join two estimates of one camera.")
    sensor, optics = read_sensor(path)
    sensor = dataclasses.replace(
        sensor, **{name: getattr(found.sensor, name) for name in NOISE})
    held = load_npz(Path(path))
    sensor_std = {**found.sensor_std, **{
        name: float(held.get(f"sensor_{name}_std", np.nan)) for name in CIRCUIT}}
    valid = held.get("valid", np.ones(camera.shape, bool)).astype(bool)
    maps = {name: getattr(camera, name) for name in THRESHOLDS}
    errors = {name: getattr(std, name) for name in THRESHOLDS}
    used = valid if valid.any() else np.ones_like(valid)
    seen, seen_std = ({name: np.asarray(getattr(c, name))[used][None] for name in PARAMETERS}
                      for c in (camera, std))
    nearest = vars(Settings.of(seen, seen_std))
    sigmas = tuple(name.replace("theta", "sigma") for name in THRESHOLDS)
    values = {name: nearest[name] for name in (*THRESHOLDS, *sigmas)}
    value_errors = {name: float(np.median(np.asarray(errors[name])[used])) for name in THRESHOLDS}
    value_errors |= {name: values[name] / np.sqrt(2.0 * used.sum()) for name in sigmas}
    if known := read_summary(path):  # the file's own summary, not one computed from its maps
        values, value_errors = ({name: of[name] for name in (*THRESHOLDS, *sigmas)}
                                for of in known)

    def scalars(numbers: dict[str, float]) -> dict[str, jnp.ndarray]:
        return {name: jnp.float32(number) for name, number in numbers.items()}

    note = Note("theta.joined", f"the thresholds come from {path}.")
    return dataclasses.replace(
        found, camera=dataclasses.replace(found.camera, **maps),
        std=dataclasses.replace(found.std, **errors),
        summary=dataclasses.replace(found.summary, **scalars(values)),
        summary_std=dataclasses.replace(found.summary_std, **scalars(value_errors)),
        valid=valid & ~found.hot, undetermined=(), sensor=sensor, sensor_std=sensor_std,
        optics=optics,
        notes=(*(n for n in found.notes if n.code not in ("scene.static", "frames.none")), note))

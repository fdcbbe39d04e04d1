"""Expected events of the sensors of `noise`, on a changing screen and at rest."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from evflow.camera import Camera, Summary, noise_of_threshold, sample_pixels
from evflow.camera.sensors import SENSORS, SensorModel
from experiments.shared import laws
from experiments.shared.table_two import LEVELS, TABLE_TWO

DARK, BRIGHT = 25.0, 225.0  # DN of the changing screen
SCREEN_DT_S, RAMP_S, HOLD_S = 0.002, 0.1, 0.3


def camera_of(key: jax.Array, name: str, row: int, size: int, spread: bool) -> Camera:
    """A camera with the thresholds of a row of Table II, and their spread or the sensor's own.
    The noise of "paper" is Eq. 12 at the mean luminance of LEVELS."""
    own = SENSORS[name].mismatch
    theta = [TABLE_TWO[p][row, 0] for p in ("on", "off")]
    sigma = [TABLE_TWO[p][row, 1] if spread else own for p in ("on", "off")]
    eta = [0.0, 0.0]
    if name == "paper":
        factor = float(laws.dimmed(LEVELS.mean()))
        eta = [float(noise_of_threshold(jax.numpy.float32(t))) * factor for t in theta]
    values = (np.float32(v) for v in (*theta, *eta, *sigma))
    return sample_pixels(key, Summary(*map(jax.numpy.asarray, values)), (size, size))


def model_of(name: str) -> SensorModel:
    model = SENSORS[name].model
    return dataclasses.replace(model, eta_intensity=True) if name == "paper" else model


def judged(found: float, law: float) -> dict[str, float]:
    """A count beside its law."""
    return {"events": float(found), "law": float(law),
            "deviation": float(found / law - 1) if law > 0 else 0.0}


def shot_weight(camera: Camera) -> np.ndarray:
    """Noise of a pixel relative to one of nominal thresholds, ON and OFF, (2, N)."""
    theta = np.stack([np.ravel(camera.theta_on), np.ravel(camera.theta_off)]).astype(float)
    return np.median(theta, axis=1, keepdims=True) / theta


def screen(way: str, up: bool) -> np.ndarray:
    """DN over time (T,) of a screen that changes and then rests."""
    change = 1 if way == "step" else round(RAMP_S / SCREEN_DT_S)
    share = np.clip(np.arange(change + round(HOLD_S / SCREEN_DT_S) + 1) / change, 0, 1)
    first, last = (DARK, BRIGHT) if up else (BRIGHT, DARK)
    return first * (last / first) ** share


def screen_law(model: SensorModel, camera: Camera, dn: np.ndarray, up: bool) -> float:
    """Expected signal events of all pixels on a screen `dn` (T,)."""
    sign, seconds = (1 if up else -1), SCREEN_DT_S * (len(dn) - 1)
    theta = np.ravel(camera.theta_on if up else camera.theta_off).astype(float)
    if model.kind == "voltmeter":
        path = sign * laws.voltage(model.voltmeter, dn, SCREEN_DT_S)
        return float(np.floor(path.max() / theta).sum())
    path = sign * laws.low_passed(model, dn, SCREEN_DT_S)
    path -= path[0]
    leak = sign * model.leak_hz * 10 ** (0.5 * np.log(10) * model.leak_fpn_decades**2) * seconds
    total = path[-1] + leak * np.ravel(camera.theta_on)
    shot = model.shot_hz if model.noise_resets_memory else 0.0
    between = shot * laws.dimmed(dn[1:]) * SCREEN_DT_S
    resets = np.concatenate([[0.0], np.cumsum(between)])
    return float(laws.steady_rise(theta, total, path / path[-1], resets,
                                  shot_weight(camera).mean(0)).sum())


def rest_rates(model: SensorModel, camera: Camera) -> np.ndarray:
    """Noise rates at rest, leak apart, mean over the pixels of each vertical band, Hz (2, levels):
    of a few hundred pixels, the few with a very low threshold count."""
    factor = laws.dimmed(LEVELS)
    eta = np.array([np.mean(camera.eta_on), np.mean(camera.eta_off)])[:, None]
    weight = shot_weight(camera).reshape(2, camera.shape[0], len(LEVELS), -1)
    shot = 0.5 * model.shot_hz * weight.mean((1, 3))
    return (eta / factor.mean() + shot) * factor


def rest_law(model: SensorModel, camera: Camera, seconds: float) -> np.ndarray:
    """Expected events per pixel of a scene at rest, (2, levels)."""
    if model.kind == "voltmeter":
        theta = np.ravel(camera.theta_on)[:1].astype(float)  # these sensors have no mismatch
        on = [laws.diffused(model.voltmeter, theta, dn, seconds)[0] for dn in LEVELS]
        return np.stack([on, np.zeros(len(on))])
    rates = rest_rates(model, camera)
    leak = [laws.leaked(model, float(hz), seconds) for hz in rates.sum(0)]
    return rates * seconds + np.stack([leak, np.zeros(len(leak))])

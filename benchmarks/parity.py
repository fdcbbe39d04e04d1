"""What a device computes against what the CPU computes, and against v2e's own counts.

A check computes named arrays on one device, of inputs that the CPU made. `differences` holds them
to their bounds: a difference is the greatest one, over the greatest value of the CPU's. The bounds
are those of float32; products rounded to TF32 or bfloat16 exceed them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.bench_estimate import WINDOW_S, network
from benchmarks.harness import Setting
from evflow.camera import PARAMETERS, Camera
from evflow.camera.sensors import SENSORS, SensorModel
from evflow.light.log_maps import delta_log_intensity
from evflow.network.api import encode, estimate, forward, inverse
from evflow.scenes import make_bank
from evflow.simulator import simulate, simulate_voxels
from evflow.training.batch import sample_batch
from evflow.training.config import PRESETS
from evflow.training.step import init_state, make_train_step, optimiser

GOLDENS = Path(__file__).parents[1] / "tests" / "data" / "small_v2e.npz"
TIES = 0.005  # of the events: what exact threshold ties of 8-bit video may move
FRAMES = 17  # of a window; those of the goldens are 64x48
Results = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Check:
    """compute(device, setting) -> arrays by name. bounds: of their differences from the CPU's.
    own: of those that are errors in themselves, which any device must meet."""

    name: str
    compute: Callable[[jax.Device, Setting], Results]
    bounds: dict[str, float]
    own: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Difference:
    """A quantity held to its bound. value: None where it is no number, or there is none, and then
    why is in `note`."""

    check: str
    quantity: str
    value: float | None
    bound: float
    failed: bool
    note: str = ""


def differences(check: Check, device: Results, cpu: Results) -> list[Difference]:
    """Every quantity of a check that has bounds; what is no number fails."""
    values = {name: _relative(device[name], cpu[name]) for name in check.bounds}
    values |= {name: float(np.max(device[name])) for name in check.own}
    bounds = check.bounds | check.own
    return [Difference(check.name, name, value if np.isfinite(value) else None, bounds[name],
                       not value <= bounds[name], "" if np.isfinite(value) else str(value))
            for name, value in values.items()]


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(a - b)) / max(float(np.max(np.abs(b))), 1e-30))


def absent(check: Check, why: str, failed: bool = False) -> list[Difference]:
    """What is said of a check that was not made, or `failed`."""
    return [Difference(check.name, name, None, bound, failed, why)
            for name, bound in (check.bounds | check.own).items()]


def on(device: jax.Device, tree: Any) -> Any:
    """A tree of arrays on a device, for good."""
    return jax.device_put(tree, device)


def cpu() -> contextlib.AbstractContextManager[Any]:
    """New arrays are the CPU's."""
    return jax.default_device(jax.devices("cpu")[0])


@functools.cache
def _window(setting: Setting) -> tuple[np.ndarray, np.ndarray]:
    """voxels and dlogI of the goldens' video, seen by a noisy camera."""
    with np.load(GOLDENS) as golden, cpu():
        frames = golden["frames"][:FRAMES]
        frames = frames[:, :12, :16] if setting.quick else frames
        camera = Camera.sample(jax.random.key(0), frames.shape[1:])
        voxels = simulate_voxels(jax.random.key(1), frames, camera,
                                 frame_dt_s=WINDOW_S / (FRAMES - 1))
        return np.asarray(voxels), np.asarray(delta_log_intensity(frames[0], frames[-1]))


@functools.cache
def _params(setting: Setting) -> Any:
    with cpu():
        return jax.tree.map(np.asarray, network(setting)[0])


def flow(device: jax.Device, setting: Setting) -> Results:
    """There and back through the flow at a fixed code."""
    params, voxels, dlogI = on(device, (_params(setting), *_window(setting)))
    code = encode(params, voxels, dlogI, window_s=WINDOW_S)
    y, z, log_det = forward(params, voxels, code)
    back = inverse(params, y, z, code)
    names = {"y": y, "z": z, "log_det": log_det, "round trip": abs(back - voxels)}
    return {name: np.asarray(value) for name, value in names.items()}


def maps(device: jax.Device, setting: Setting) -> Results:
    """`estimate` of one window."""
    params, voxels, dlogI = on(device, (_params(setting), *_window(setting)))
    camera = estimate(params, voxels, dlogI, window_s=WINDOW_S)
    return {name: np.asarray(value) for name, value in vars(camera).items()}


def counts(device: jax.Device, setting: Setting) -> Results:
    """v2e's counts: the share of events that differ from the goldens'; and noisy ones."""
    with np.load(GOLDENS) as golden, jax.default_device(device):
        frames, times = golden["frames"], golden["times_us"]
        wanted = {"base": SensorModel(timestamps="v2e"),
                  "cutoff100": SensorModel(timestamps="v2e", cutoff_hz=100.0)}
        wrong = []
        for name, model in list(wanted.items())[: 1 if setting.quick else None]:
            events = _events(frames, times, model)
            for ours, side in zip(events, ("on", "off"), strict=True):
                theirs = golden[f"{name}_{side}"]
                wrong.append(np.abs(ours - theirs).sum() / theirs.sum())
        noisy = _events(frames, times, SENSORS["noisy"].model)
        return {"v2e's counts": np.array(wrong), "events": noisy.sum((1, 2))}


def _events(frames: np.ndarray, times: np.ndarray, model: SensorModel) -> np.ndarray:
    camera = Camera.constant(frames.shape[1:], 0.2, 0.2)
    found = simulate(jax.random.key(0), frames, times, camera, model=model)
    return found.count_map().astype(np.int64)


def voxels(device: jax.Device, setting: Setting) -> Results:
    """A noisy window: each bin's sum over the pixels, where a tie moves little."""
    with np.load(GOLDENS) as golden, jax.default_device(device):
        frames = golden["frames"][: 5 if setting.quick else FRAMES]
        grid = simulate_voxels(
            jax.random.key(1), frames, Camera.constant(frames.shape[1:]), frame_dt_s=1e-3,
            model=SENSORS["noisy"].model)
        return {"bins": np.asarray(grid).sum((0, 1), dtype=np.float64)}


def training(device: jax.Device, setting: Setting) -> Results:
    """Losses and the gradient's norm of one step on one batch."""
    state, batch, step = _training()
    _, metrics = step(*on(device, (state, batch)))
    return {"loss": np.asarray(metrics["loss"]), "grad_norm": np.asarray(metrics["grad_norm"])}


@functools.cache
def _training() -> tuple[Any, Any, Any]:
    config = PRESETS["debug"]
    tx = optimiser(config)
    with cpu():
        bank = make_bank(jax.random.key(1), 4, photos=False, size=64)
        state = init_state(config, tx, bank, "default")
        batch = jax.jit(sample_batch, static_argnames="config")(jax.random.key(2), bank, config)
    return state, batch, jax.jit(make_train_step(config, tx))


CHECKS = (
    Check("flow", flow, {"y": 2e-4, "z": 2e-4, "log_det": 2e-4}, {"round trip": 1e-4}),
    Check("estimate", maps, dict.fromkeys(PARAMETERS, 1e-3), {}),
    Check("simulator, events", counts, {"events": TIES}, {"v2e's counts": TIES}),
    Check("simulator, voxels", voxels, {"bins": TIES}, {}),
    Check("training step", training, {"loss": 1e-3, "grad_norm": 1e-2}, {}),
)

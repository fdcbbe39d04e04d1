"""The whole path in one picture: a camera is estimated from a recording, and the recording's own
frames are simulated again as that camera would have seen them.

    python -m experiments.quickstart                      # a hidden camera watches a rendered scene
    python -m experiments.quickstart flight.aedat4        # your recording

Writes out/quickstart/quickstart.png, camera.npz and result.json.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from evflow import CameraEstimate, Events, Recording, estimate_camera, read_recording, simulate
from evflow.camera import Camera, CameraPrior, Summary, sample_nominal, sample_pixels
from evflow.camera.sensors import SensorModel
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.report.page import spread
from evflow.report.text import LABELS, describe
from evflow.scenes import SceneConfig, make_bank, render, sample_scene
from evflow.simulator import simulate_stream
from evflow.simulator.interpolate import unzip, upsample
from experiments.shared.common import at_least, run_script, write_result

FPS, FRAME_EVERY = 1000, 25  # rendered frames per second; one in 25 is given to the estimator


@dataclasses.dataclass(frozen=True)
class Options:
    """Estimate a camera and simulate with it; one picture."""

    recording: Annotated[Path | None, tyro.conf.Positional] = None
    """A recording with frames; without it a hidden camera watches a rendered scene."""
    out: Path = Path("out/quickstart")
    seed: int = 3
    width: int = 240
    height: int = 180
    milliseconds: int = 300
    """Length of the rendered recording."""


def hidden_camera(options: Options) -> tuple[Recording, Camera, Summary]:
    """A recording of a rendered scene by a random camera, frames every 25 ms and 8 bit; the
    camera's maps; its nominal values (the truth of the table)."""
    k_bank, k_scene, k_nominal, k_pixels, k_noise = jax.random.split(
        jax.random.key(options.seed), 5)
    shape = (options.height, options.width)
    bank = make_bank(k_bank, 48)
    config = SceneConfig(speed_px_s=(60.0, 200.0), static_fraction=0.0, contrast=(0.6, 1.0),
                         gamma=(0.8, 1.2), foreground_probability=1.0)
    scene = sample_scene(k_scene, bank, config, shape)
    frame = jax.jit(lambda t: render(scene, t, shape))
    times = np.arange(options.milliseconds + 1)
    frames = np.concatenate([np.asarray(frame(jnp.asarray(t / FPS, jnp.float32)))
                             for t in np.array_split(times, max(1, len(times) // 50))])
    nominal = sample_nominal(k_nominal, (), CameraPrior(theta=(0.15, 0.4), mismatch=(0.03, 0.06)))
    truth = sample_pixels(k_pixels, nominal, shape)
    model = SensorModel(noise_resets_memory=True)
    events = simulate(k_noise, frames, times * 1000, truth, model=model)
    kept = slice(None, None, FRAME_EVERY)
    recording = Recording(events, np.clip(np.rint(frames[kept]), 0, 255).astype(np.uint8),
                          times[kept] * 1000)
    return recording, truth, nominal


def simulate_again(recording: Recording, found: CameraEstimate, seed: int) -> Events:
    """The recording's frames, interpolated to <= .5 px of motion, seen by the estimated camera."""
    pairs = ((recording.frame_dn(i), int(t)) for i, t in enumerate(recording.frame_times)
             if recording.events.t[0] - 1000 <= t <= recording.events.t[-1] + 1000)
    frames, times = unzip(upsample(pairs))
    model = SensorModel(noise_resets_memory=True)
    key = jax.random.key(seed + 1)
    return Events.concatenate(list(simulate_stream(key, frames, times, found.camera, model=model)))


def rates(events: Events, span_us: tuple[int, int]) -> dict[str, float]:
    """Events per pixel and second of each polarity inside a time span."""
    inside = events.slice(*span_us)
    on, off = inside.count_map().reshape(2, -1).sum(1)
    exposure = (span_us[1] - span_us[0]) * 1e-6 * events.size[0] * events.size[1]
    return {"on": float(on / exposure), "off": float(off / exposure)}


def truth_table(truth: Summary, found: CameraEstimate) -> str:
    """Truth beside estimate ± std, a line per parameter."""
    lines = [f"{'':22} {'truth':>7} {'estimate':>19}"]
    for name, label in LABELS.items():
        value, std = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
        lines.append(f"{label:22} {float(getattr(truth, name)):7.3f} {spread(value, std):>19}")
    return "\n".join(lines)


def main(options: Options) -> dict[str, Any]:
    at_least(16, width=options.width, height=options.height)
    at_least(2 * FRAME_EVERY, milliseconds=options.milliseconds)
    plots.require()
    truth = nominal = None
    if options.recording is None:
        recording, truth, nominal = hidden_camera(options)
    else:
        recording = read_recording(options.recording)
    print(recording)
    with bar("estimating") as progress:
        found = estimate_camera(recording, progress=progress)
    print(describe(found) if nominal is None else truth_table(nominal, found))
    made = simulate_again(recording, found, options.seed)
    span = (max(int(e.t[0]) for e in (recording.events, made)),
            min(int(e.t[-1]) for e in (recording.events, made)))
    result: dict[str, Any] = {
        "estimate": found.as_dict(), "rate_recorded": rates(recording.events, span),
        "rate_remade": rates(made, span)}
    if nominal is not None:
        result["truth"] = {k: float(v) for k, v in dataclasses.asdict(nominal).items()}
    for name in ("on", "off"):
        print(f"events/pixel/s {name.upper():3}: recorded {result['rate_recorded'][name]:.2f}, "
              f"re-made {result['rate_remade'][name]:.2f}")
    middle = sum(span) // 2
    index = int(np.argmin(np.abs(recording.frame_times - middle)))
    plots.comparison(options.out / "quickstart.png", recording.frame_dn(index), recording.events,
                     made, (middle - 15_000, middle + 15_000), found, truth)
    found.save(options.out / "camera.npz", overwrite=True)
    write_result(options.out / "result.json", result, dataclasses.asdict(options))
    print(f"-> {options.out / 'quickstart.png'}")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

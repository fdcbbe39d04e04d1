"""The pictures of docs/gallery.md: what the commands draw, of a hidden camera that watches a scene.

    python -m experiments.gallery                         # all of them, into docs/pictures/gallery
    python -m experiments.gallery --only sensors bench    # some
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from evflow import (
    SENSORS,
    Camera,
    CameraEstimate,
    CameraPrior,
    Events,
    Recording,
    SensorModel,
    estimate_camera,
    simulate,
)
from evflow.camera import Summary
from evflow.downstream import load_network, reconstruct, window_edges
from evflow.downstream.flow import full_motion, window_flows
from evflow.errors import EvflowDataError
from evflow.estimation.bench.calibration import calibrate_step
from evflow.files.atomic import atomic_text
from evflow.report import bench_figures, plots
from evflow.report.cameras import histograms as camera_pair
from evflow.report.caption import captioned
from evflow.report.flow import flow_image
from evflow.report.movie import Film, write_sheet
from evflow.report.video import enlarged
from experiments.shared.common import run_script
from experiments.shared.hidden_scene import hidden_camera, simulate_again

SPAN_US = 30_000
COLOURS = 64  # of a picture: files stay small
LEVELS = (40, 220, 55, 100, 40, 100, 220, 55, 220, 100, 40, 220, 40, 55, 100)  # DN of the screen
REST, EDGE = 200, 4  # ms of a level, and of the step to it
EDGES_US = 1000 * (REST - 1 + (REST + EDGE) * np.arange(len(LEVELS) - 1))  # when steps begin


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw the gallery."""

    out: Path = Path("docs/pictures/gallery")
    seed: int = 3
    only: tuple[str, ...] = ()
    """Names of pictures; all without any."""


class Material:
    """What pictures are made of, each once."""

    def __init__(self, options: Options) -> None:
        self.options = options

    @cached_property
    def hidden(self) -> tuple[Recording, Camera, Summary]:
        return hidden_camera(self.options.seed, 160, 120, 300)

    @property
    def recording(self) -> Recording:
        return self.hidden[0]

    @cached_property
    def found(self) -> CameraEstimate:
        return estimate_camera(self.recording)

    @cached_property
    def bench(self) -> CameraEstimate:
        return calibrate_step(screen(self.options.seed), triggers_us=EDGES_US)

    @cached_property
    def other(self) -> CameraEstimate:
        return calibrate_step(screen(self.options.seed + 1))

    @property
    def span(self) -> tuple[int, int]:
        t = self.recording.events.t
        middle = (int(t[0]) + int(t[-1])) // 2
        return middle - SPAN_US // 2, middle + SPAN_US // 2


def screen(seed: int) -> Recording:
    """A v2e-like camera before a screen that steps between four levels of light."""
    shape = (48, 64)
    k_camera, k_events = jax.random.split(jax.random.key(seed))
    camera = Camera.sample(k_camera, shape, CameraPrior(theta=(0.2, 0.24), noise="none"))
    model = SensorModel(cutoff_hz=200.0, refractory_s=5e-4, leak_hz=0.1, shot_hz=2.0,
                        noise_resets_memory=True)
    logs = [np.full(REST, np.log(LEVELS[0]))]
    for a, b in itertools.pairwise(np.log(LEVELS)):
        logs += [np.linspace(a, b, EDGE + 1)[1:], np.full(REST, b)]
    light = np.exp(np.concatenate(logs)).astype(np.float32)
    frames = np.broadcast_to(light[:, None, None], (len(light), *shape))
    times = 1000 * np.arange(len(light))
    events = simulate(k_events, frames, times, camera, model=model)
    return Recording(events, np.rint(frames[::20]).astype(np.uint8), times[::20])


def recording(made: Material, path: Path) -> None:
    write_sheet(path.with_suffix(".png"), made.recording, Film(caption=True, scale=2),
                overwrite=True)
    reduced(path.with_suffix(".png"))


def maps(made: Material, path: Path) -> None:
    plots.camera_maps(made.found, path.with_suffix(".png"))
    reduced(path.with_suffix(".png"))


def histograms(made: Material, path: Path) -> None:
    plots.camera_histograms(made.found, path.with_suffix(".png"), made.hidden[1])
    reduced(path.with_suffix(".png"))


def again(made: Material, path: Path) -> None:
    """Recorded and re-simulated events of the same instant."""
    events = simulate_again(made.recording, made.found, made.options.seed)
    save(side_by_side([("as recorded", made.recording.events),
                       ("as the estimated camera would", events)], made.span), path)


def sensors(made: Material, path: Path) -> None:
    """The same video, as the estimated camera's circuits of four kinds would see it."""
    from evflow.simulator.interpolate import unzip, upsample

    recording = made.recording
    pairs = [(recording.frame_dn(i), int(recording.frame_times[i])) for i in range(4, 9)]
    fine = list(upsample(iter(pairs)))
    frames, times = (np.stack(list(part)) for part in unzip(iter(fine)))
    shown = []
    for name in ("clean", "noisy", "esim", "dvs346"):
        sensor = SENSORS[name]
        camera = Camera.constant(made.hidden[1].shape, sensor.theta, sensor.theta)
        shown.append((name, simulate(jax.random.key(1), frames, times, camera,
                                     model=sensor.model)))
    end = int(times[-1])
    save(np.concatenate([side_by_side(shown[:2], (end - SPAN_US, end)),
                         side_by_side(shown[2:], (end - SPAN_US, end))]), path)


def flow(made: Material, path: Path) -> None:
    trained = load_network("evflownet-small")
    events = made.recording.events
    edges = window_edges(made.recording, made.recording.frame_times)
    middle = len(edges) // 2
    full_px = full_motion(trained, events, edges)
    found = next(window_flows(trained, events, edges[middle:middle + 2]))
    inside = events.slice(int(edges[middle]), int(edges[middle + 1]))
    save(captioned(enlarged(flow_image(np.asarray(found), inside, full_px), 3),
                   f"full colour: {full_px:.1f} px in 25 ms"), path)


def video(made: Material, path: Path) -> None:
    """A frame beside what E2VID makes of the events until then."""
    trained = load_network("e2vid-small")
    times = made.recording.frame_times[1:]
    images = list(reconstruct(trained.network, trained.params, made.recording.events, times,
                              **trained.how))
    pair = [made.recording.frame_dn(len(times)) / 255.0, np.asarray(images[-1])]
    both = [enlarged(np.repeat(image.clip(0, 1)[..., None], 3, -1), 2) for image in pair]
    save(np.concatenate([captioned(picture, words) for picture, words in zip(
        both, ("frame", "made of the events"), strict=True)], 1), path)


def bench(made: Material, path: Path) -> None:
    found = made.bench
    thetas = {side: np.sort(np.asarray(getattr(found.camera, f"theta_{side}"))[found.valid])[::8]
              for side in ("on", "off")}
    atomic_text(path.with_suffix(".svg"), bench_figures.s_curve(thetas), overwrite=True)


def light(made: Material, path: Path) -> None:
    assert made.bench.bench is not None
    atomic_text(path.with_suffix(".svg"), bench_figures.noise(made.bench.bench), overwrite=True)


def speed(made: Material, path: Path) -> None:
    assert made.bench.bench is not None
    atomic_text(path.with_suffix(".svg"), bench_figures.speed(made.bench.bench), overwrite=True)


def latency(made: Material, path: Path) -> None:
    assert made.bench.bench is not None
    atomic_text(path.with_suffix(".svg"), bench_figures.latency(made.bench.bench), overwrite=True)


def compared(made: Material, path: Path) -> None:
    drawn = camera_pair((made.bench.camera, made.other.camera), "theta_on", ("one", "another"))
    atomic_text(path.with_suffix(".svg"), drawn, overwrite=True)


PICTURES: dict[str, Callable[[Material, Path], None]] = {
    draw.__name__: draw
    for draw in (recording, maps, histograms, again, sensors, flow, video, bench, light, speed,
                 latency, compared)}


def side_by_side(streams: list[tuple[str, Events]], span_us: tuple[int, int]) -> np.ndarray:
    """Event images of one instant, each with its name beneath."""
    gap = 8
    parts = [captioned(enlarged(plots.event_image(events, *span_us), 2), words)
             for words, events in streams]
    blank = np.full((parts[0].shape[0], gap, 3), 255, np.uint8)
    return np.concatenate([piece for part in parts for piece in (part, blank)][:-1], 1)


def save(picture: np.ndarray, path: Path) -> None:
    """(H, W, 3) uint8 as a PNG of few colours."""
    Image.fromarray(picture).save(path.with_suffix(".png"))
    reduced(path.with_suffix(".png"))


def reduced(path: Path) -> None:
    """The PNG at `path` again, in few colours."""
    image = Image.open(path).convert("RGB")
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def main(options: Options) -> None:
    if unknown := set(options.only) - set(PICTURES):
        raise EvflowDataError("EV020", f"no pictures {sorted(unknown)}.",
                              f"Choose from {', '.join(PICTURES)}.")
    options.out.mkdir(parents=True, exist_ok=True)
    made = Material(options)
    for name, draw in PICTURES.items():
        if not options.only or name in options.only:
            draw(made, options.out / name)
            print(f"{name} drawn", flush=True)


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""The pictures of docs/gallery.md: PICTURES, functions that draw one each into a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from evflow import SENSORS, Camera, Events, simulate
from evflow.downstream import load_network, reconstruct, window_edges
from evflow.downstream.flow import full_motion, window_flows
from evflow.files.atomic import atomic_text
from evflow.metrics.cameras import compare_cameras
from evflow.report import bench_figures, plots
from evflow.report.cameras import histograms as camera_pair
from evflow.report.caption import captioned
from evflow.report.flow import flow_image
from evflow.report.movie import Film, write_sheet
from evflow.report.video import enlarged
from evflow.simulator.interpolate import unzip, upsample
from experiments.shared.gallery_scenes import SPAN_US, Scenes
from experiments.shared.hidden_scene import simulate_again

COLOURS = 64  # of a picture: files stay small


def recording(scenes: Scenes, path: Path) -> None:
    write_sheet(path.with_suffix(".png"), scenes.recording, Film(caption=True, scale=2),
                overwrite=True)
    reduced(path.with_suffix(".png"))


def maps(scenes: Scenes, path: Path) -> None:
    plots.camera_maps(scenes.found, path.with_suffix(".png"))
    reduced(path.with_suffix(".png"))


def histograms(scenes: Scenes, path: Path) -> None:
    plots.camera_histograms(scenes.found, path.with_suffix(".png"), scenes.truth)
    reduced(path.with_suffix(".png"))


def again(scenes: Scenes, path: Path) -> None:
    """Recorded and re-simulated events of the same instant."""
    events = simulate_again(scenes.recording, scenes.found, scenes.seed)
    save(side_by_side([("as recorded", scenes.recording.events),
                       ("as the estimated camera would", events)], scenes.span), path)


def sensors(scenes: Scenes, path: Path) -> None:
    """The same video as four kinds of sensors would see it."""
    recording = scenes.recording
    pairs = [(recording.frame_dn(i), int(recording.frame_times[i])) for i in range(4, 9)]
    fine = list(upsample(iter(pairs)))
    frames, times = (np.stack(list(part)) for part in unzip(iter(fine)))
    shown = []
    for name in ("clean", "noisy", "esim", "dvs346"):
        sensor = SENSORS[name]
        camera = Camera.constant(scenes.truth.shape, sensor.theta, sensor.theta)
        shown.append((name, simulate(jax.random.key(1), frames, times, camera,
                                     model=sensor.model)))
    end = int(times[-1])
    save(np.concatenate([side_by_side(shown[:2], (end - SPAN_US, end)),
                         side_by_side(shown[2:], (end - SPAN_US, end))]), path)


def flow(scenes: Scenes, path: Path) -> None:
    trained = load_network("evflownet-small")
    events = scenes.recording.events
    edges = window_edges(scenes.recording, scenes.recording.frame_times)
    middle = len(edges) // 2
    full_px = full_motion(trained, events, edges)
    found = next(window_flows(trained, events, edges[middle:middle + 2]))
    inside = events.slice(int(edges[middle]), int(edges[middle + 1]))
    save(captioned(enlarged(flow_image(np.asarray(found), inside, full_px), 3),
                   f"full colour: {full_px:.1f} px in 25 ms"), path)


def video(scenes: Scenes, path: Path) -> None:
    """A frame beside what E2VID makes of the events until then."""
    trained = load_network("e2vid-small")
    times = scenes.recording.frame_times[1:]
    images = list(reconstruct(trained.network, trained.params, scenes.recording.events, times,
                              **trained.how))
    pair = [scenes.recording.frame_dn(len(times)) / 255.0, np.asarray(images[-1])]
    both = [enlarged(np.repeat(image.clip(0, 1)[..., None], 3, -1), 2) for image in pair]
    save(np.concatenate([captioned(picture, words) for picture, words in zip(
        both, ("frame", "made of the events"), strict=True)], 1), path)


def bench(scenes: Scenes, path: Path) -> None:
    found = scenes.bench
    thetas = {side: np.sort(np.asarray(getattr(found.camera, f"theta_{side}"))[found.valid])[::8]
              for side in ("on", "off")}
    atomic_text(path.with_suffix(".svg"), bench_figures.s_curve(thetas), overwrite=True)


def light(scenes: Scenes, path: Path) -> None:
    atomic_text(path.with_suffix(".svg"), bench_figures.noise(scenes.levels), overwrite=True)


def speed(scenes: Scenes, path: Path) -> None:
    atomic_text(path.with_suffix(".svg"), bench_figures.speed(scenes.levels), overwrite=True)


def latency(scenes: Scenes, path: Path) -> None:
    atomic_text(path.with_suffix(".svg"), bench_figures.latency(scenes.levels), overwrite=True)


def compared(scenes: Scenes, path: Path) -> None:
    pair = scenes.bench.camera, scenes.other.camera
    drawn = camera_pair(pair, "theta_on", ("one", "another"), compare_cameras(*pair)["theta_on"])
    atomic_text(path.with_suffix(".svg"), drawn, overwrite=True)


PICTURES: dict[str, Callable[[Scenes, Path], None]] = {
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

"""The command line: parse, call, print. Results go to stdout, progress and errors to stderr.

Exit codes: 0 done, 1 something about the data, 2 usage, 3 disk or memory.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from evflow.errors import EvflowDataError

RESOURCES = ("EV019",)


@dataclasses.dataclass(frozen=True)
class Info:
    """What is in a recording.

    Example: evflow info flight.aedat4
    """

    recording: tyro.conf.Positional[Path]
    """File or folder (AEDAT4, IJRR text folder or zip, HDF5 in the DSEC layout, npz)."""
    json: bool = False
    """Print JSON."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Measure a camera: per-pixel thresholds and noise rates, from events and frames.

    Example: evflow estimate flight.aedat4 -o cam/
    """

    recording: tyro.conf.Positional[Path]
    """A recording with frames."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for camera.npz, camera.json and the pictures."""
    weights: str = "default"
    """Name of released weights, or a .safetensors path."""
    window_ms: float = 40.0
    """Shortest window; windows run from frame to frame."""
    start: float | None = None
    """Use the recording from here (seconds from its first event)."""
    stop: float | None = None
    """... to here."""
    plots: bool = True
    """Write maps and histograms as PNG (needs matplotlib)."""
    overwrite: bool = False
    json: bool = False
    """Print the summary as JSON."""


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Simulate a video, a folder of images, or a recording's frames, as a camera would see it.

    Example: evflow simulate ride.mp4 --camera cam/camera.npz -o synth.h5

    Example: evflow simulate frames/ --timestamps times.txt --colour rggb -o synth.h5
    """

    video: tyro.conf.Positional[Path]
    """A video file; a folder of images (png, jpg, tif, bmp, pgm; 8 or 16 bits); a stack of frames
    (.npy, .npz); or a recording, whose frames are used."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Output, HDF5 in the DSEC layout (.h5)."""
    camera: Path | None = None
    """camera.npz from evflow estimate; without it the thresholds below, or the sensor's own."""
    sensor: Literal["clean", "noisy", "v2e", "esim", "dvs346", "dvs240", "paper"] = "clean"
    """Pixel circuit: v2e's presets and defaults, ESIM, DVS-Voltmeter, the paper's."""
    theta_on: float | None = None
    """The same threshold everywhere (natural log); default: the sensor's, with its mismatch."""
    theta_off: float | None = None
    eta_on: float = 0.0
    """Noise rate in Hz per pixel, added to the sensor's own."""
    eta_off: float = 0.0
    fps: float | None = None
    """Frames per second: for images without times, or where the video's own are wrong."""
    timestamps: Path | None = None
    """Times of the frames: one a line, alone or beside the image's name (text, csv, .npy). A
    folder's timestamps.txt or images.txt is found unasked."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of those times; auto takes the one that gives a plausible frame rate."""
    colour: Literal["luma", "rggb", "bggr", "grbg", "gbrg"] = "luma"
    """What a pixel sees of colour: luma, or its channel under this Bayer mosaic. Frames with one
    channel are taken as the mosaic itself."""
    full_scale: float | None = None
    """Value of white; without it 255, or 65535 in 16-bit images. 12-bit data: 4095."""
    partial: bool = False
    """Use what can be read of a damaged video."""
    interpolate: bool = True
    """Fill in frames where things move by more than --max-motion-px from frame to frame."""
    max_motion_px: Annotated[float, tyro.conf.arg(aliases=["--max-motion"])] = 1.0
    """Longest motion in one step, in pixels; 0 = --no-interpolate."""
    noise_resets_memory: bool = True
    """A noise event stores the present intensity, as in real pixels (v2e's sensors)."""
    seed: int = 0
    overwrite: bool = False
    json: bool = False


@dataclasses.dataclass(frozen=True)
class Version:
    """Print the versions of evflow and of what it runs on.

    Example: evflow version
    """


Command = Union[  # noqa: UP007 - tyro reads the subcommand names from these annotations
    Annotated[Info, tyro.conf.subcommand("info")],
    Annotated[Estimate, tyro.conf.subcommand("estimate")],
    Annotated[Simulate, tyro.conf.subcommand("simulate")],
    Annotated[Version, tyro.conf.subcommand("version")],
]


def main(argv: list[str] | None = None) -> int:
    """Entry point of the `evflow` command."""
    command = tyro.cli(
        Command, args=argv, prog="evflow",
        description="Measure an event camera from its recording; simulate any video as it "
        "would see it.\n\nExample: evflow estimate flight.aedat4 -o cam/")
    run = {Info: _info, Estimate: _estimate, Simulate: _simulate, Version: _version}
    try:
        run[type(command)](command)  # type: ignore[operator]
    except EvflowDataError as e:
        print(e, file=sys.stderr)
        return 3 if e.code in RESOURCES else 1
    except MemoryError as e:
        print(f"out of memory: {e}", file=sys.stderr)
        return 3
    except KeyboardInterrupt:
        print("interrupted; no half-written file is left.", file=sys.stderr)
        return 130
    return 0


def _info(command: Info) -> None:
    from evflow import io

    recording = io.read_recording(command.recording)
    events, times = recording.events, recording.frame_times
    facts = {
        "events": len(events), "size": list(events.size), "duration_s": events.duration_us / 1e6,
        "first_us": int(events.t[0]) if len(events) else None,
        "last_us": int(events.t[-1]) if len(events) else None,
        "on_fraction": float(events.p.mean()) if len(events) else None,
        "frames": len(times),
        "first_frame_us": int(times[0]) if len(times) else None,
        "last_frame_us": int(times[-1]) if len(times) else None,
        "frame_dtype": str(recording.frames.dtype), "notes": list(recording.notes),
    }
    if len(times) > 1 and len(events):
        plan = io.plan_windows(recording)
        facts["windows"], facts["skipped"] = len(plan.pairs), list(plan.skipped)
    if command.json:
        print(json.dumps(facts, indent=2))
        return
    print(recording)
    for name, value in facts.items():
        print(f"  {name:16} {value}")


def _estimate(command: Estimate) -> None:
    from evflow import io
    from evflow.progress import bar
    from evflow.recording import estimate_camera
    from evflow.report import plots
    from evflow.report.text import describe
    from evflow.weights import load_weights, model_card

    out = command.out
    if (out / "camera.npz").exists() and not command.overwrite:
        raise EvflowDataError("EV013", f"{out / 'camera.npz'} exists.", "Pass --overwrite.")
    if command.plots:
        plots.require()
    recording = io.read_recording(command.recording, start_s=command.start, stop_s=command.stop)
    params = load_weights(command.weights)
    with bar("estimating") as progress:
        found = estimate_camera(recording, params, min_window_us=round(command.window_ms * 1000),
                                progress=progress)
    found.save(out / "camera.npz", overwrite=command.overwrite)
    facts = {**found.as_dict(), "recording": str(command.recording), "weights": command.weights,
             "weights_steps": model_card(command.weights).get("steps")}
    _write_json(out / "camera.json", facts)
    if command.plots:
        plots.camera_maps(found, out / "maps.png")
        plots.camera_histograms(found, out / "histograms.png")
    print(json.dumps(facts, indent=2) if command.json else describe(found))
    print(f"written to {out}/", file=sys.stderr)


def _write_json(path: Path, facts: dict) -> None:
    from evflow.files import atomic_write

    with atomic_write(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(facts, indent=2) + "\n")


def _simulate(command: Simulate) -> None:
    import jax

    from evflow import io
    from evflow.colour import as_seen
    from evflow.io.source import open_frames
    from evflow.progress import bar, stoppable
    from evflow.sensors import known_sensor
    from evflow.simulator import simulate_stream
    from evflow.simulator.interpolate import unzip, upsample

    source = open_frames(
        command.video, fps=command.fps, timestamps=command.timestamps, colour=command.colour,
        time_unit=command.time_unit, full_scale=command.full_scale, partial=command.partial)
    camera = _camera(command, source.size)
    sensor = known_sensor(command.sensor).model
    if sensor.kind == "v2e":
        sensor = dataclasses.replace(sensor, noise_resets_memory=command.noise_resets_memory)
    count = frames = 0

    def shown(done: int, total: int) -> None:
        nonlocal frames
        frames = done
        progress(done, total)

    with stoppable(), bar("simulating") as progress, io.DsecWriter(
            command.out, source.size, overwrite=command.overwrite) as writer:
        limit = command.max_motion_px if command.interpolate else 0.0
        pairs = as_seen(
            source.watched(shown), command.colour, None if limit == 0 else lambda slow, pixel:
            upsample(slow, max_motion_px=pixel * limit, warn=source.notes.append))
        for events in simulate_stream(jax.random.key(command.seed), *unzip(pairs), camera,
                                      model=sensor):
            writer.append(events)
            count += len(events)
    for note in source.notes:
        print(f"note: {note}", file=sys.stderr)
    facts = {"out": str(command.out), "events": count, "frames": frames,
             "sensor": command.sensor, "colour": command.colour, "notes": source.notes}
    print(json.dumps(facts) if command.json else
          f"{count:,} events of {frames:,} frames -> {command.out}")


def _camera(command: Simulate, size: tuple[int, int]) -> Any:
    """The camera asked for; EV015 where its size is not that of the video."""
    import jax
    import jax.numpy as jnp

    from evflow.camera import PARAMETERS, Camera, CameraPrior
    from evflow.sensors import known_sensor

    shape = size[::-1]
    if command.camera:
        camera = Camera.load(command.camera)
    else:
        known = known_sensor(command.sensor)
        camera = Camera.sample(jax.random.key(command.seed), shape, CameraPrior(
            (known.theta,) * 2, (known.mismatch,) * 2, noise="none"))
        given = {name: jnp.full(shape, value) for name in PARAMETERS
                 if (value := getattr(command, name)) is not None}
        camera = dataclasses.replace(camera, **given).validate()
    if camera.shape != shape:
        raise EvflowDataError(
            "EV015", f"the video is {size[0]}x{size[1]}, the camera "
            f"{camera.shape[1]}x{camera.shape[0]}.", "Resize the video to the camera's size.")
    return camera


def _version(_: Version) -> None:
    import importlib.metadata

    import evflow

    print(f"evflow {evflow.__version__}")
    for name in ("jax", "jaxlib", "numpy"):
        print(f"{name} {importlib.metadata.version(name)}")


if __name__ == "__main__":
    sys.exit(main())

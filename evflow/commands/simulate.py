"""`evflow simulate`: a video as a camera would see it."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from evflow.commands.writing import Format, named
from evflow.errors import EvflowDataError

if TYPE_CHECKING:
    from evflow.io.frames import Frames
    from evflow.io.writer import EventWriter


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
    """Output. Its extension tells the format: .h5 dsec, .zip or .txt e2vid, .npz npz, .aedat4
    aedat4, none (a folder) evreal."""
    format: Format = "auto"
    """Format of the output, where it is not what the extension stands for."""
    frames_too: bool = False
    """Write the video's frames beside the events: grey, at their own times."""
    camera: Path | None = None
    """camera.npz from evflow estimate; without it the thresholds below, or the sensor's own."""
    draw: bool = False
    """Draw the camera's pixels from their estimates and errors: as uneven as the camera is, where
    the most likely values are too even."""
    sensor: Literal["clean", "noisy", "v2e", "esim", "dvs346", "dvs240", "paper"] = "clean"
    """Pixel circuit: v2e's presets and defaults, ESIM, DVS-Voltmeter, the paper's."""
    theta_on: float | None = None
    """The same threshold everywhere (natural log); default: the sensor's, with its mismatch."""
    theta_off: float | None = None
    eta_on: float | None = None
    """Noise rate in Hz per pixel, added to the sensor's own (default: none)."""
    eta_off: float | None = None
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

    def run(self) -> None:
        import jax

        from evflow import io
        from evflow.colour import as_seen
        from evflow.io.source import open_frames
        from evflow.progress import bar
        from evflow.sensors import known_sensor
        from evflow.simulator import simulate_stream
        from evflow.simulator.interpolate import unzip, upsample

        source = open_frames(
            self.video, fps=self.fps, timestamps=self.timestamps, colour=self.colour,
            time_unit=self.time_unit, full_scale=self.full_scale, partial=self.partial)
        camera = _camera(self, source.size)
        sensor = known_sensor(self.sensor).model
        if sensor.kind == "v2e":
            sensor = dataclasses.replace(sensor, noise_resets_memory=self.noise_resets_memory)
        count = frames = 0

        def shown(done: int, total: int) -> None:
            nonlocal frames
            frames = done
            progress(done, total)

        with bar("simulating") as progress, io.open_writer(
                self.out, source.size, named(self.format), overwrite=self.overwrite) as writer:
            limit = self.max_motion_px if self.interpolate else 0.0
            video = source.watched(shown)
            if self.frames_too:
                video = _recorded(video, self.colour, writer)
            pairs = as_seen(
                video, self.colour, None if limit == 0 else lambda slow, pixel:
                upsample(slow, max_motion_px=pixel * limit, warn=source.notes.append))
            for events in simulate_stream(jax.random.key(self.seed), *unzip(pairs), camera,
                                          model=sensor):
                writer.append(events)
                count += len(events)
        for note in source.notes:
            print(f"note: {note}", file=sys.stderr)
        facts = {"out": str(self.out), "format": writer.NAME, "events": count, "frames": frames,
                 "sensor": self.sensor, "colour": self.colour, "notes": source.notes}
        print(json.dumps(facts) if self.json else
              f"{count:,} events of {frames:,} frames -> {self.out}")


def _recorded(video: Frames, colour: str, writer: EventWriter) -> Frames:
    """The frames on their way, each written as the pixels see it."""
    from evflow.colour import as_seen

    for frame, time in video:
        seen, _ = next(as_seen(iter([(frame, time)]), colour))
        writer.append_frames(seen[None], np.array([time]))
        yield frame, time


def _camera(command: Simulate, size: tuple[int, int]) -> Any:
    """The camera asked for; EV015 where its size is not that of the video."""
    import jax
    import jax.numpy as jnp

    from evflow.camera import PARAMETERS, Camera, CameraPrior
    from evflow.sensors import known_sensor

    shape, key = size[::-1], jax.random.key(command.seed)
    given = {name: jnp.full(shape, value) for name in PARAMETERS
             if (value := getattr(command, name)) is not None}
    if command.draw and not command.camera:
        raise EvflowDataError("EV020", "--draw without --camera.", "It draws a measured camera.")
    if command.camera:
        if command.sensor != "clean":
            print(f"note: --sensor {command.sensor} adds its own noise and limits to the camera's "
                  "measured noise.", file=sys.stderr)
        if given:
            raise EvflowDataError(
                "EV020", f"--camera and {', '.join(given)} contradict each other.",
                "Leave out one of them.")
        camera, std = Camera.load_with_std(command.camera)
        if command.draw:
            if std is None:
                raise EvflowDataError("EV020", f"{command.camera} holds no standard deviations.",
                                      "--draw needs the camera.npz of evflow estimate.")
            camera = camera.drawn(key, std)
    else:
        known = known_sensor(command.sensor)
        camera = Camera.sample(key, shape, CameraPrior(
            (known.theta,) * 2, (known.mismatch,) * 2, noise="none"))
        camera = dataclasses.replace(camera, **given).validate()
    if camera.shape != shape:
        raise EvflowDataError(
            "EV015", f"the video is {size[0]}x{size[1]}, the camera "
            f"{camera.shape[1]}x{camera.shape[0]}.", "Resize the video to the camera's size.")
    return camera

"""`evflow simulate`: a video as a camera would see it."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from evflow.commands.options import Compiling, check_finite, own_first, refuse, value
from evflow.commands.writing import Format, named, need_absent
from evflow.errors import EvflowDataError
from evflow.light.colour import Colour
from evflow.notes import as_dicts

if TYPE_CHECKING:
    from evflow.camera.sensors import SensorModel
    from evflow.io.images.frames import Frames, FrameSource
    from evflow.simulator.photoreceptor import Photoreceptor


Pair = tuple[np.ndarray, int]  # frame, time in us
DEPTH = 8  # frames made ahead of the simulation, and blocks of events that wait to be written


@own_first
@dataclasses.dataclass(frozen=True)
class Simulate(Compiling):
    """Simulate a video, a folder of images, or a recording's frames, as a camera would see it.

    Example: evflow simulate ride.mp4 --camera cam/camera.npz -o synth.h5

    Example: evflow simulate flight.aedat4 --camera cam/camera.npz -o again.h5

    Example: evflow simulate frames/ --timestamps times.txt --colour rggb -o synth.h5
    """

    video: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO")]
    """A video file; a folder of images (png, jpg, tif, bmp, pgm; 8 or 16 bits; hdr, exr: radiance);
    a stack of frames (.npy, .npz); or a recording of any known format, whose frames are used at
    their own times."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Output. Its extension tells the format: .h5 dsec, .zip or .txt e2vid, .npz npz, .aedat4
    aedat4, none (a folder) evreal."""
    format: Format = "auto"
    """Format of the output, where its extension leaves a choice (event_utils in .h5)."""
    frames_too: bool = False
    """Write the video's frames beside the events: grey, at their own times."""
    camera: Annotated[Path | None, value("FILE")] = None
    """camera.npz from evflow estimate, its photoreceptor's cutoff included, and, where VIDEO is a
    recording, the light that its frames lack; without it the thresholds below, or the sensor's
    own."""
    draw: bool = False
    """Draw the camera's pixels from their estimates and errors: as uneven as the camera is, where
    the most likely values are too even."""
    sensor: Literal["clean", "noisy", "v2e", "esim", "dvs346", "dvs240", "paper"] = "clean"
    """Pixel circuit. clean, noisy: v2e's presets; v2e: its defaults; esim; dvs346, dvs240:
    DVS-Voltmeter's; paper: the paper's."""
    theta_on: Annotated[float | None, value("THETA")] = None
    """ON threshold of every pixel (natural log); without it the sensor's, with its mismatch."""
    theta_off: Annotated[float | None, value("THETA")] = None
    """OFF threshold of every pixel."""
    eta_on: Annotated[float | None, value("HZ")] = None
    """Noise events per second and pixel, ON, added to the sensor's own."""
    eta_off: Annotated[float | None, value("HZ")] = None
    """The same, OFF."""
    start: Annotated[float | None, value("SECONDS")] = None
    """Use the frames from here: seconds from the first, of a recording from its first event."""
    stop: Annotated[float | None, value("SECONDS")] = None
    """... to here."""
    fps: Annotated[float | None, value("HZ")] = None
    """Frames per second: for images without times, or where the video's own are wrong."""
    timestamps: Annotated[Path | None, value("FILE")] = None
    """Times of the frames: one a line, alone or beside the image's name (text, csv, .npy). A
    folder's timestamps.txt or images.txt is found unasked."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of those times, or of a recording's; auto takes the one that gives a plausible frame
    rate, of a recording its format's own."""
    colour: Colour = "luma"
    """What a pixel sees of colour: luma, or its channel under this Bayer mosaic. Frames with one
    channel are taken as the mosaic itself."""
    bayer: Annotated[str | None, value("RGGB|BGGR|GRBG|GBRG")] = None
    """The frames are a raw colour mosaic whose cells begin so: pixels see its luma. (--colour rggb:
    they see the mosaic itself.)"""
    full_scale: Annotated[float | None, value("DN")] = None
    """Value of white; without it 255, 65535 in 16-bit images, and of radiance what 99 % of the
    first image lie below. 12-bit data: 4095."""
    response: Literal["auto", "linear", "gamma", "srgb", "log"] = "auto"
    """How the frames code light, which is what pixels see. auto: videos and 8-bit images as srgb;
    arrays, deeper images and a recording's own frames linearly. log: floats that are natural
    logarithms of light, below that of --full-scale."""
    background: Literal["black", "white"] = "black"
    """What transparent images are laid over."""
    frames_topic: Annotated[str | None, value("NAME")] = None
    """Of a recording with several streams of images the one whose images are the frames."""
    flip_frames: Literal["none", "horizontal", "vertical", "both"] = "none"
    """Mirror the frames."""
    partial: bool = False
    """Use what can be read of a damaged video or recording."""
    interpolate: bool = True
    """Fill in frames where things move by more than --max-motion-px from frame to frame."""
    max_motion_px: Annotated[float, tyro.conf.arg(aliases=["--max-motion"])] = 1.0
    """Longest motion in one step, in pixels; 0 = --no-interpolate."""
    noise_resets_memory: bool = True
    """A noise event stores the present intensity, as in real pixels (v2e's sensors)."""
    seed: int = 0
    """Of noise, and of what is drawn: the same seed gives the same events."""
    overwrite: bool = False
    """Replace the output where it exists."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        import jax

        from evflow import io
        from evflow.process.terminal import bar
        from evflow.process.threads import ahead, behind
        from evflow.simulator import simulate_stream
        from evflow.simulator.interpolate import unzip

        format = named(self.format, self.out)
        need_absent(self.out, self.overwrite, self.video, self.camera, self.timestamps)
        source = self._source()
        count = frames = 0

        def shown(done: int, total: int) -> None:
            nonlocal frames
            frames = done
            progress(done, total)

        with bar("simulating") as progress, ahead(self._frames(source, shown), DEPTH) as made:
            camera, sensor = _camera(self, source.size), self._model()
            with io.open_writer(
                self.out, source.size, format, overwrite=self.overwrite
            ) as writer, behind(DEPTH) as later:
                pairs = _recorded(made, partial(later, writer.append_frames))
                for events in simulate_stream(jax.random.key(self.seed), *unzip(pairs), camera,
                                              model=sensor):
                    later(writer.append, events)
                    count += len(events)
        for note in source.notes:
            print(f"note: {note}", file=sys.stderr)
        facts = {"out": str(self.out), "format": writer.NAME, "events": count, "frames": frames,
                 "sensor": self.sensor, "colour": self.colour, "notes": as_dicts(source.notes)}
        print(json.dumps(facts) if self.json else
              f"{count:,} events of {frames:,} frames -> {self.out}")

    def _source(self) -> FrameSource:
        """The frames; EV020 where options contradict each other."""
        from evflow.io.source import open_frames

        check_finite(self)
        if not self.interpolate:
            refuse(self, ("max_motion_px",), "nothing is filled in with --no-interpolate")
        return open_frames(
            self.video, fps=self.fps, timestamps=self.timestamps, colour=self.colour,
            time_unit=self.time_unit, full_scale=self.full_scale, partial=self.partial,
            bayer=self.bayer, response=self.response, background=self.background,
            flip=self.flip_frames, start_s=self.start, stop_s=self.stop,
            frames_topic=self.frames_topic)

    def _frames(
        self, source: FrameSource, shown: Callable[[int, int], None]
    ) -> Iterator[tuple[Pair, list[Pair]]]:
        """The frames that the pixels are shown; and beside each those that have come since the one
        before, to be written, if they are."""
        from evflow.light.colour import as_seen
        from evflow.simulator.interpolate import upsample
        from evflow.simulator.photoreceptor import seen_frames

        limit = self.max_motion_px if self.interpolate else 0.0
        video, came = source.watched(shown), list[Pair]()
        if self.frames_too:
            video = _kept(video, self.colour, came)
        pairs = as_seen(
            video, self.colour, None if limit == 0 else lambda slow, pixel:
            upsample(slow, max_motion_px=pixel * limit, warn=source.notes.append))
        for pair in seen_frames(pairs, self._seen_by(source)):
            yield pair, came.copy()
            came.clear()

    def _seen_by(self, source: FrameSource) -> Photoreceptor:
        """The measured camera's photoreceptor; of its light and clock only in front of frames that
        a camera recorded beside its events."""
        from evflow.camera.optics import Optics, read_sensor
        from evflow.simulator.photoreceptor import IDEAL, Photoreceptor

        if self.camera is None or self.sensor != "clean":
            return IDEAL
        sensor, optics = read_sensor(self.camera)
        return Photoreceptor.of(sensor, optics if source.recorded else Optics())

    def _model(self) -> SensorModel:
        """The pixels' circuit; EV020 where it has no such choice."""
        from evflow.camera.sensors import known_sensor

        model = known_sensor(self.sensor).model
        if model.kind == "v2e":
            return dataclasses.replace(model, noise_resets_memory=self.noise_resets_memory)
        refuse(self, ("noise_resets_memory",), f"--sensor {self.sensor} has no such choice")
        return model


def _kept(video: Frames, colour: str, came: list[Pair]) -> Frames:
    """The frames on their way, each added to `came` as the pixels see it."""
    from evflow.light.colour import as_seen

    for frame, time in video:
        came += as_seen(iter([(frame, time)]), colour)
        yield frame, time


def _recorded(
    made: Iterator[tuple[Pair, list[Pair]]], write: Callable[[np.ndarray, np.ndarray], None]
) -> Frames:
    """The frames of `Simulate._frames` on their way, those beside them written."""
    for pair, came in made:
        for frame, time in came:
            write(frame[None], np.array([time]))
        yield pair


def _camera(command: Simulate, size: tuple[int, int]) -> Any:
    """The camera asked for; EV015 where its size is not that of the video."""
    import jax
    import jax.numpy as jnp

    from evflow.camera import PARAMETERS, Camera, CameraPrior
    from evflow.camera.sensors import known_sensor

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

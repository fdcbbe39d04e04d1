"""Options on the video to simulate: how it is read, which part of it, and how it is mapped to the
sensor."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from evflow.commands.options import check_finite, refuse, value
from evflow.light.colour import Colour

if TYPE_CHECKING:
    from evflow.io.images.frames import FrameSource


@dataclasses.dataclass(frozen=True, kw_only=True)
class Footage:
    """Options on the video, inherited by commands that simulate."""

    start: Annotated[float | None, value("SECONDS")] = None
    """Use the frames from here: seconds from the first; for a recording from its first event."""
    stop: Annotated[float | None, value("SECONDS")] = None
    """... to here."""
    fps: Annotated[float | None, value("HZ")] = None
    """Frames per second: for images without times, or if the video's own are wrong."""
    timestamps: Annotated[Path | None, value("FILE")] = None
    """Times of the frames: one per line, alone, beside the image's name, or begin and end of the
    exposure (text, csv, .npy, .npz). A folder's timestamps.txt or images.txt is found
    automatically."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of these times, or of a recording's; auto takes the one that gives a plausible frame
    rate; for a recording, its format's own."""
    slow_motion: Annotated[float | None, value("FACTOR")] = None
    """How many times slower than life the video is (a high-speed camera's film played at 30 Hz):
    its times are divided by this factor."""
    repeated: Literal["keep", "drop"] = "keep"
    """Frames that repeat the one before while the scene moves, as frame-rate converters insert
    them: drop leaves them out. Not for slides, a screen or a blinking light, whose repeats are
    true."""
    colour: Colour = "luma"
    """What a pixel sees of colour: luma, or its channel under this Bayer mosaic. Frames with one
    channel are taken as the mosaic itself."""
    bayer: Annotated[str | None, value("RGGB|BGGR|GRBG|GBRG")] = None
    """The frames are a raw colour mosaic with this pattern: pixels see its luma. (--colour rggb:
    they see the mosaic itself.)"""
    full_scale: Annotated[float | None, value("DN")] = None
    """Value of white; the default is 255, 65535 for 16-bit images, and for radiance a value that 99
    % of the first image are below. 12-bit data: 4095."""
    response: Literal["auto", "linear", "gamma", "srgb", "log"] = "auto"
    """How the frames encode light, which is what pixels see. auto: srgb for videos and 8-bit
    images; linear for arrays, deeper images and a recording's own frames. log: floats that are
    natural logarithms of light, relative to --full-scale."""
    exposure_ms: Annotated[float | None, value("MS")] = None
    """Exposure of the frames in the scene's time: the blur of what moves is taken out before others
    are interpolated. By default what a recording or --timestamps says; 0 = none."""
    background: Literal["black", "white"] = "black"
    """What transparent images are laid over."""
    crop: Annotated[str | None, value("WxH[+X+Y]")] = None
    """Use this part of the frames: W x H pixels from column X, row Y; by default from the
    middle."""
    resize: Annotated[str | None, value("WxH")] = None
    """Scale the frames, after --crop, to this size."""
    sensor_size: Annotated[str | None, value("NAME|WxH")] = None
    """Scale and crop the frames to fill this sensor: davis346, davis240, dvs128, dvxplorer, gen3,
    gen4 (imx636, evk4), genx320, or WxH."""
    saccades: Annotated[float | None, value("PIXELS")] = None
    """VIDEO is a single picture, over which the sensor makes three saccades of 100 ms along a
    triangle with sides of this length, as in N-Caltech101."""
    frames_topic: Annotated[str | None, value("NAME")] = None
    """For a recording with several image streams: the one to use as frames."""
    flip_frames: Literal["none", "horizontal", "vertical", "both"] = "none"
    """Mirror the frames."""
    partial: bool = False
    """Use what can be read of a damaged video or recording."""

    def source(self, path: Path) -> FrameSource:
        """The frames; EV020 if options contradict each other."""
        from evflow.io.images.cropping import cropped, slowed
        from evflow.io.images.exposures import given_exposure
        from evflow.io.images.saccades import swept
        from evflow.io.source import open_frames

        check_finite(self)
        sweeps = self.saccades is not None
        if sweeps:
            refuse(self, ("fps", "timestamps", "time_unit"), "saccades have their own times")
        options = {name: getattr(self, name) for name in (
            "timestamps", "colour", "time_unit", "full_scale", "partial", "bayer", "response",
            "background", "frames_topic", "repeated")}
        part = {"start_s": self.start, "stop_s": self.stop}
        source = open_frames(path, **options, **({} if sweeps else part), flip=self.flip_frames,
                             fps=1.0 if sweeps else self.fps, picture=sweeps)
        if self.saccades is not None:
            source = swept(source, self.saccades, **part, crop=self.crop, resize=self.resize,
                           sensor_size=self.sensor_size)
        else:
            source = cropped(source, crop=self.crop, resize=self.resize,
                             sensor_size=self.sensor_size)
        source = source if self.slow_motion is None else slowed(source, self.slow_motion)
        if self.exposure_ms is None:
            return source
        times = (time for _, time in itertools.islice(source.open(), 3 if self.exposure_ms else 0))
        exposure_us, source.notes[:] = given_exposure(self.exposure_ms, times, source.notes)
        return dataclasses.replace(source, exposure_us=exposure_us)

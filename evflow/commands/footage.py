"""Options of the video that is simulated: how it is read, which part of it, and how it is laid on
the sensor."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from evflow.commands.options import check_finite, value
from evflow.light.colour import Colour

if TYPE_CHECKING:
    from evflow.io.images.frames import FrameSource


@dataclasses.dataclass(frozen=True, kw_only=True)
class Footage:
    """What is seen; what a command that simulates inherits."""

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
    slow_motion: Annotated[float | None, value("FACTOR")] = None
    """The video shows life so many times slower than it was (a high-speed camera's, played at 30
    Hz): its times are divided by it."""
    repeated: Literal["keep", "drop"] = "keep"
    """Frames that repeat the one before while the scene moves, as converters between frame rates
    show them twice: drop leaves them out."""
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
    crop: Annotated[str | None, value("WxH[+X+Y]")] = None
    """Use this part of the frames: W x H pixels, from column X and row Y, or of the middle."""
    resize: Annotated[str | None, value("WxH")] = None
    """Scale the frames, or what --crop leaves, to this size."""
    sensor_size: Annotated[str | None, value("NAME|WxH")] = None
    """Scale and crop the frames so that they fill this sensor: davis346, davis240, dvs128,
    dvxplorer, gen3, gen4 (imx636, evk4), genx320, or WxH."""
    saccades: Annotated[float | None, value("PIXELS")] = None
    """VIDEO is one picture, over which the sensor makes three saccades of 100 ms along a triangle
    with sides of this length, as in N-Caltech101."""
    frames_topic: Annotated[str | None, value("NAME")] = None
    """Of a recording with several streams of images the one whose images are the frames."""
    flip_frames: Literal["none", "horizontal", "vertical", "both"] = "none"
    """Mirror the frames."""
    partial: bool = False
    """Use what can be read of a damaged video or recording."""

    def source(self, path: Path) -> FrameSource:
        """The frames; EV020 where options contradict each other."""
        from evflow.io.images.laying import laid, slowed
        from evflow.io.images.saccades import swept
        from evflow.io.source import open_frames

        check_finite(self)
        told = {name: getattr(self, name) for name in (
            "fps", "timestamps", "colour", "time_unit", "full_scale", "partial", "bayer",
            "response", "background", "frames_topic", "repeated")}
        source = open_frames(path, **told, flip=self.flip_frames, start_s=self.start,
                             stop_s=self.stop, picture=self.saccades is not None)
        if self.saccades is not None:
            source = swept(source, self.saccades, crop=self.crop, resize=self.resize,
                           sensor_size=self.sensor_size)
        else:
            source = laid(source, crop=self.crop, resize=self.resize, sensor_size=self.sensor_size)
        return source if self.slow_motion is None else slowed(source, self.slow_motion)

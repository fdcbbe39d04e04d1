"""Options that several commands share, and how results are written."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from evflow.errors import EvflowDataError

if TYPE_CHECKING:
    from evflow.types import Recording


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """How a recording is read; what a command that reads one inherits."""

    start: float | None = None
    """Use the recording from here (seconds from its first event)."""
    stop: float | None = None
    """... to here."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the event times; auto takes the format's own."""
    polarity: Literal["auto", "01", "pm1", "invert"] = "auto"
    """What the file's polarities are; invert swaps ON and OFF."""
    size: str | None = None
    """Sensor size WxH (346x260), where the file does not tell it or is wrong."""
    partial: bool = False
    """Use what lies before the damage of a damaged or cut-off file (not HDF5, npz)."""
    drop_outside: bool = False
    """Leave out events outside the sensor instead of refusing them."""
    frames: Path | None = None
    """Frames from elsewhere: a folder of images, a video, a stack (.npy, .npz)."""
    timestamps: Path | None = None
    """Their times on the events' clock: one a line, alone, beside the image's name, or begin and
    end of the exposure."""
    timestamps_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of those times; auto takes the one that gives a plausible frame rate."""
    frames_fps: float | None = None
    """Frames per second of --frames, the first at 0 (see --frames-offset-ms)."""
    full_scale: float | None = None
    """White of --frames; without it 255, or 65535 in 16-bit images. 12-bit data: 4095."""
    frames_offset_ms: Literal["auto"] | float = 0.0
    """Added to the frame times; auto finds what makes events and frames agree."""
    flip_frames: Literal["none", "horizontal", "vertical", "both"] = "none"
    """Mirror the frames."""
    response: Literal["linear", "gamma", "srgb"] = "linear"
    """How the frames code light; gamma is 2.2. Thresholds are measured against linear light."""

    def read(self, path: Path) -> Recording:
        """The recording at `path`, these options obeyed."""
        from evflow import io
        from evflow.io import adjust

        check_finite(self)
        recording = io.read_recording(
            path, start_s=self.start, stop_s=self.stop, time_unit=self.time_unit,
            polarity=self.polarity, size=parse_size(self.size), partial=self.partial,
            drop_outside=self.drop_outside)
        offset = 0 if self.frames_offset_ms == "auto" else round(self.frames_offset_ms * 1000)
        if self.frames is not None:
            recording = adjust.with_frames(
                recording, self.frames, offset_us=offset, fps=self.frames_fps,
                timestamps=self.timestamps, time_unit=self.timestamps_unit,
                full_scale=self.full_scale, partial=self.partial)
        elif self.timestamps or self.frames_fps or self.full_scale:
            raise EvflowDataError(
                "EV020", "--timestamps, --frames-fps and --full-scale tell of frames from "
                "elsewhere.",
                "Pass --frames too.")
        else:
            recording = adjust.shifted(recording, offset)
        if self.flip_frames != "none":
            recording = adjust.flipped(recording, self.flip_frames)
        recording = adjust.linearised(recording, self.response)
        return _aligned(recording) if self.frames_offset_ms == "auto" else recording


def _aligned(recording: Recording) -> Recording:
    from evflow.inspection import frames_offset
    from evflow.io import adjust

    return adjust.shifted(recording, frames_offset(recording))


def check_finite(options: Any) -> None:
    """EV020 where a number among the options is NaN or infinite."""
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if isinstance(value, float) and not math.isfinite(value):
            raise EvflowDataError("EV020", f"--{field.name.replace('_', '-')} {value}.",
                                  "Give a finite number.")


def parse_size(text: str | None) -> tuple[int, int] | None:
    """(width, height) of "346x260"; EV020 on anything else."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise EvflowDataError("EV020", f"size {text!r}.", "Give it as WxH: --size 346x260.")
    return int(width), int(height)


def write_json(path: Path, facts: dict[str, Any]) -> None:
    """`facts` as an indented JSON file, replaced whole or not at all."""
    from evflow.files import atomic_write

    with atomic_write(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(facts, indent=2) + "\n")

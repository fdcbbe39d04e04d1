"""Options that several commands share, how they are told from idle ones, and how results are
written.

An option of `Reading` that can do nothing, because there are no frames or the command looks at
none, is named in a note on stderr: the same options go with every command. What contradicts is
refused, EV020.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from evflow.errors import EvflowDataError
from evflow.light.colour import Colour

if TYPE_CHECKING:
    from evflow.types import Recording

T = TypeVar("T")

LARGEST = 1e13  # of any number: as milliseconds since 1970 until 2286, and whole microseconds

ELSEWHERE = ("timestamps", "timestamps_unit", "frames_fps", "full_scale")  # of --frames
CHANGES = ("frames_offset_ms", "flip_frames", "response", "bayer", "colour")  # of any frames
OWN = ("frames_topic", "no_frames")  # of the recording's


def value(metavar: str, *aliases: str) -> Any:
    """Of an option that may be left out: what its value is called in the help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", aliases=aliases or None)


def own_first(command: type[T]) -> type[T]:
    """Class decorator: a command's help names its own options before those that it inherits, and
    those of a near base before those of a far one."""
    depth = {name: i for i, base in enumerate(command.__mro__)
             for name in getattr(base, "__dataclass_fields__", ())}
    fields = command.__dataclass_fields__  # type: ignore[attr-defined]
    command.__dataclass_fields__ = dict(  # type: ignore[attr-defined]
        sorted(fields.items(), key=lambda item: depth[item[0]]))
    return command


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compiling:
    """What a command that compiles programs inherits."""

    compile_cache: bool = True
    """Keep compiled programs in the user's cache folder (~/.cache/evflow), so that later runs start
    sooner; JAX_COMPILATION_CACHE_DIR names another."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """How a recording is read; what a command that reads one inherits."""

    start: Annotated[float | None, value("SECONDS")] = None
    """Use the recording from here (seconds from its first event)."""
    stop: Annotated[float | None, value("SECONDS")] = None
    """... to here."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the event times; auto takes the format's own."""
    polarity: Literal["auto", "01", "pm1", "invert"] = "auto"
    """What the file's polarities are; invert swaps ON and OFF."""
    size: Annotated[str | None, value("WxH")] = None
    """Sensor size (346x260), where the file does not tell it or is wrong."""
    partial: bool = False
    """Use what lies before the damage of a damaged or cut-off file (of HDF5 and npz only what lies
    before a time that goes back)."""
    drop_outside: bool = False
    """Leave out events outside the sensor instead of refusing them."""
    late: Literal["stop", "drop", "sort", "join"] = "stop"
    """Events whose time goes back: stop refuses them (with --partial, ends there); drop leaves out
    as few events as make the others ordered; sort puts them in their place; join takes them for
    another clock, which is put behind the first."""
    frames_topic: Annotated[str | None, value("NAME")] = None
    """The recording's images that are the frames of its events, where it holds several: a topic of
    a bag, an output of DV. Without it raw images near the events, which a note names."""
    events_topic: Annotated[str | None, value("NAME")] = None
    """Of several cameras in one file the one whose events are read: a topic of a bag, a group of
    HDF5, an output of DV. Without it the first, and a note names the others."""
    no_frames: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Read the events alone, whatever the recording's frames are."""
    frames: Annotated[Path | None, value("PATH")] = None
    """Frames from elsewhere: a folder of images, a video, a stack (.npy, .npz)."""
    timestamps: Annotated[Path | None, value("FILE")] = None
    """Times of --frames on the events' clock: one a line, alone, beside the image's name, or begin
    and end of the exposure."""
    timestamps_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of those times; auto takes the one that gives a plausible frame rate."""
    frames_fps: Annotated[float | None, value("HZ")] = None
    """Frames per second of --frames, the first at 0 (see --frames-offset-ms)."""
    full_scale: Annotated[float | None, value("DN")] = None
    """White of --frames; without it 255, or 65535 in 16-bit images. 12-bit data: 4095."""
    frames_offset_ms: Literal["auto"] | float = 0.0
    """Added to the frame times; auto finds what makes events and frames agree."""
    flip_frames: Literal["none", "horizontal", "vertical", "both"] = "none"
    """Mirror the frames."""
    response: Literal["linear", "gamma", "srgb"] = "linear"
    """How the frames code light; gamma is 2.2. Thresholds are measured against linear light."""
    bayer: Annotated[str | None, value("RGGB|BGGR|GRBG|GBRG")] = None
    """The frames are a raw colour mosaic whose cells begin so: turn it into luma. Not where the
    events come from behind the same filters: there a pixel's own value is what it sees."""
    colour: Colour = "luma"
    """What a pixel sees of colour: luma, or its own under this Bayer mosaic, where the events come
    from behind it (a colour DAVIS): raw mosaics stay as they are, colour frames are laid under."""

    def read(self, path: Path, *, with_frames: bool = True) -> Recording:
        """The recording at `path`, these options obeyed. with_frames: False where the command looks
        at no frames: then none are read from elsewhere or changed (see `note_idle`)."""
        from evflow import io

        check_finite(self)
        if self.frames is None and (told := given(self, ELSEWHERE)):
            raise EvflowDataError(
                "EV020", f"{told} without --frames: of frames from elsewhere.",
                "Pass --frames too.")
        if self.frames is not None and (told := given(self, OWN)):
            raise EvflowDataError(
                "EV020", f"{told} with --frames, which takes the place of the recording's own.",
                "Give one of them.")
        if self.bayer is not None and self.colour != "luma":
            raise EvflowDataError(
                "EV020", f"--bayer {self.bayer} makes luma of a mosaic, --colour {self.colour} "
                "leaves it.", "Give one of them.")
        own = with_frames and self.frames is None
        recording = io.read_recording(
            path, start_s=self.start, stop_s=self.stop, time_unit=self.time_unit,
            polarity=self.polarity, size=parse_size(self.size), partial=self.partial,
            drop_outside=self.drop_outside, no_frames=self.no_frames or not own,
            frames_topic=self.frames_topic if own else None, late=self.late,
            events_topic=self.events_topic, colour=self.colour if own else "luma")
        if with_frames and (self.frames is not None or recording.has_frames):
            return self._seeing(recording)
        if with_frames:
            note_idle(self, f"{path} has no frames" if not self.no_frames else "--no-frames")
        return recording

    def _seeing(self, recording: Recording) -> Recording:
        """The recording with the frames asked for, put right."""
        from evflow.recordings import adjust

        offset = 0 if self.frames_offset_ms == "auto" else round(self.frames_offset_ms * 1000)
        if self.frames is None:
            recording = adjust.shifted(recording, offset)
            recording = adjust.demosaiced(recording, self.bayer) if self.bayer else recording
        else:
            recording = adjust.with_frames(
                recording, self.frames, offset_us=offset, fps=self.frames_fps,
                timestamps=self.timestamps, time_unit=self.timestamps_unit,
                full_scale=self.full_scale, partial=self.partial, bayer=self.bayer,
                colour=self.colour)
        if self.flip_frames != "none":
            recording = adjust.flipped(recording, self.flip_frames)
        recording = adjust.linearised(recording, self.response)
        return _aligned(recording) if self.frames_offset_ms == "auto" else recording


def _aligned(recording: Recording) -> Recording:
    from evflow.recordings import adjust
    from evflow.recordings.check import frames_offset

    return adjust.shifted(recording, frames_offset(recording))


def given(options: Any, names: Iterable[str]) -> str:
    """Those of the named options that are not at their default, as they are typed: "--fps, --slow";
    "" where all are."""
    defaults = {field.name: field.default for field in dataclasses.fields(options)}
    return ", ".join(flag(name, no=defaults[name] is True) for name in names
                     if getattr(options, name) != defaults[name])


def note_idle(options: Reading, why: str) -> None:
    """Say which options of frames do nothing."""
    if idle := given(options, ("frames_topic", "frames", *ELSEWHERE, *CHANGES)):
        print(f"note: {idle} without effect: {why}.", file=sys.stderr)


def tell(recording: Recording, beside: object = "") -> Recording:
    """The recording, after its notes are printed to stderr: by commands that do not print them
    with their own. beside: what is printed as well, whose sentences are not repeated."""
    for note in recording.notes:
        if note.text.rstrip(".") not in str(beside):
            print(f"note: {note}", file=sys.stderr)
    return recording


def flag(name: str, *, no: bool = False) -> str:
    """An option as it is typed: "--frames-fps"."""
    return f"--{'no-' if no else ''}{name.replace('_', '-')}"


def refuse(options: Any, names: Iterable[str], why: str) -> None:
    """EV020 where any of the command's own options is given that contradicts the rest."""
    if wrong := given(options, names):
        raise EvflowDataError("EV020", f"{wrong}: {why}.", "Leave it out.")


def check_finite(options: Any) -> None:
    """EV020 where a number among the options is NaN, infinite, larger than whole microseconds
    can be told or, of a seed, beyond the 32 bits that a key is made of."""
    for field in dataclasses.fields(options):
        number = getattr(options, field.name)
        if field.name == "seed" and not -2**31 <= number < 2**32:
            raise EvflowDataError("EV020", f"--seed {number}.", "Give one of at most 32 bits.")
        if isinstance(number, float) and not abs(number) <= LARGEST:
            raise EvflowDataError("EV020", f"{flag(field.name)} {number}.",
                                  f"Give a number of at most {LARGEST:g}.")


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
    from evflow.files.atomic import atomic_text

    atomic_text(path, json.dumps(facts, indent=2) + "\n", overwrite=True)


def warn_of_prior(undetermined: Sequence[str], done: str) -> None:
    """A word on stderr where a camera's thresholds were never measured. done: what happens to them
    all the same."""
    if undetermined:
        print(f"warning: {' and '.join(undetermined)} of this camera were not measured: they are "
              f"{done} with the value of the prior. Estimate them from a recording with frames in "
              "which something moves, or join two estimates: evflow estimate --thresholds.",
              file=sys.stderr)

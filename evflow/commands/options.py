"""Options that several commands share, how idle ones are reported, and how results are written.

An option of `Reading` that has no effect, because there are no frames or the command does not use
them, is named in a note on stderr, so that one set of options can be passed to every command.
Contradictions are refused, EV020.
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
from evflow.recordings.rolling import Side

if TYPE_CHECKING:
    from evflow.types import Recording

T = TypeVar("T")

LARGEST = 1e13  # limit of any number: as ms since 1970 it is in 2286, and fits integer microseconds

ELSEWHERE = ("timestamps", "timestamps_unit", "frames_fps", "full_scale")  # for --frames
CHANGES = ("frames_offset_ms", "flip_frames", "response", "bayer", "colour",
           "exposure_ms", "rolling_ms", "rolling_from")  # for any frames
OWN = ("frames_topic", "no_frames")  # for the recording's own


def value(metavar: str, *aliases: str) -> Any:
    """An optional option: the name of its value in the help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", aliases=aliases or None)


def own_first(command: type[T]) -> type[T]:
    """Class decorator: the help lists a command's own options before inherited ones, nearer bases
    before farther ones."""
    depth = {name: i for i, base in enumerate(command.__mro__)
             for name in getattr(base, "__dataclass_fields__", ())}
    fields = command.__dataclass_fields__  # type: ignore[attr-defined]
    command.__dataclass_fields__ = dict(  # type: ignore[attr-defined]
        sorted(fields.items(), key=lambda item: depth[item[0]]))
    return command


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compiling:
    """Options of commands that compile programs."""

    compile_cache: bool = True
    """Cache compiled programs in the user's cache folder (~/.cache/evflow), so that later runs
    start faster; JAX_COMPILATION_CACHE_DIR names another folder."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """Options on how a recording is read, inherited by commands that read one."""

    start: Annotated[float | None, value("SECONDS")] = None
    """Use the recording from here (seconds from its first event)."""
    stop: Annotated[float | None, value("SECONDS")] = None
    """... to here."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the event times; auto uses the format's own."""
    polarity: Literal["auto", "01", "pm1", "invert"] = "auto"
    """Polarity convention of the file; invert swaps ON and OFF."""
    size: Annotated[str | None, value("WxH")] = None
    """Sensor size (346x260), if the file does not contain it or is wrong."""
    partial: bool = False
    """Of a damaged or truncated file, use what lies before the damage (of HDF5, npz and bags other
    than MCAP only what lies before a time that goes back)."""
    drop_outside: bool = False
    """Leave out events outside the sensor instead of refusing them."""
    late: Literal["stop", "drop", "sort", "join"] = "stop"
    """Events whose time goes back: stop refuses them (with --partial, reading ends there); drop
    leaves out the fewest events such that the rest are ordered; sort sorts them in; join treats
    them as a second clock and appends it to the first."""
    frames_topic: Annotated[str | None, value("NAME")] = None
    """Which image stream holds the frames, if the recording has several: a bag's topic, an output
    of DV. By default raw images near the events, which a note names."""
    events_topic: Annotated[str | None, value("NAME")] = None
    """Which camera's events to read, if the file has several: a bag's topic, an HDF5 group, an
    output of DV. By default the first; a note names the others."""
    no_frames: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Read only the events, not the recording's frames."""
    frames: Annotated[Path | None, value("PATH")] = None
    """Frames from another file: a folder of images, a video, a stack (.npy, .npz)."""
    timestamps: Annotated[Path | None, value("FILE")] = None
    """Times of --frames on the events' clock: one per line, alone, beside the image's name, or
    begin and end of the exposure, whose blur is then taken out."""
    timestamps_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of these times; auto takes the one that gives a plausible frame rate."""
    frames_fps: Annotated[float | None, value("HZ")] = None
    """Frames per second of --frames, the first at 0 (see --frames-offset-ms)."""
    full_scale: Annotated[float | None, value("DN")] = None
    """White of --frames; the default is 255, or 65535 for 16-bit images. 12-bit data: 4095."""
    frames_offset_ms: Literal["auto"] | float = 0.0
    """Added to the frame times; auto finds the offset at which events and frames agree."""
    rolling_ms: Literal["auto"] | float = 0.0
    """Time from the first row of a frame to the last, if they are read one after the other (a
    rolling shutter): events are moved by that of their row; auto finds it, and where it begins."""
    rolling_from: Side = "top"
    """The side of the frames that is read first."""
    flip_frames: Literal["none", "horizontal", "vertical", "both"] = "none"
    """Mirror the frames."""
    exposure_ms: Annotated[float | None, value("MS")] = None
    """Exposure of the frames, whose blur is taken out; by default what the file says, or what an
    estimate sees of it; 0 = none."""
    response: Literal["linear", "gamma", "srgb"] = "linear"
    """How the frames encode light; gamma is 2.2. Thresholds refer to linear light."""
    bayer: Annotated[str | None, value("RGGB|BGGR|GRBG|GBRG")] = None
    """The frames are a raw colour mosaic with this pattern: convert it to luma. Not if the events
    come from behind the same filters: then a pixel sees its own value."""
    colour: Colour = "luma"
    """What a pixel sees of colour: luma, or one colour under this Bayer mosaic, if the events come
    from behind it (a colour DAVIS): raw mosaics are kept, colour frames are sampled by it."""

    def read(self, path: Path, *, with_frames: bool = True) -> Recording:
        """The recording at `path`, read with these options. with_frames: False if the command does
        not use frames: then none are read from elsewhere or changed (see `note_idle`)."""
        from evflow import io

        check_finite(self)
        if self.frames is None and (options := given(self, ELSEWHERE)):
            raise EvflowDataError(
                "EV020", f"{options} without --frames: it applies to frames from another file.",
                "Pass --frames too.")
        if self.frames is not None and (options := given(self, OWN)):
            raise EvflowDataError(
                "EV020", f"{options} with --frames, which replaces the recording's own.",
                "Give only one of them.")
        if self.bayer is not None and self.colour != "luma":
            raise EvflowDataError(
                "EV020", f"--bayer {self.bayer} converts a mosaic to luma, --colour {self.colour} "
                "keeps it.", "Give only one of them.")
        if self.rolling_ms in (0.0, "auto"):
            refuse(self, ("rolling_from",), "it belongs to a time, --rolling-ms")
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
        """The recording with the requested frames, corrected as requested."""
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
        if self.exposure_ms is not None:
            recording = adjust.exposed(recording, self.exposure_ms)
        recording = adjust.linearised(recording, self.response)
        recording = recording if self.colour == "luma" else adjust.balanced(recording)
        return self._timed(recording)

    def _timed(self, recording: Recording) -> Recording:
        """The recording with frames of one time that agrees with the events'."""
        from evflow.estimation.clock import aligned, rolling
        from evflow.recordings.rolling import Rolling, unrolled

        is_off = self.frames_offset_ms == "auto"
        if self.rolling_ms == "auto":
            recording = aligned(recording) if is_off else recording
            recording = unrolled(recording, rolling(recording))
        elif self.rolling_ms:
            recording = unrolled(recording, Rolling(1e-3 * self.rolling_ms, self.rolling_from))
        return aligned(recording) if is_off else recording


def given(options: Any, names: Iterable[str]) -> str:
    """Those of the named options that are not at their default, as typed: "--fps, --slow"; "" if
    none."""
    defaults = {field.name: field.default for field in dataclasses.fields(options)}
    return ", ".join(flag(name, no=defaults[name] is True) for name in names
                     if getattr(options, name) != defaults[name])


def note_idle(options: Reading, why: str) -> None:
    """Report which frame options have no effect."""
    if idle := given(options, ("frames_topic", "frames", *ELSEWHERE, *CHANGES)):
        print(f"note: {idle} without effect: {why}.", file=sys.stderr)


def print_notes(recording: Recording, beside: object = "") -> Recording:
    """The recording, after printing its notes to stderr, for commands that do not print them with
    their own. beside: other output, whose sentences are not repeated."""
    for note in recording.notes:
        if note.text.rstrip(".") not in str(beside):
            print(f"note: {note}", file=sys.stderr)
    return recording


def flag(name: str, *, no: bool = False) -> str:
    """An option as typed: "--frames-fps"."""
    return f"--{'no-' if no else ''}{name.replace('_', '-')}"


def refuse(options: Any, names: Iterable[str], why: str) -> None:
    """Raise EV020 if any of the command's own options is given that contradicts the others."""
    if wrong := given(options, names):
        raise EvflowDataError("EV020", f"{wrong}: {why}.", "Leave it out.")


def check_finite(options: Any) -> None:
    """Raise EV020 if a number among the options is NaN, infinite, too large for integer
    microseconds or, for a seed, beyond 32 bits."""
    for field in dataclasses.fields(options):
        number = getattr(options, field.name)
        if field.name == "seed" and not -2**31 <= number < 2**32:
            raise EvflowDataError("EV020", f"--seed {number}.", "Give one of at most 32 bits.")
        if isinstance(number, float) and not abs(number) <= LARGEST:
            raise EvflowDataError("EV020", f"{flag(field.name)} {number}.",
                                  f"Give a number of at most {LARGEST:g}.")


def parse_size(text: str | None) -> tuple[int, int] | None:
    """(width, height) from "346x260"; raises EV020 for anything else."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise EvflowDataError("EV020", f"size {text!r}.", "Give it as WxH: --size 346x260.")
    return int(width), int(height)


def write_json(path: Path, facts: dict[str, Any]) -> None:
    """Write `facts` as an indented JSON file, completely or not at all."""
    from evflow.files.atomic import atomic_text

    atomic_text(path, json.dumps(facts, indent=2) + "\n", overwrite=True)


def warn_of_prior(undetermined: Sequence[str], done: str) -> None:
    """Warn on stderr if a camera's thresholds were never measured. done: what happens with them
    nevertheless."""
    if undetermined:
        print(f"warning: {' and '.join(undetermined)} of this camera were not measured: they are "
              f"{done} with the prior's value. Estimate them from a recording with frames in "
              "which something moves, or join two estimates: evflow estimate --thresholds.",
              file=sys.stderr)

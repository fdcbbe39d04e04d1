"""Reading and writing recordings: the registry of formats.

A format is a module with a NAME, its EXTENSIONS, `sniff` and `read`, and an `EventWriter` if it can
be written; to add one, list its module in `FORMATS` and in `WRITERS`. A file is recognised by its
content, and by its extension if several formats claim it. Errors are `EvflowDataError`s.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol, Unpack

from evflow.checks import Size, need
from evflow.errors import EvflowDataError, naming
from evflow.files.regular import need_regular
from evflow.io.decode.misread import with_doubts
from evflow.io.decode.text import HEAD
from evflow.io.decode.units import check_seconds
from evflow.io.decode.written import watched
from evflow.io.formats import (
    aedat2,
    aedat3,
    aedat4,
    dat,
    dsec,
    e2vid,
    event_utils,
    evimo2,
    evreal,
    evt2,
    evt3,
    evt21,
    hdf5,
    ijrr,
    metavision,
    mvsec,
    nmnist,
    npy,
    npz,
    plain_text,
    unread,
    v2e,
    v2e_text,
)
from evflow.io.formats.ros import ros1, ros2
from evflow.io.formats.write_aedat2 import Aedat2Writer
from evflow.io.formats.write_aedat4 import Aedat4Writer
from evflow.io.hints import HintArguments, Hints
from evflow.io.writer import EventWriter, copy
from evflow.types import Events, Recording


class Format(Protocol):
    """What a format module offers."""

    NAME: str
    EXTENSIONS: tuple[str, ...]

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether the file looks like this format. `head`: its beginning, b"" for a folder."""

    def read(self, path: Path, hints: Hints) -> Recording:
        """The recording, with all hints followed; a file without frames gives an empty stack."""


FORMATS: tuple[Format, ...] = (  # if two claim a file and its extension, the first one wins
    aedat4, aedat3, aedat2, evt2, evt21, evt3, dat, v2e, mvsec, event_utils, metavision, dsec, hdf5,
    npz, npy, evimo2, evreal, e2vid, v2e_text, ijrr, plain_text, ros1, ros2, nmnist)
WRITERS: dict[str, type[EventWriter]] = {w.NAME: w for w in (
    dsec.DsecWriter, e2vid.E2vidWriter, event_utils.EventUtilsWriter, evreal.EvrealWriter,
    npz.NpzWriter, Aedat4Writer, Aedat2Writer)}
WRITTEN = {  # the default format for an output's extension
    ".h5": "dsec", ".hdf5": "dsec", ".zip": "e2vid", ".txt": "e2vid", ".npz": "npz",
    ".aedat4": "aedat4", ".aedat": "aedat2", "": "evreal"}
SEVERAL = {".h5": ("dsec", "event_utils"), ".hdf5": ("dsec", "event_utils")}  # others: one format


def find_format(path: str | os.PathLike) -> Format:
    """The format of a file or folder; EV008 (unknown), EV009 (empty file), EV016 (not found)."""
    path = Path(path)
    try:
        head = b"" if path.is_dir() else _head(path)
    except (OSError, ValueError) as e:  # ValueError: a NUL in the name
        why = e.strerror if isinstance(e, OSError) and e.strerror else e
        raise EvflowDataError("EV016", f"{path!s:.200} cannot be opened ({why}).",
                              where=path) from e
    claims = [f for f in FORMATS if f.sniff(path, head)]
    claims.sort(key=lambda f: path.suffix.lower() not in f.EXTENSIONS)
    if claims:
        return claims[0]
    if not path.is_dir() and not head:
        raise EvflowDataError("EV009", f"{path} is empty (0 bytes).", "Copy it again.", where=path)
    if other := unread.known(path, head) if not path.is_dir() else unread.folder(
            path, lambda file: any(f.sniff(file, _head(file)) for f in FORMATS)):
        raise EvflowDataError("EV008", f"{path} is {other.what}.", other.fix, where=path)
    raise EvflowDataError(
        "EV008", f"{path} is none of {', '.join(f.NAME for f in FORMATS)}: it begins with "
        f"{head[:16]!r}.",
        "Convert it, or check that it was copied completely. Text must have lines of numbers "
        "`t x y p`, decimal points, and a header if the order differs.", where=path)


def read_recording(path: str | os.PathLike, **hints: Unpack[HintArguments]) -> Recording:
    """Read events and frames from a file or folder; its format is recognised by its content.

    Args:
        path: AEDAT, Prophesee RAW, DAT and HDF5, DSEC, MVSEC, ROS bags, text and others: see
            docs/formats.md.
        **hints: what the file does not say. start_s, stop_s: the part to read, seconds from its
            first event; time_unit: "s", "ms", "us" or "ns"; polarity: "01", "pm1" or "invert";
            size: (width, height); partial: of a damaged file, read what lies before the damage;
            drop_outside: leave out events outside the sensor; frames_topic: which of several
            image streams holds the frames; no_frames: read only the events; late: "drop",
            "sort" or "join" events whose time goes back; events_topic: which of several event
            streams to read; colour: "luma", or the Bayer pattern of the sensor.

    Returns:
        The recording; if the file has no frames they are (0, H, W). Its notes say what was
        assumed or converted.

    Raises:
        EvflowDataError: EV001 (no event), EV008 (unknown format), EV009 (damaged), EV010 (a
            package is missing), EV016 (not found), EV020 (unknown or bad hint), EV023 (whole
            seconds), and what `Events` and `Recording` raise.

    Example:
        >>> recording = ef.read_recording("flight.aedat4", stop_s=5.0)
        >>> recording.events, recording.frames.shape
    """
    if not isinstance(path, str | os.PathLike):
        raise EvflowDataError(
            "EV020", f"a path was expected, not {type(path).__name__}.",
            "For events without frames: Recording.of_events(events).")
    parsed = Hints.parse(hints)
    path = Path(path)
    found = find_format(path)
    if parsed.events_topic is not None and found in (dsec, event_utils):
        found = hdf5  # which finds a second camera beside the first
    try:
        with naming(path), watched() as written:
            recording = found.read(path, parsed)
            _check_named(recording, parsed)
            events = recording.events
            check_seconds(events.t, events.size, written.unit)
            recording = with_doubts(recording, found.NAME, parsed, written)
    except MemoryError as e:
        raise EvflowDataError(
            "EV009", f"{path} asks for more memory than there is.",
            "If it is sound, read a part: start_s, stop_s (--start, --stop).", where=path) from e
    except OSError as e:
        raise EvflowDataError("EV009", f"{path} cannot be read ({e}).", "Copy it again.",
                              where=path) from e
    return recording


def read_events(path: str | os.PathLike, **hints: Unpack[HintArguments]) -> Events:
    """Read the events of a file or folder, without its frames.

    Args:
        path: as in `read_recording`.
        **hints: as in `read_recording`; frames_topic and no_frames change nothing.

    Returns:
        The events.

    Raises:
        EvflowDataError: EV001, EV008, EV009, EV010, EV016, EV020, EV023 and others, as in
            `read_recording`.
    """
    hints["frames_topic"], hints["no_frames"] = None, True
    return read_recording(path, **hints).events


def write_events(
    path: str | os.PathLike,
    events: Events | Recording,
    format: str | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write events, and the frames of a `Recording`, to a file; all or nothing.

    Args:
        path: of the file.
        events: events or, with frames, a recording.
        format: one of `WRITERS`: "dsec" (HDF5: events/{x, y, t, p}, ms_to_idx, t_offset), "npz",
            "aedat4", "aedat2", "e2vid", "event_utils", "evreal"; None chooses by the path's
            extension (.npz: "npz", .aedat4: "aedat4", .aedat: "aedat2", .zip and .txt: "e2vid"), of
            .h5 and any other "dsec".
        overwrite: replace a file that exists.

    Raises:
        EvflowDataError: EV003 (what the format cannot hold), EV010 (a package is missing), EV013
            (exists), EV019 (cannot be written), EV020 (unknown format, one that does not match the
            path's extension, or one without frames for a recording that has some).
    """
    if not isinstance(events, Recording):
        need(events, Events, "events", "The path comes first: write_events(path, events).")
        events = Recording.of_events(events)
    need(path, str | os.PathLike, "path", "It comes first: write_events(path, events).")
    suffix = Path(path).suffix.lower()
    if format is None and (not suffix or suffix not in WRITTEN):
        format = "dsec"
    write_recording(path, events, format, overwrite=overwrite)


def write_recording(
    path: str | os.PathLike,
    recording: Recording,
    format: str | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a recording to a file or folder; all or nothing.

    Args:
        path: of the file; of a folder if it has no extension.
        recording: events and frames.
        format: as in `write_events`; None chooses by the path's extension (.h5: "dsec",
            .npz: "npz", .aedat4: "aedat4", .aedat: "aedat2", .zip and .txt: "e2vid", none:
            "evreal").
        overwrite: replace what exists.

    Raises:
        EvflowDataError: EV003, EV010, EV013, EV019, EV020 as in `write_events`.
    """
    need(recording, Recording, "recording", "For events: Recording.of_events(events).")
    with open_writer(path, recording.events.size, format, overwrite=overwrite,
                     exposure_us=recording.exposure_us, full_scale=recording.full_scale) as out:
        copy(recording, out)


def open_writer(
    path: str | os.PathLike, size: Size, format: str | None = None, *, overwrite: bool = False,
    exposure_us: int = 0, full_scale: int = 0,
) -> EventWriter:
    """A writer for a recording that comes in parts; the file appears when the `with` block ends.

    Args:
        path: as in `write_recording`.
        size: (width, height) of the sensor.
        format: as in `write_recording`.
        overwrite: replace what exists.
        exposure_us: exposure time of the frames, 0 if it is unknown or there are none.
        full_scale: DN of a saturated pixel of uint16 frames, as in `Recording`; 0 if it is unknown.

    Returns:
        A context manager with append(events) and append_frames(frames, frame_times).

    Raises:
        EvflowDataError: EV003 (a larger sensor than the format holds), EV020 (size, format,
            exposure or white); and from its block EV003, EV004 (order), EV010, EV013, EV015
            (another size), EV019.

    Example:
        >>> with ef.open_writer("out.npz", (346, 260)) as out:
        ...     out.append(events)
    """
    return writer_of(path, format)(
        path, size, overwrite=overwrite, exposure_us=exposure_us, full_scale=full_scale)


def writer_of(path: str | os.PathLike, format: str | None = None) -> type[EventWriter]:
    """The writer of a format, or of an output's extension; EV020 if there is none, or if the
    extension stands for another format."""
    need(path, str | os.PathLike, "path", "It comes first: write_events(path, events).")
    if format is not None and format not in WRITERS:
        raise EvflowDataError("EV020", f"format={format!r}.", f"Choose from {sorted(WRITERS)}.")
    suffix = Path(path).suffix.lower()
    stands_for = SEVERAL.get(suffix, (WRITTEN[suffix],) if WRITTEN.get(suffix) and suffix else ())
    if format is not None and stands_for and format not in stands_for:
        endings = [s or "none (a folder)" for s, name in WRITTEN.items()
                   if format in SEVERAL.get(s, (name,))]
        raise EvflowDataError(
            "EV020", f"a file with the extension {suffix} does not hold format {format}.",
            f"Name the output with {' or '.join(endings)}, or pass format={stands_for[0]!r} "
            f"(--format {stands_for[0]}).")
    if format is None and suffix not in WRITTEN:
        kinds = ", ".join(f"{s or 'a folder'} ({name})" for s, name in WRITTEN.items())
        raise EvflowDataError(
            "EV020", f"the extension {suffix} of {path} is not one of a format to write.",
            f"Take one of {kinds}, or pass format (--format): {', '.join(WRITERS)}.", where=path)
    return WRITERS[WRITTEN[suffix] if format is None else format]


def _check_named(recording: Recording, parsed: Hints) -> None:
    """Raise EV020 if an image or event stream was named but the file has only one, or none."""
    if parsed.events_topic is not None and all(n.code != "sensor.camera" for n in recording.notes):
        raise EvflowDataError(
            "EV020", f"events_topic={parsed.events_topic!r}, but the file does not have several "
            "streams of events.", "Leave it out (--events-topic).")
    if parsed.frames_topic is not None and all(n.code != "frames.stream" for n in recording.notes):
        raise EvflowDataError(
            "EV020", f"frames_topic={parsed.frames_topic!r}, but the file has no images.",
            "Leave it out (--frames-topic); --frames takes images from elsewhere.")


def _head(path: Path) -> bytes:
    with open(need_regular(path), "rb") as f:
        return f.read(HEAD)

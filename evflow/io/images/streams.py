"""Which images of a recording are the frames of its events: the one place that decides.

A recording may hold several image streams: the camera's own, blurred or rectified copies, depth,
flow, and pictures made from the events. What a stream shows is judged by its name (a topic, a data
set, an output of DV), its size and its encoding. The frames are the raw images whose name is
nearest to that of the events; notes say what was used and what was not. Faulty images never prevent
reading the events: if no stream can be their frames, there are none.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Iterator, Sequence

from evflow.checks import Size
from evflow.errors import EvflowDataError
from evflow.io.hints import Hints
from evflow.notes import Note

# Words in a name (by their beginnings) that say what its images are.
MADE = re.compile("recon|accum|render|visuali|viz|surface|timesurface|sae|iwe|firenet|"
                  "histogram|voxel|edge|polarit")  # made from the events
MADE_LAST = re.compile("event|dvs")  # in the last part only: camera namespaces have such names
OTHER = re.compile("depth|dispar|flow|normals?(map)?$|segment|semantic|mask|label|instance|"
                   "confidence|thermal|infrared|debug|overlay|heatmap|preview")  # no brightness
CHANGED = re.compile("corrupt|blur|nois|denois|rect|undist|crop|resiz|downs|warp")
SIDES = ("left", "right")
# Words that say what a stream holds, not of which camera: a number behind them may count anything.
KINDS = re.compile("event|dvs|aps|image|img|frame|video|raw|mono|gr[ae]y|bit|colou?r|rgb|bgr")
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclasses.dataclass(frozen=True)
class ImageStream:
    """Images of one source. name: as users refer to it; size: of its first image, None if unknown;
    unusable: why they cannot be frames, "" if they can; notes: what to say if they are used;
    elsewhere: whether the file says that they are of another camera than the events."""

    name: str
    size: Size | None = None
    unusable: str = ""
    notes: tuple[Note, ...] = ()
    elsewhere: bool = False


@dataclasses.dataclass(frozen=True)
class Chosen:
    """stream: the frames, or None; notes: what was used, what was not, and why."""

    stream: ImageStream | None
    notes: tuple[Note, ...] = ()


def choose(
    streams: Sequence[ImageStream], hints: Hints, sensor: Size, events: str = ""
) -> Chosen:
    """The image stream that belongs to the events of a sensor (width, height).

    events: their name, as `ImageStream.name`. Raises EV020 (no stream of the requested name), and
    EV015 or EV008 (that one cannot be their frames).
    """
    if hints.no_frames:
        return Chosen(None)
    if hints.late == "join" and streams:
        return Chosen(None, (Note("frames.unused", "frames were not read, because --late join "
                                  "changes the clock of the events"),))
    if hints.frames_topic is not None:
        return _named(streams, hints.frames_topic, sensor, events)
    why = {stream.name: _against(stream, sensor, events) for stream in streams}
    fit = [stream for stream in streams if not why[stream.name]]
    fit = [stream for stream in fit if _kind(stream.name, events) != "changed"] or fit
    near = nearest([stream.name for stream in fit], events)
    fit = [stream for stream in fit if stream.name in near]
    if not alike(near):
        why |= {name: "not the only one" for name in near}
        fit = []
    if not fit:
        return Chosen(None, _left(streams, why, None))
    best = min(fit, key=lambda s: ("raw" not in _own(s.name, events), s.name))
    unused = _left(streams, why, best) if len(streams) > 1 else ()
    return Chosen(best, (*unused, *best.notes))


def nearest(names: Sequence[str], events: str) -> list[str]:
    """Those of the names of streams that are nearest to the name of the events."""
    far = min((_distance(name, events) for name in names), default=None)
    return [name for name in names if _distance(name, events) == far]


def alike(names: Sequence[str]) -> bool:
    """Whether streams are of one place and one camera, by their names."""
    return len({(_parts(name)[:-1], *_camera(name).items()) for name in names}) <= 1


@contextlib.contextmanager
def events_alone() -> Iterator[None]:
    """While frames are read: add to any error how to read the events without them."""
    try:
        yield
    except EvflowDataError as e:
        late = " Late frames: --late drop, or sort." if e.code == "EV004" else ""
        raise EvflowDataError(
            e.code, e.seen,
            f"{e.fix}{late} To read only the events: --no-frames (no_frames=True).".lstrip(),
            where=e.where) from e


def _named(
    streams: Sequence[ImageStream], name: str, sensor: Size, events: str
) -> Chosen:
    """The stream of that name, or the only one whose name ends so."""
    ends = [s for s in streams if s.name == name] or [
        s for s in streams if ("/" + s.name).endswith("/" + name.strip("/"))]
    there = ", ".join(s.name for s in streams) or "none"
    if len(ends) != 1:
        raise EvflowDataError(
            "EV020", f"frames_topic={name!r} matches {len(ends)} image streams.",
            f"There are: {there}. Or read only the events: --no-frames (no_frames=True).")
    stream = ends[0]
    if stream.unusable:
        raise EvflowDataError(
            "EV008", f"images of {stream.name} cannot be frames: {stream.unusable}.",
            f"There are: {there}. Or read only the events: --no-frames (no_frames=True).")
    if stream.size not in (None, sensor):
        raise EvflowDataError(
            "EV015", f"images of {stream.name} are {_size(stream.size)}, the sensor has "
            f"{_size(sensor)}.", "Frames and events must come from the same pixels. Is --size "
            "right? Or read only the events: --no-frames (no_frames=True).")
    made = _kind(stream.name, events) == "made"
    notes = (Note("frames.made", f"images of {stream.name} are made from the events, by their "
                  "name"),) if made else ()
    others = {s.name: "" for s in streams if s is not stream}
    return Chosen(stream, (*_left(streams, others, stream), *notes, *stream.notes))


def _against(stream: ImageStream, sensor: Size, events: str) -> str:
    """Why the images are not used as frames of these events; "" if nothing speaks against it."""
    kind = _kind(stream.name, events)
    if kind == "made":
        return "made from the events, by its name"
    if kind == "other":
        return "not brightness, by its name"
    if stream.unusable:
        return stream.unusable
    if stream.size not in (None, sensor):
        swapped = ": width and height swapped?" if stream.size == sensor[::-1] else ""
        return f"{_size(stream.size)}, the sensor has {_size(sensor)}{swapped}"
    another = stream.elsewhere or another_camera(stream.name, events)
    return "of another camera" if another else ""


def _left(
    streams: Sequence[ImageStream], why: dict[str, str], best: ImageStream | None
) -> tuple[Note, ...]:
    """Notes on what was not used, and what was used instead."""
    others = [s.name + (f" ({why[s.name]})" if why.get(s.name) else "")
              for s in streams if s is not best]
    if not others:
        return () if best is None else (Note("frames.stream", f"frames are from {best.name}"),)
    left = ", ".join(others)
    if best is None:
        other = "; --frames-topic NAME uses one of them" if len(streams) > 1 else ""
        return (Note("frames.unused", f"images were not read as frames: {left}{other}"),)
    return (Note("frames.stream", f"frames are from {best.name}; not used: {left}; "
                 "--frames-topic NAME uses another"),)


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.split("/") if part)


def _shared(name: str, events: str) -> int:
    """How many leading parts the name has in common with that of the events."""
    common = 0
    for one, other in zip(_parts(name)[:-1], _parts(events)[:-1], strict=False):
        if one != other:
            break
        common += 1
    return common


def _distance(name: str, events: str) -> tuple[int, int, int, int]:
    """A smaller value is nearer to the events: first by shared parts, then by sides and numbers of
    cameras that only one of the names has, by further parts, and by other numbers."""
    differ = _camera(name).items() ^ _camera(events).items()
    return (-_shared(name, events), sum(bool(word) for word, _ in differ), len(_parts(name)),
            len(differ))


def _own(name: str, events: str) -> list[str]:
    """The words of a name, in lower case, without the parts it shares with the events."""
    own = "/".join(_parts(name)[_shared(name, events):])
    return [word.lower() for word in WORD.findall(own)]


def _kind(name: str, events: str) -> str:
    """"made" from the events, "other" than brightness, a "changed" image, or an "image"."""
    words, last = _own(name, events), _own(_parts(name)[-1] if _parts(name) else "", "")
    if "e2vid" in name.lower() or any(map(MADE.match, words)) or any(map(MADE_LAST.match, last)):
        return "made"
    if any(map(OTHER.match, words)):
        return "other"
    return "changed" if any(map(CHANGED.match, words)) else "image"


def another_camera(name: str, events: str) -> bool:
    """Whether two names differ by left and right or by the number of a camera, anywhere
    (/cam0_events, /cam1_image), or in a namespace only by such words (/cam/events, /cam1/image)."""
    image, event = _camera(name), _camera(events)
    if any(image[word] != event[word] for word in image.keys() & event.keys() if word):
        return True
    one, other = _parts(name)[:-1], _parts(events)[:-1]
    return one != other and [_plain(part) for part in one] == [_plain(part) for part in other]


def _camera(name: str) -> dict[str, str]:
    """What a name tells of its camera: the number behind each word ("cam": "0"), behind "" if that
    word says what the stream holds; and the side ("left, right": "left")."""
    told, before = {}, ""
    for word in map(str.lower, WORD.findall(name)):
        if word in SIDES:
            told[", ".join(SIDES)] = word
        elif word.isdigit():
            told[before] = word
        else:
            before = "" if KINDS.match(word) else word
    return told


def _plain(part: str) -> tuple[str, ...]:
    """The words of a part of a name without numbers and sides."""
    words = map(str.lower, WORD.findall(part))
    return tuple(word for word in words if not word.isdigit() and word not in SIDES)


def _size(size: Size | None) -> str:
    return "x".join(map(str, size or ()))

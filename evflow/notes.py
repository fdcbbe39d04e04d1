"""What a result is to be read with: notes, each a code to act on and a sentence to read.

A reader notes what it assumed, left out or converted; an estimate, what to know before trusting
it. Code asks for codes, people read texts: nothing else in evflow looks into a text.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from evflow.errors import CODES

NOTES: dict[str, str] = {
    "events.layout": "how the file is laid out was inferred",
    "events.coarse": "times of events lie on coarse steps",
    "events.late": "events whose time goes back were left out, sorted or joined",
    "events.outside": "events outside the sensor were left out",
    "events.partial": "only the part before the damage was read",
    "events.timeless": "events before the first time word were left out",
    "events.turned": "polarity was turned",
    "events.unended": "the last line of a text has no end",
    "events.unit": "another unit of the event times is likelier",
    "events.unread": "something of the file was not read",
    "sensor.camera": "which of several cameras was read",
    "sensor.size": "the size of the sensor was inferred",
    "sensor.unrectified": "events stay at the sensor's own pixels",
    "frames.alpha": "transparent images were laid over a background",
    "frames.clock": "where the times of the frames come from",
    "frames.coarse": "frames come too seldom for the low-pass",
    "frames.cut": "the scene is cut between two frames",
    "frames.dark": "values of frames below their reset are 0",
    "frames.depth": "16-bit frames that do not reach white",
    "frames.fast": "motion too fast to interpolate well",
    "frames.flipped": "frames were mirrored",
    "frames.flow": "motion between frames was not found",
    "frames.gaps": "numbers of images are missing",
    "frames.hdr": "an HDR video was mapped to an ordinary picture",
    "frames.laid": "frames were cropped or scaled",
    "frames.late": "frames whose time goes back were left out or sorted",
    "frames.light": "pixels see more or less light than the frames show",
    "frames.linearised": "a response was undone",
    "frames.luma": "colour frames were converted to luma",
    "frames.made": "a network made the frames of the events",
    "frames.mosaic": "a colour mosaic was converted to luma",
    "frames.moved": "frame times were moved",
    "frames.none": "there are no frames",
    "frames.rate": "the frame rate varies",
    "frames.raw": "frames are a colour mosaic",
    "frames.repeated": "frames repeat the one before",
    "frames.replaced": "frames are those of another file",
    "frames.response": "how frames code light was taken as usual",
    "frames.still": "all frames are the same",
    "frames.stream": "which of several image streams was read",
    "frames.slowed": "times were divided by a slow motion",
    "frames.swept": "a sensor moved over one picture",
    "frames.unit": "the unit of the frame times was inferred",
    "frames.unused": "frames were left out",
    "frames.white": "what radiance is white",
    "levels.few": "all steps of light are of one size",
    "maps.raised": "values that no camera has were raised to the least that one has",
    "std.none": "the weights tell no error",
    "theta.joined": "the thresholds are of another estimate of this camera",
    "scene.static": "nothing moves: the noise alone was measured",
    "scene.steps": "the light of the whole view steps",
    "scene.restless": "the light moves while it should rest",
    "theta.guessed": "thresholds scale with a network's guess of contrast",
    "reading.ended": "reading was ended before all was read",
    "reading.part": "a part of the recording was read",
    "theta_on.drift": "θ ON changed within the recording",
    "theta_on.extrapolated": "θ ON lies outside what the network was trained on",
    "theta_on.uncertain": "few ON events tell θ ON",
    "theta_on.undetermined": "θ ON is the prior's",
    "theta_off.drift": "θ OFF changed within the recording",
    "theta_off.extrapolated": "θ OFF lies outside what the network was trained on",
    "theta_off.uncertain": "few OFF events tell θ OFF",
    "theta_off.undetermined": "θ OFF is the prior's",
    "pixels.dead": "pixels never fire",
    "pixels.fast": "the photoreceptor is too fast for its cutoff to be seen",
    "pixels.hot": "pixels fire by themselves",
    "pixels.slow": "the photoreceptor's low-pass was measured",
    "pixels.unsure": "most pixels have no events of their own",
    "noise.even": "the noise does not fall with light",
    "windows.beyond": "events come before the first frame or after the last",
    "windows.skipped": "windows between frames were left out",
    "truth.none": "no pixel has both events and known flow",
}


@dataclasses.dataclass(frozen=True)
class Note:
    """One thing to know. code: one of `NOTES`, or of `errors.CODES` where a check found it; text:
    a sentence, which is `str(note)`. Another code is a ValueError."""

    code: str
    text: str

    def __post_init__(self) -> None:
        if self.code not in NOTES and self.code not in CODES:
            raise ValueError(f"{self.code!r} is no code of a note.")

    def __str__(self) -> str:
        return self.text


def texts(notes: Iterable[Note]) -> list[str]:
    """Their sentences, each once."""
    return list(dict.fromkeys(note.text for note in notes))


def why_no_frames(notes: Iterable[Note]) -> str:
    """For a message on a recording without frames: ": " and why those there were left out."""
    why = texts(note for note in notes if note.code == "frames.unused")
    return f": {'; '.join(why)}" if why else ""


def as_dicts(notes: Iterable[Note]) -> list[dict[str, str]]:
    """Of each {"code", "text"}, for JSON."""
    return [dataclasses.asdict(note) for note in notes]

"""Notes attached to a result: each has a code, for programs, and a sentence, for people.

A reader notes what it assumed, left out or converted; an estimate notes what to know before
trusting it. Programs test the code; nothing in evflow parses the sentence.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from evflow.errors import CODES

NOTES: dict[str, str] = {
    "events.layout": "how the file is laid out was inferred",
    "events.coarse": "event times have a coarse resolution",
    "events.narrow": "coordinates are stored in too few bits for the sensor",
    "events.gaps": "time in which no pixel sent an event was left out",
    "events.late": "events with decreasing times were left out, sorted or joined",
    "events.none": "no event was simulated",
    "events.outside": "events outside the sensor were left out",
    "events.partial": "only the part before the damage was read",
    "events.timeless": "events before the first timestamp word were left out",
    "events.turned": "polarity was inverted",
    "events.turns": "high bits of the event times are missing and were inferred",
    "events.unended": "the last line of a text file is incomplete",
    "events.unit": "another unit of the event times is more likely",
    "events.unread": "part of the file was not read",
    "sensor.camera": "which of several cameras was read",
    "sensor.size": "the size of the sensor was inferred",
    "sensor.unrectified": "events keep the sensor's raw pixel coordinates",
    "frames.alpha": "transparent images were composited onto a background",
    "frames.balanced": "the planes of a colour mosaic were scaled to one brightness",
    "frames.blur": "the blur of the frames' exposure is left in them",
    "frames.clock": "where the times of the frames come from",
    "frames.coarse": "the frame rate is too low for the low-pass",
    "frames.cut": "the scene is cut between two frames",
    "frames.dark": "frame values below the reset level are 0",
    "frames.delay": "frame times disagree with the events",
    "frames.dense": "frames come faster than an estimate can use",
    "frames.depth": "frames do not use the whole range",
    "frames.exposure": "the blur of the exposure is taken out of the frames, if that is possible",
    "frames.fast": "motion too fast to interpolate well",
    "frames.flipped": "frames were mirrored",
    "frames.flow": "the motion between frames was not found",
    "frames.gaps": "image numbers are missing, or are times",
    "frames.hdr": "an HDR video was tone-mapped",
    "frames.laid": "frames were cropped or scaled",
    "frames.late": "frames with decreasing times were left out or sorted",
    "frames.light": "pixels see more or less light than the frames show",
    "frames.linearised": "the frames' response curve was undone",
    "frames.luma": "colour frames were converted to luma",
    "frames.made": "the frames were reconstructed from the events by a network",
    "frames.mosaic": "a colour mosaic was converted to luma",
    "frames.moved": "frame times were shifted",
    "frames.none": "there are no frames",
    "frames.offset": "light that the frames do not show is hardly determined",
    "frames.rate": "the frame rate varies",
    "frames.raw": "frames are a colour mosaic",
    "frames.repeated": "frames repeat the one before",
    "frames.replaced": "the frames come from another file",
    "frames.response": "the usual response curve of the frames was assumed",
    "frames.rolling": "the rows of the frames are not of one time",
    "frames.still": "all frames are the same",
    "frames.stream": "which of several image streams was read",
    "frames.slowed": "frame times were divided by the slow-motion factor",
    "frames.swept": "the frames are views of a sensor moved over one picture",
    "frames.unit": "the unit of the frame times was inferred",
    "frames.unrolled": "events were moved by the times at which rows of the frames were read",
    "frames.unused": "frames were left out",
    "frames.white": "the value that counts as white",
    "levels.added": "pixels see more or less light than the levels say",
    "levels.black": "whether pixels see more or less light than the levels say is open",
    "levels.clipped": "saturated or black frames hide a level of light",
    "levels.dark": "which logarithm dark levels of light have is open",
    "levels.few": "all light steps have the same size",
    "levels.lux": "the light meter's readings do not fit the frames",
    "maps.raised": "impossible values were raised to the smallest possible one",
    "std.none": "the weights estimate no error",
    "theta.joined": "the thresholds come from another estimate of this camera",
    "scene.static": "nothing moves: only the noise was measured",
    "scene.steps": "the light of the whole view changes in steps",
    "scene.restless": "the light varies when it should be constant",
    "steps.fast": "large steps of light send fewer events than small ones foretell",
    "steps.slow": "pixels are too slow for the rests between steps",
    "steps.small": "steps of light are of few thresholds",
    "steps.skipped": "steps of the light were left out",
    "theta.guessed": "thresholds depend on a network's guess of the contrast",
    "reading.again": "a running camera was measured again, from the pieces that were kept",
    "reading.ended": "reading stopped before the end",
    "reading.part": "only part of the recording was read",
    "theta_on.drift": "θ ON changed within the recording",
    "theta_on.extrapolated": "θ ON lies outside the network's training range",
    "theta_on.uncertain": "few ON events determine θ ON",
    "theta_on.undetermined": "θ ON is the prior's",
    "theta_off.drift": "θ OFF changed within the recording",
    "theta_off.extrapolated": "θ OFF lies outside the network's training range",
    "theta_off.uncertain": "few OFF events determine θ OFF",
    "theta_off.undetermined": "θ OFF is the prior's",
    "pixels.dead": "pixels never fire",
    "pixels.fast": "the photoreceptor's cutoff is too high to be measured",
    "pixels.hot": "pixels fire without a signal",
    "pixels.log": "the pixels' response is logarithmic in dim light too",
    "pixels.losing": "pixels may lose contrast in a dead time",
    "pixels.lost": "pixels lose contrast in their dead time",
    "pixels.map": "which logarithm the pixels have in dim light is open",
    "pixels.open": "whether pixels are slow was not measured",
    "pixels.slow": "the photoreceptor's low-pass was measured",
    "pixels.unsure": "most pixels have no events of their own",
    "noise.assumed": "that noise falls with light is assumed",
    "noise.drift": "light that drifts causes events that are not counted as noise",
    "noise.on": "most noise is ON, and leak was not separated",
    "noise.unlit": "noise falls with light that no frames show",
    "noise.even": "the noise rate does not fall with intensity",
    "windows.beyond": "events come before the first frame or after the last",
    "windows.skipped": "windows between frames were left out",
    "truth.none": "no pixel has both events and known flow",
}


@dataclasses.dataclass(frozen=True)
class Note:
    """One thing to know. code: from `NOTES`, or from `errors.CODES` if a check found it (any other
    code raises ValueError); text: one sentence, also `str(note)`."""

    code: str
    text: str

    def __post_init__(self) -> None:
        if self.code not in NOTES and self.code not in CODES:
            raise ValueError(f"{self.code!r} is not a known note code.")

    def __str__(self) -> str:
        return self.text


def texts(notes: Iterable[Note]) -> list[str]:
    """The distinct sentences of the notes."""
    return list(dict.fromkeys(note.text for note in notes))


def why_no_frames(notes: Iterable[Note]) -> str:
    """": " and the reasons why a recording's frames were left out, for messages; "" if none."""
    why = texts(note for note in notes if note.code == "frames.unused")
    return f": {'; '.join(why)}" if why else ""


def as_dicts(notes: Iterable[Note]) -> list[dict[str, str]]:
    """One {"code", "text"} per note, for JSON."""
    return [dataclasses.asdict(note) for note in notes]

"""The timing of frames as it was measured: their exposure, in recordings whose files do not tell
it, and what their times are wrong by (frame_timing.py)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from evflow.estimation.refine.stretches import Stretch
from evflow.io.images.exposures import BLURRED
from evflow.types import Recording

TELLING = (BLURRED, "frames.dense")  # notes of recordings in which it is not to be measured


@dataclasses.dataclass(frozen=True)
class Exposure:
    """seconds, std_s: of the frames, 0 and NaN if it cannot be told from none."""

    seconds: float = 0.0
    std_s: float = float("nan")


@dataclasses.dataclass(frozen=True)
class Late:
    """seconds, std_s: by which events come after frames that show the same, 0 and NaN if it cannot
    be told from none, or from slow pixels; exposed_s: the untold exposure with which slow pixels
    would do the same, 0 if there is none."""

    seconds: float = 0.0
    std_s: float = float("nan")
    exposed_s: float = 0.0


UNSEEN, ON_TIME = Exposure(), Late()


def with_exposures(
    stretches: Sequence[Stretch], exposure: Exposure, before: Exposure = UNSEEN
) -> tuple[Stretch, ...]:
    """The stretches, with `with_exposure` of their recordings, one of each. before: what they have
    of an earlier measurement, which this replaces."""
    recordings = {id(s.recording): s.recording for s in stretches}
    changed = {key: with_exposure(recording, exposure.seconds, before.seconds)
               for key, recording in recordings.items()}
    return tuple(dataclasses.replace(s, recording=changed[id(s.recording)]) for s in stretches)


def with_exposure(recording: Recording, seconds: float, before_s: float = 0.0) -> Recording:
    """The recording with a measured exposure of its frames, if there is one and no other is told.
    before_s: an earlier measured one."""
    earlier = before_s and recording.exposure_us == round(1e6 * before_s)
    if not seconds or not (earlier or is_untold(recording)):
        return recording
    return dataclasses.replace(recording, exposure_us=round(1e6 * seconds))


def is_untold(recording: Recording) -> bool:
    """Whether neither a file nor the user says how long the frames were exposed, and it can be
    long: of frames that come faster than an estimate uses it cannot."""
    told = any(note.code in TELLING for note in recording.notes)
    return not (recording.exposure_us or told or recording.frames_were_made)

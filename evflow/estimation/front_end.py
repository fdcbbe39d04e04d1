"""The front end of a camera's pixels: how they see what the frames show, and their dead time.

It is measured before anything else is read, on a few stretches, as all evidence depends on it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from evflow.camera.sensors import DeadContrast
from evflow.estimation.dead_time import DeadTime, dead_time, first_events
from evflow.estimation.refine import Found, Lost, Stretch, find_photoreceptor, frame_noise
from evflow.estimation.refine.frame_exposure import Exposure
from evflow.estimation.refine.frame_timing import UNTIMED, Timing, frame_timing
from evflow.estimation.refine.path import Films
from evflow.estimation.refine.photoreceptor import STRETCHES, receptor_places
from evflow.recordings.faulty_pixels import dead_pixels, hot_among_neighbours
from evflow.simulator.photoreceptor import IDEAL, Photoreceptor

WAITING_S = 2e-3  # dead time from which events that wait for it come noticeably late


@dataclasses.dataclass(frozen=True, eq=False)
class FrontEnd:
    """seen_by: how the pixels see what the frames show; noise_dn, blur_s: the frames' noise in DN
    and their exposure, 0 if it is unknown; found: the search for the photoreceptor, None if there
    was none; dead: the dead time; lost: the contrast that pixels lose in it, None if they send it
    all; faulty: (H, W) bool, pixels that fire alone or never, None if there are none; films: of
    stretches that are still to be read; timing: of the frames, as far as it was measured; sought:
    whether a photoreceptor was looked for."""

    seen_by: Photoreceptor = IDEAL
    noise_dn: float = 0.0
    blur_s: float = 0.0
    found: Found | None = None
    dead: DeadTime = dataclasses.field(default_factory=DeadTime)
    lost: Lost | None = None
    faulty: np.ndarray | None = None
    films: Films = dataclasses.field(default_factory=dict)
    timing: Timing = UNTIMED
    sought: bool = False

    @property
    def law(self) -> DeadContrast:
        """What becomes of contrast in the dead time."""
        return self.lost.law if self.lost else "keeps"


def find_timing(stretches: Sequence[Stretch], *, measured: bool) -> Timing:
    """The exposure of the frames, where nobody says it and their blur shows it, and what their
    times are wrong by. Events that wait for a long dead time are late and as if blurred themselves:
    there nothing is known. measured: as of `find_front_end`."""
    places = receptor_places([(s.recording, s.run) for s in stretches if s.run])
    if not measured or not places:
        return UNTIMED
    found = frame_timing(places)
    if found != UNTIMED and _dead_time(stretches).seconds > WAITING_S:
        return UNTIMED
    return found


def find_front_end(
    stretches: Sequence[Stretch], timing: Timing = UNTIMED, *, measured: bool
) -> FrontEnd:
    """Measure the front end on some stretches of a recording. timing: as measured; the
    recordings have its exposure. measured: False assumes ideal pixels."""
    dead = _dead_time(stretches)
    faulty = _faulty(stretches)
    runs = [(s.recording, s.run) for s in stretches if s.run]
    if not runs:
        return FrontEnd(dead=dead, faulty=faulty, timing=timing)
    noise_dn = frame_noise([(recording, i) for recording, run in runs for i in run])
    films: Films = {}
    found, lost = (find_photoreceptor(
        runs, noise_dn, films, shortest_s=dead.shortest_s, edge_s=dead.edge_s,
        measured=dead.measured) if measured else (None, None))
    blur_s = 1e-6 * float(np.mean([recording.exposure_us for recording, _ in runs]))
    seen_by = found.used if found else IDEAL
    return FrontEnd(seen_by, noise_dn, blur_s, found, settled(dead, lost), lost, faulty, films,
                    timing, sought=measured)


def settled(dead: DeadTime, lost: Lost | None) -> DeadTime:
    """The dead time, given what is lost in it: shorter than the intervals of pixels that lose."""
    if lost is None or lost.law == "keeps":
        return dead
    return DeadTime(lost.dead_s, lost.std_s)


def agree(before: FrontEnd, now: FrontEnd) -> bool:
    """Whether a later measurement leaves an earlier one as it is: where it finds nothing, or the
    same laws, and constants within two of its standard deviations."""
    if before.found is None or now.found is None:
        return now.found is None
    if before.law != now.law or not _same(before.timing.exposure, now.timing.exposure):
        return False
    one, other = before.seen_by, now.seen_by
    away = [getattr(one, name) - getattr(other, name) for name in ("offset_dn", "tau_s", "delay_s")]
    return (one.log_map, one.by_light) == (other.log_map, other.by_light) and bool(
        (np.abs(away) <= 2.0 * now.found.std).all())


def with_dead_time(before: FrontEnd, now: FrontEnd) -> FrontEnd:
    """An earlier front end, with the dead time of a later one where that has measured it. Where
    pixels lose contrast, it was found together with the loss, and stays."""
    if before.law != "keeps" or not now.dead.measured:
        return before
    return dataclasses.replace(before, dead=now.dead)


def _dead_time(stretches: Sequence[Stretch]) -> DeadTime:
    return dead_time(first_events(max((s.recording.events for s in stretches), key=len)))


def _same(before: Exposure, now: Exposure) -> bool:
    """As `agree`, of the exposure."""
    if not (before.seconds and now.seconds):
        return not now.seconds
    return abs(before.seconds - now.seconds) <= 2.0 * now.std_s


def _faulty(stretches: Sequence[Stretch]) -> np.ndarray | None:
    """Hot and dead pixels of a few stretches; None if there are none."""
    few = [stretches[i] for i in np.unique(np.linspace(0, len(stretches) - 1, STRETCHES).round())
           .astype(int)]
    counts = sum(s.recording.events.slice(*s.span_us).count_map().sum(0) for s in few)
    faulty = hot_among_neighbours(np.asarray(counts)) | dead_pixels(np.asarray(counts))
    return faulty if faulty.any() else None

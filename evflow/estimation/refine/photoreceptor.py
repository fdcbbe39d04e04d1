"""The photoreceptor of a camera and the offset and delay of its frames, from a few stretches of its
recording: their paths, their events, and the search (receptor_search.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from evflow.estimation.refine.denoise import LEAST_DN
from evflow.estimation.refine.lost_contrast import Lost, lost_contrast
from evflow.estimation.refine.path import STEPS, Films, Place, as_seen, interpolated, of_place
from evflow.estimation.refine.readouts import without_readouts
from evflow.estimation.refine.receptor_data import Part, Sample, sample
from evflow.estimation.refine.receptor_result import Found
from evflow.estimation.refine.receptor_search import find
from evflow.estimation.refine.receptor_smoothed import smoothed
from evflow.estimation.refine.sightings import sight
from evflow.estimation.refine.still_noise import hot_ones
from evflow.estimation.refine.stretches import LARGE, most_simulated, spread
from evflow.estimation.refine.waiting import kept_contrast, without_waiting
from evflow.process.memory import give_back
from evflow.recordings.bunches import bunch
from evflow.simulator.photoreceptor import IDEAL

STRETCHES = 3  # used in the search


def receptor_places(places: Sequence[Place]) -> list[Place]:
    """At most STRETCHES of the places, evenly spread, for the search for the photoreceptor."""
    if not places:
        return []
    longest = spread([len(run) for _, run in places], most_simulated(places[0][0].events.size))
    chosen = np.unique(np.linspace(0, len(longest) - 1, min(STRETCHES, len(longest))).round())
    return [places[longest[k]] for k in chosen.astype(int)]


def receptor_sample(
    places: Sequence[Place], noise_dn: float = 0.0, films: Films | None = None
) -> Sample | None:
    """Pixels and events for the search for the photoreceptor.

    Args:
        places: runs of frame intervals, of which `receptor_places` are used.
        noise_dn: std of the frames' noise.
        films: cache that receives the interpolated runs, if these are few and small.

    Returns:
        The sample, its path smoothed in time where frames are noisy; None with too few events.
    """
    def parts() -> Iterator[Part]:
        for recording, run in receptor_places(places):
            film = interpolated(recording, run, STEPS, noise_dn)
            s = sight(recording.events, film.times_us, as_seen(film, IDEAL), STEPS, film.shown)
            s, disturbed = without_readouts(s, film.times_us, bunch(recording))
            if films is not None and len(places) <= STRETCHES and film.dn[0].size <= LARGE:
                films[of_place(recording, run)] = film
            hot = hot_ones(s, film.dt_s)
            yield film.dn, np.repeat(film.dt_s / STEPS, STEPS), s, disturbed, hot.ravel()
            del film, s, disturbed, hot
            give_back()

    data = sample(parts())
    return smoothed(data) if data is not None and noise_dn >= LEAST_DN else data


def find_photoreceptor(
    places: Sequence[Place], noise_dn: float = 0.0, films: Films | None = None, *,
    shortest_s: float = 0.0, edge_s: float = 0.0, measured: bool = False,
) -> tuple[Found | None, Lost | None]:
    """The photoreceptor of a camera and the offset and delay of its frames, and the contrast that
    its pixels lose in their dead time.

    Args:
        places, noise_dn, films: as of `receptor_sample`.
        shortest_s, edge_s: as of `lost_contrast`; 0 where no shortest intervals are known.
        measured: whether the shortest intervals are the dead time.

    Returns:
        The photoreceptor, None with too few events; and what is lost, None if it is kept and is
        sent almost completely.
    """
    data = receptor_sample(places, noise_dn, films)
    if data is not None and measured:
        data = without_waiting(data, shortest_s)
    found = find(data) if data is not None else None
    if data is None or found is None or not shortest_s:
        return found, None
    found, lost = lost_contrast(data, found, shortest_s, edge_s)
    if lost is None and measured:
        lost = kept_contrast(data, found, shortest_s)
    return found, lost

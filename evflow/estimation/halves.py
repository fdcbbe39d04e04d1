"""A recording divided in two, to test what its first part predicts on the second.

The stretches of the longest time without a gap are divided where two of them meet, near the middle.
What was read of the first part is a `State` of its own (sums over stretches), so nothing is read
again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from evflow.estimation.dead_time import dead_time, first_events
from evflow.estimation.finish import estimate
from evflow.estimation.front_end import settled
from evflow.estimation.refine import Stretch, find_photoreceptor
from evflow.estimation.refine.photoreceptor import receptor_places
from evflow.estimation.refine.stretches import spread
from evflow.estimation.result import CameraEstimate
from evflow.estimation.state import State, add
from evflow.simulator.photoreceptor import IDEAL
from evflow.types import Recording


@dataclasses.dataclass(frozen=True)
class Division:
    """first: numbers of the stretches of the first part; rest: (first, last) frame of the second
    part, which begins where the first one ends."""

    first: range
    rest: tuple[int, int]


@dataclasses.dataclass(frozen=True, eq=False)
class FirstPart:
    """What an estimate computed from a recording's first part. state: the sums over what was read
    of it; searched: the stretches in which its photoreceptor was looked for; rest: (first, last)
    frame of the rest."""

    state: State
    searched: tuple[Stretch, ...]
    rest: tuple[int, int]

    def rest_of(self, recording: Recording) -> tuple[int, int]:
        """(first, last) frame of the rest in the recording as it was handed in: frames may have
        been left out of the one that was read."""
        times = self.state.read[0].recording.frame_times[list(self.rest)]
        first, last = np.searchsorted(recording.frame_times, times, side="left").tolist()
        return first, min(last, len(recording.frame_times) - 1)

    def estimate(self) -> CameraEstimate:
        """The camera, estimated from the first part alone."""
        return estimate(_on_its_own(self))


def divided(stretches: Sequence[Stretch]) -> Division | None:
    """Where to divide a recording's stretches, in time order; None if no two meet, or without a
    path.
    """
    groups: list[range] = []
    for i, stretch in enumerate(stretches):
        if not stretch.run:
            return None
        if groups and stretches[i - 1].run[-1] + 1 == stretch.run[0]:
            groups[-1] = range(groups[-1].start, i + 1)
        else:
            groups.append(range(i, i + 1))
    group = max(groups, key=lambda g: stretches[g[-1]].run[-1] - stretches[g[0]].run[0])
    if len(group) < 2:
        return None
    begin, end = stretches[group[0]].run[0], stretches[group[-1]].run[-1] + 1
    cut = min(group[1:], key=lambda i: abs(2 * stretches[i].run[0] - begin - end))
    return Division(range(group[0], cut), (stretches[cut].run[0], end))


def _on_its_own(first: FirstPart) -> State:
    """The state with photoreceptor and dead time as measured on the first part itself; the frames'
    exposure stays that of the whole."""
    state, front_end = first.state, first.state.front_end
    runs, searched = ([(s.recording, s.run) for s in part] for part in (state.read, first.searched))
    events = state.read[0].recording.events
    end = int(state.read[0].recording.frame_times[first.rest[0]])
    dead = dead_time(first_events(events.slice(int(events.t[0]), end)))
    found, lost = front_end.found, front_end.lost
    if found is not None and receptor_places(runs) != receptor_places(searched):
        found, lost = find_photoreceptor(
            runs, front_end.noise_dn, shortest_s=dead.shortest_s, edge_s=dead.edge_s,
            measured=dead.measured)
    seen_by = found.used if found is not None else IDEAL
    own = dataclasses.replace(front_end, seen_by=seen_by, found=found,
                              dead=settled(dead, lost), lost=lost, films={})
    if seen_by != front_end.seen_by:
        simulated = spread([len(s.run) for s in state.read], max(len(state.chunks), 1))
        state = State(state.params, own)
        for i, stretch in enumerate(first.state.read):
            state = add(state, stretch, simulate=i in simulated)
    return dataclasses.replace(state, front_end=own)

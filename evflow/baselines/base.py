"""Shared by the compared systems: the protocol, its result, and the input data.

A `System` is a frozen dataclass of its options. `fit` takes a recording and never fails for lack of
data: values that cannot be measured are marked invalid and set to a default, never NaN. Thresholds
are in natural-log units of the lin-log map, as everywhere.
"""

from __future__ import annotations

import abc
import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from evflow.camera import THETA_MIN, Camera
from evflow.errors import EvflowDataError
from evflow.estimation.refine.trace import trace_of_events
from evflow.light.log_maps import lin_log
from evflow.light.logarithm import LIN_LOG, Logarithm
from evflow.recordings import plan_windows
from evflow.types import Recording

UNKNOWN = 0.3  # log units: default, the middle of the common range .1-.5
THETA_MAX = 2.0  # log units: a factor of seven; larger fits have diverged


@dataclasses.dataclass(frozen=True, eq=False)
class Fitted:
    """Estimate of a camera by a system.

    camera: maps (H, W), finite and positive everywhere; eta is 0 if a system measures none;
    valid: (2, H, W) bool, ON and OFF, where the map was measured; theta: (2,) median thresholds
    over the valid pixels, ON and OFF (over the whole map if there are none); seconds: run time;
    notes: sentences; spread: (2,) standard deviation of pixels' thresholds about the map, if a
    system estimates one; logarithm: that of the thresholds.
    """

    camera: Camera
    valid: np.ndarray
    theta: np.ndarray
    seconds: float
    notes: tuple[str, ...] = ()
    spread: tuple[float, float] = (0.0, 0.0)
    logarithm: Logarithm = LIN_LOG

    def save(self, path: Path) -> None:
        """Write the camera, with the spread as its pixels' standard deviation; all or nothing."""
        on, off, none = (np.full(self.camera.shape, s) for s in (*self.spread, 0.0))
        self.camera.save(path, theta_on_std=on, theta_off_std=off, eta_on_std=none,
                         eta_off_std=none)

    @property
    def found(self) -> np.ndarray:
        """(2,) bool: whether anything was measured, ON and OFF."""
        return np.asarray(self.valid.any((1, 2)))


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """A system's unchecked result: theta (2, H, W); valid (2, H, W) bool; eta (2,) in Hz; spread
    (2,) as of Fitted."""

    theta: np.ndarray
    valid: np.ndarray
    eta: tuple[float, float] = (0.0, 0.0)
    notes: tuple[str, ...] = ()
    spread: tuple[float, float] = (0.0, 0.0)


class System(abc.ABC):
    """A method that estimates thresholds from a recording; its options are its fields."""

    # Most recordings in a table: few for systems that train for minutes on each.
    most_recordings: ClassVar[float] = math.inf

    @property
    def logarithm(self) -> Logarithm:
        """That of its thresholds."""
        return LIN_LOG

    @abc.abstractmethod
    def solve(self, recording: Recording) -> Solution:
        """The unchecked result; raises EvflowDataError where the recording is insufficient."""

    def fit(self, recording: Recording) -> Fitted:
        """Thresholds of a recording. Insufficient recordings and fits that diverge or leave
        [.01, 2] give default values that are marked invalid."""
        start = time.perf_counter()
        width, height = recording.events.size
        try:
            solution = self.solve(recording)
        except EvflowDataError as error:
            solution = nothing((height, width), str(error))
        theta = np.asarray(solution.theta, np.float32)
        sound = np.isfinite(theta) & (theta >= THETA_MIN) & (theta <= THETA_MAX)
        valid = solution.valid & sound
        theta = np.clip(np.where(np.isfinite(theta), theta, UNKNOWN), THETA_MIN, THETA_MAX)
        medians = [np.median(t[v] if v.any() else t) for t, v in zip(theta, valid, strict=True)]
        eta = (jnp.full((height, width), e, jnp.float32) for e in solution.eta)
        camera = Camera(*map(jnp.asarray, theta), *eta).validate()
        return Fitted(camera, valid, np.array(medians), time.perf_counter() - start,
                      solution.notes, solution.spread, self.logarithm)


def nothing(shape: tuple[int, int], note: str, theta: float = UNKNOWN) -> Solution:
    """No result: `theta` everywhere, valid nowhere."""
    return Solution(np.full((2, *shape), theta, np.float32), np.zeros((2, *shape), bool),
                    notes=(note,))


def constant(
    shape: tuple[int, int], theta: np.ndarray, found: np.ndarray, *notes: str,
    eta: tuple[float, float] = (0.0, 0.0), spread: float = 0.0,
) -> Solution:
    """One threshold per polarity, theta (2,), for all pixels; found (2,): whether measured; spread:
    of both polarities."""
    maps = np.broadcast_to(np.asarray(theta, np.float32)[:, None, None], (2, *shape))
    valid = np.broadcast_to(np.asarray(found, bool)[:, None, None], (2, *shape))
    return Solution(maps, valid, eta, notes, (spread, spread))


@dataclasses.dataclass(frozen=True, eq=False)
class Interval:
    """The time between two neighbouring frames: counts (2, H, W) float32 of ON and OFF events, the
    log frames (H, W) at its ends, and whether it begins at the end of the one before."""

    counts: np.ndarray
    before: np.ndarray
    after: np.ndarray
    continues: bool


def usable(recording: Recording) -> list[int]:
    """The intervals i (frame i to i + 1) with events and without glitches. Raises EV001, EV011,
    EV012 and EV017 if there are none."""
    plan = plan_windows(recording, 1)
    found = [i for first, last in plan.pairs for i in range(first, last)]
    if not found:
        raise EvflowDataError("EV017", "no frame interval can be used "
                              f"({'; '.join(map(str, plan.skipped[:2]))}).")
    return found


def intervals(
    recording: Recording, log: Callable[[np.ndarray], object] = lin_log
) -> Iterator[Interval]:
    """The usable intervals in time order, one in memory at a time; log maps DN to log units."""
    last, after = -2, np.zeros(0)
    for i in usable(recording):
        continues = last == i - 1
        before = after if continues else np.asarray(log(recording.frame_dn(i)))
        after, last = np.asarray(log(recording.frame_dn(i + 1))), i
        trace = trace_of_events(recording.events, recording.frame_times[i:i + 2], 1)
        yield Interval(np.asarray(trace.counts)[0], before, after, continues)

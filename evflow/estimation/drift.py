"""Did the camera stay the same? Compares the thirds of a recording.

The pooled regression of every stretch gives both thresholds. Their scatter within a third is the
third's error; it includes contrast that the motion estimate misses at high speeds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from evflow.estimation.refine import PixelEvidence
from evflow.estimation.refine.receptor_result import contrast_kept
from evflow.estimation.refine.still_noise import unlike_the_path
from evflow.notes import Note

Array = np.ndarray

LEAST_PARTS = 3  # stretches in each third
LEAST_EVENTS = 500.0  # of a stretch, in the regression
APART = 3.5  # standard deviations of a difference: one steady recording in a thousand exceeds it
LEAST_APART = 0.04  # of a threshold: smaller differences come from changing motion


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """middle_us: of a stretch; theta: (2,) from its regression, NaN if undetermined."""

    middle_us: int
    theta: Array


@dataclasses.dataclass(frozen=True)
class Third:
    """A third of the time that was read.

    Attributes:
        begin_us: start, on the recording's clock.
        end_us: end.
        stretches: number of stretches used.
        theta_on: ON threshold from the pooled regression, natural-log units.
        theta_off: OFF threshold likewise.
        std_on: standard deviation of theta_on.
        std_off: standard deviation of theta_off.
    """

    begin_us: int
    end_us: int
    stretches: int
    theta_on: float
    theta_off: float
    std_on: float
    std_off: float

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        return dataclasses.asdict(self)


def part(span_us: tuple[int, int], evidence: PixelEvidence) -> Part:
    """The thresholds from a single stretch's evidence."""
    equations = evidence.equations
    aa, ab, bb, _, _, yy, events = equations
    if (odd := unlike_the_path(aa + 2 * ab + bb, yy, events)).any():
        equations = equations * ~odd
    aa, ab, bb, ay, by, yy, events = equations.sum((1, 2))
    middle, scale = sum(span_us) // 2, np.array([[aa, ab], [ab, bb]])
    if events < LEAST_EVENTS or np.linalg.det(scale) <= 1e-6 * aa * bb or yy <= 0:
        return Part(middle, np.full(2, np.nan))
    theta = np.linalg.solve(scale, [ay, by])
    explained = float(theta @ [ay, by]) / yy
    kept = contrast_kept(explained)
    return Part(middle, theta / kept)


def thirds(parts: Sequence[Part], excess: Array | float = 1.0) -> tuple[Third, ...]:
    """The thirds of the time between the first and the last stretch; empty if one of them has too
    few stretches. excess: (2,) by which the parts' thresholds are too high."""
    parts = sorted((p for p in parts if np.isfinite(p.theta).all() and (p.theta > 0).all()),
                   key=lambda p: p.middle_us)
    if len(parts) < 3 * LEAST_PARTS:
        return ()
    edges = np.linspace(parts[0].middle_us, parts[-1].middle_us + 1, 4)
    log_theta = np.log([p.theta / excess for p in parts])
    which = np.searchsorted(edges[1:3], [p.middle_us for p in parts], side="right")
    count = np.bincount(which, minlength=3)
    if count.min() < LEAST_PARTS:
        return ()
    mean = np.stack([log_theta[which == k].mean(0) for k in range(3)])
    scatter = np.sqrt(((log_theta - mean[which]) ** 2).sum(0) / (len(parts) - 3))
    found = []
    for k in range(3):
        theta, error = np.exp(mean[k]), scatter / np.sqrt(count[k])
        found.append(Third(int(edges[k]), int(edges[k + 1]), int(count[k]), *map(float, theta),
                           *map(float, theta * error)))
    return tuple(found)


def changed(found: Sequence[Third]) -> list[str]:
    """"on", "off": thresholds that differ between two of the thirds by more than their errors
    allow.
    """
    names = []
    for name in ("on", "off"):
        log_theta = np.log([getattr(t, f"theta_{name}") for t in found])
        error = np.array([getattr(t, f"std_{name}") / getattr(t, f"theta_{name}") for t in found])
        for i, j in ((0, 1), (0, 2), (1, 2)) if len(found) else ():
            away = abs(log_theta[i] - log_theta[j])
            if away > max(LEAST_APART, APART * float(np.hypot(error[i], error[j]))):
                names.append(name)
                break
    return names


def notes(found: Sequence[Third]) -> list[Note]:
    """A note on each threshold that changed."""
    result = []
    for name in changed(found):
        values = ", ".join(f"{getattr(t, f'theta_{name}'):.3f} ± {getattr(t, f'std_{name}'):.3f}"
                           for t in found)
        result.append(Note(
            f"theta_{name}.drift", f"θ {name.upper()} differs between the three thirds of the "
            f"recording ({values}): were biases, temperature or light changed? The estimate is a "
            "mean over them; --start and --stop select a part."))
    return result

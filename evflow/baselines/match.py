"""MATCH: the thresholds at which a simulation of the same scene has the recorded event counts.

Nothing is learned. Per polarity, the mean over pixels of the square root of the count is matched.
The root limits the influence of the few pixels at the threshold's clamp, which send most events at
a wide mismatch. The scene is the recording's frames with motion-compensated ones in between (its
accuracy is that of the flow), or the true video where known.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import numpy as np

from evflow.baselines.base import Solution, System, constant
from evflow.baselines.resimulate import Path, Scene, scene_of
from evflow.types import Recording

GRID = np.geomspace(0.03, 1.2, 10)  # log units: equal ON and OFF thresholds to start from
OFFSET = 0.08  # log theta: finite differences; smaller ones are dominated by steps of the counts
OFFSETS = OFFSET * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
PASSES = 6
CLOSE = 2e-3  # log units, both statistics together: a tenth of the counts' precision
# With hardly any events the statistic is flat: a tenth of its usual slope, d log root / d log
# theta = -1, regularises the step.
HOLD = 0.1
LONGEST_STEP = 0.5  # log theta per pass
LOW, HIGH = 0.02, 2.0
MATCHED = 0.05  # log units: larger residuals of the statistic mean that the fit has failed
SIGMAS = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2)
MODEL_ERROR = 0.05  # log units: error of a statistic by interpolation
COUNTS, ROOTS, ACTIVE, PIXELS = range(4)


@dataclasses.dataclass(frozen=True)
class Match(System):
    """path: "flow" interpolates the frames, "given" takes them as the video itself.
    mismatch: standard deviation of the thresholds over pixels; None: the one at which the mean
        count, which depends on heavy tails, agrees too.
    start: "fresh" as a simulation, with the memory at the first frame; "running" anywhere between
        the thresholds; "auto": the likelier. Options left open are chosen by the mean counts and
        active pixels, which are not matched.
    """

    path: Path = "flow"
    mismatch: float | None = None
    start: Literal["auto", "fresh", "running"] = "auto"
    seed: int = 0

    def solve(self, recording: Recording) -> Solution:
        scene, key = scene_of(recording, self.path), jax.random.key(self.seed)
        width, height = recording.events.size
        if not (scene.seen[ROOTS] > 0).any():
            return constant((height, width), np.full(2, HIGH), np.zeros(2, bool), "no events")
        starts = {"auto": (1.0, 0.0), "fresh": (1.0,), "running": (0.0,)}[self.start]
        sigmas = SIGMAS if self.mismatch is None else (self.mismatch,)
        fits = []
        for fresh in starts:
            theta = from_grid(scene, key, sigmas[len(sigmas) // 2], fresh)
            for sigma in sigmas:
                theta, excess = newton(scene, key, theta, sigma, fresh)
                fits.append((chi_square(scene, excess), sigma, fresh, theta, excess[ROOTS]))
        _, sigma, fresh, theta, excess = min(fits, key=lambda fit: fit[0])
        found = (np.abs(excess) < MATCHED) & (scene.seen[COUNTS] > 0)
        return constant((height, width), theta, found, f"mismatch {sigma:g}",
                        "fresh start" if fresh else "running start",
                        eta=(float(scene.eta[0]), float(scene.eta[1])), spread=sigma)


def chi_square(scene: Scene, excess: np.ndarray) -> float:
    """Chi-square of all statistics, with variances of counts and model."""
    variance = MODEL_ERROR**2 + 1.0 / (scene.seen[[COUNTS, ROOTS, ACTIVE]] + 1.0)
    return float((excess**2 / variance).sum())


def camera_rows(scene: Scene, theta: np.ndarray, sigma: float) -> np.ndarray:
    """Rows (V, 6) of cameras with thresholds theta (V, 2) and the scene's noise."""
    eta = np.broadcast_to(scene.eta, theta.shape)
    return np.concatenate([theta, eta, np.full_like(theta, sigma)], 1)


def log_statistics(statistics: np.ndarray) -> np.ndarray:
    """log means (..., 3, 2) of counts, roots and active pixels, half an event added to each sum."""
    return np.log((statistics[..., :PIXELS, :] + 0.5) / statistics[..., PIXELS:, :])


def from_grid(scene: Scene, key: jax.Array, sigma: float, fresh: float) -> np.ndarray:
    """theta (2,) at which cameras with equal ON and OFF thresholds give the recorded roots, by
    log-log interpolation on GRID, clipped to its ends."""
    made = scene.simulate(key, camera_rows(scene, np.stack([GRID] * 2, 1), sigma), fresh)
    made, seen = (log_statistics(s)[..., ROOTS, :] for s in (made, scene.seen))
    falling, grid = np.minimum.accumulate(made)[::-1], np.log(GRID)[::-1]
    return np.exp([np.interp(seen[i], falling[:, i], grid) for i in range(2)])


def newton(
    scene: Scene, key: jax.Array, theta: np.ndarray, sigma: float, fresh: float
) -> tuple[np.ndarray, np.ndarray]:
    """theta (2,) that matches the roots of both polarities, and the log ratio (3, 2) of simulated
    to recorded statistics."""
    seen, jacobian = log_statistics(scene.seen), np.eye(2)
    best = (np.inf, theta, np.zeros((3, 2)))
    for k in range(PASSES):
        rows = theta * np.exp(OFFSETS if k % 2 == 0 else OFFSETS[:1])
        excess = log_statistics(scene.simulate(key, camera_rows(scene, rows, sigma), fresh)) - seen
        roots = excess[:, ROOTS]
        if len(rows) > 1:  # slopes are reused for two passes
            jacobian = (roots[1:] - roots[0]).T / OFFSET
        if (size := float(np.abs(roots[0]).sum())) < best[0]:
            best = (size, theta, excess[0])
        if size < CLOSE:
            break
        hold = HOLD**2 * np.eye(2)
        change = -np.linalg.solve(jacobian.T @ jacobian + hold, jacobian.T @ roots[0])
        theta = theta * np.exp(np.clip(change, -LONGEST_STEP, LONGEST_STEP))
        theta = np.clip(theta, LOW, HIGH)
    return best[1], best[2]

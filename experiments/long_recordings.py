"""Long recordings of a hidden camera: what an estimate costs, and how near it comes.

    python -m experiments.long_recordings --images photographs/ --seconds 30 --keep /tmp/long

Photographs side by side pan before the camera at 1000 frames per second; 25 of them a second are
kept, as a DAVIS346 records them. Printed are the CPU seconds of `estimate_camera`, the largest
memory of the process (which has simulated the recording, unless it was kept), the errors of the
summary and of the pixels, and how often the 95 % interval holds the truth.
"""

from __future__ import annotations

import dataclasses
import resource
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evflow import Camera, CameraEstimate, estimate_camera
from evflow.network.weights import load_weights
from experiments.shared.common import begin, conclude, estimator, markdown, run_script
from experiments.shared.panned_photographs import Pan, recorded


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Estimate a camera from a long recording."""

    images: Path
    """Folder of photographs."""
    keep: Path
    """Folder in which recordings are kept between runs."""
    out: Path = Path("out/long_recordings")
    seed: int = 5_000_101
    seconds: float = 30.0
    size: tuple[int, int] = (346, 260)
    frames_hz: int = 25
    """A divisor of 1000."""
    mismatch: float = 0.03
    effort: Literal["quick", "normal", "full"] = "normal"
    weights: str = "default"


def score(found: CameraEstimate, camera: Camera) -> dict[str, float]:
    """Errors of the summary and of the pixels, and whether intervals hold the truth."""
    result: dict[str, float] = {}
    for side in ("on", "off"):
        truth = np.asarray(getattr(camera, f"theta_{side}"))
        theta, std = (np.asarray(getattr(c, f"theta_{side}")) for c in (found.camera, found.std))
        summary, error = (float(getattr(s, f"theta_{side}"))
                          for s in (found.summary, found.summary_std))
        away = summary - float(np.median(truth))
        result |= {f"summary_error_{side}": away, f"summary_z_{side}": away / error,
                   f"mae_pixel_{side}": float(np.abs(theta - truth).mean()),
                   f"r_{side}": float(np.corrcoef(theta.ravel(), truth.ravel())[0, 1]),
                   f"within_95_{side}": float((np.abs(theta - truth) < 1.96 * std).mean())}
    return result


def main(options: Options) -> dict[str, Any]:
    begin(options, "long_recordings")
    estimator(options.weights, "summary")
    path, camera = recorded(Pan(options.images, options.size, options.seconds, options.frames_hz,
                                options.mismatch, options.seed), options.keep)
    before, wall = time.process_time(), time.monotonic()
    found = estimate_camera(path, load_weights(options.weights), effort=options.effort)
    result = {"cpu_s": time.process_time() - before, "wall_s": time.monotonic() - wall,
              "process_peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
              "events": int(found.n_events.sum()), "read_s": found.extent.read_s,
              **score(found, camera)}
    conclude(options, "long_recordings", result, markdown(
        ("what", "value"), ((k, f"{v:.4g}") for k, v in result.items())))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

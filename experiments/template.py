"""A study to copy: the error of the thresholds over hidden recordings. Say here what it shows.

    python -m experiments.template --preset debug
    python -m experiments.template --preset full --workers 2

Change `score` (what is measured on one recording), the protocol (what recordings are like) and the
table. Everything follows from the seed; template.json keeps configuration, source and versions.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from evflow import estimate_camera
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.common import StudyOptions, begin, conclude, markdown, run_script
from experiments.shared.many import Setup, enough, study


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Measure the error of the thresholds."""

    out: Path = Path("out/template")
    seed: int = 8_000_009
    recordings: int | None = None
    """How many (default: the preset's)."""


def score(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, float] | None:
    """Errors of one recording; None where next to nothing fired."""
    if len(hidden.recording.events) < 100:
        return None
    found = estimate_camera(hidden.recording, params).summary
    return {name: abs(float(getattr(found, name)) - float(getattr(hidden.nominal, name)))
            for name in ("theta_on", "theta_off")}


def main(options: Options) -> dict[str, float]:
    begin(options, "template")
    count = options.count(options.recordings, debug=3, full=100)
    setup = Setup(options.weights, options.seed)
    rows = enough(study(score, setup, [Protocol()] * count, options.workers, "recordings"))
    result = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    conclude(options, "template", result, markdown(
        ("parameter", "mean error"), ((name, f"{v:.4f}") for name, v in result.items())))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""The whole path in one picture: a camera is estimated from a recording, and the recording's own
frames are simulated again as that camera would have seen them.

    python -m experiments.quickstart              # a hidden camera watches a rendered scene
    python -m experiments.quickstart flight.aedat4 --out out/flight        # your recording

Writes out/quickstart/quickstart.png, camera.npz and result.json.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from evflow import CameraEstimate, Events, estimate_camera, read_recording
from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.report.page import spread
from evflow.report.text import LABELS, describe
from experiments.shared.common import at_least, begin, run_script, write_result
from experiments.shared.hidden_scene import FRAME_EVERY, hidden_camera, simulate_again


@dataclasses.dataclass(frozen=True)
class Options:
    """Estimate a camera and simulate with it; one picture."""

    recording: Annotated[Path | None, tyro.conf.Positional] = None
    """A recording with frames; without it a hidden camera watches a rendered scene."""
    out: Path = Path("out/quickstart")
    seed: int = 3
    width: int = 240
    height: int = 180
    milliseconds: int = 300
    """Length of the rendered recording."""


def rates(events: Events, span_us: tuple[int, int]) -> dict[str, float]:
    """Events per pixel and second of each polarity inside a time span."""
    inside = events.slice(*span_us)
    on, off = inside.count_map().reshape(2, -1).sum(1)
    exposure = (span_us[1] - span_us[0]) * 1e-6 * events.size[0] * events.size[1]
    return {"on": float(on / exposure), "off": float(off / exposure)}


def truth_table(truth: Summary, found: CameraEstimate) -> str:
    """Truth beside estimate ± std, a line per parameter."""
    lines = [f"{'':22} {'truth':>7} {'estimate':>19}"]
    for name, label in LABELS.items():
        value, std = (float(getattr(s, name)) for s in (found.summary, found.summary_std))
        lines.append(f"{label:22} {float(getattr(truth, name)):7.3f} {spread(value, std):>19}")
    return "\n".join(lines)


def main(options: Options) -> dict[str, Any]:
    begin(options, "result")
    at_least(16, width=options.width, height=options.height)
    at_least(2 * FRAME_EVERY, milliseconds=options.milliseconds)
    plots.require()
    truth = nominal = None
    if options.recording is None:
        recording, truth, nominal = hidden_camera(
            options.seed, options.width, options.height, options.milliseconds)
    else:
        recording = read_recording(options.recording)
        if not recording.has_frames:
            raise EvflowDataError("EV011", f"{options.recording} has no frames.",
                                  "Give a recording with frames.")
    print(recording)
    with bar("estimating") as progress:
        found = estimate_camera(recording, progress=progress)
    print(describe(found) if nominal is None else truth_table(nominal, found))
    made = simulate_again(recording, found, options.seed)
    span = (max(int(e.t[0]) for e in (recording.events, made)),
            min(int(e.t[-1]) for e in (recording.events, made)))
    result: dict[str, Any] = {
        "estimate": found.as_dict(), "rate_recorded": rates(recording.events, span),
        "rate_remade": rates(made, span)}
    if nominal is not None:
        result["truth"] = {k: float(v) for k, v in dataclasses.asdict(nominal).items()}
    for name in ("on", "off"):
        print(f"events/pixel/s {name.upper():3}: recorded {result['rate_recorded'][name]:.2f}, "
              f"re-made {result['rate_remade'][name]:.2f}")
    middle = sum(span) // 2
    index = int(np.argmin(np.abs(recording.frame_times - middle)))
    plots.comparison(options.out / "quickstart.png", recording.frame_dn(index), recording.events,
                     made, (middle - 15_000, middle + 15_000), found, truth)
    found.save(options.out / "camera.npz", overwrite=True)
    write_result(options.out / "result.json", result, dataclasses.asdict(options))
    print(f"-> {options.out / 'quickstart.png'}")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

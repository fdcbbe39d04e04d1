"""Thresholds of the compared systems on the same recordings (paper, Table III).

    python -m experiments.compare_systems --preset debug
    python -m experiments.compare_systems --preset full --data data/recordings --rows rows.json

The held-out recordings of `experiments.evaluate` (64x64, 8-bit frames every 25 ms), .2 s as there
and 1 s, at both mismatches: the first `sequences` of them with 200 signal events of each polarity.
Every system of `evflow.baselines.SYSTEMS` (LGAN, which learns from each recording for a minute, on
six of them; in debug for 20 iterations), `estimate_camera` and its parts by themselves (the set
network, the flow, the summary in every pixel, and the paper's flow), the constant .3, and MATCH
with the true 1000 frames/s video (no method that sees the frames alone can do as well). Scored per
polarity: `mae_sequence` (map against the sequence's value: the paper's footnote 1), `mae_pixel`
(map against each pixel's own), and |median - θ|. What a system cannot determine counts with
the value it gives; `determined` is the share of recordings where it determined both.

Real recordings have no truth: each system sees the first half of the frames, and its thresholds
predict the changes between the frames of the second half, each in the logarithm in which it was
measured (ours with the light that the frames lack), scored in lin-log, beside a regression on those
changes themselves. That favours least squares, whose criterion it is: what counts cannot explain
(noise, blur, a gamma of the frames) makes the best two numbers for it no thresholds. Writes
compare_systems.json, .md and .png.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

from evflow import load_weights, read_recording
from evflow.baselines import SYSTEMS, Lgan, System
from evflow.errors import EvflowDataError
from evflow.report import plots
from experiments.shared.cameras import Protocol
from experiments.shared.common import begin, run_script, write_result, write_text
from experiments.shared.compared import averages, picture, table
from experiments.shared.fits import all_scores
from experiments.shared.many import Setup
from experiments.shared.protocols import protocols
from experiments.shared.second_half import held_out

REAL = ("newton_cradle_davis346.aedat4", "ijrr_slider_depth")


@dataclasses.dataclass(frozen=True)
class Options:
    """Compare all systems."""

    weights: str = "default"
    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/compare_systems")
    seed: int = 1_000_003
    """The recordings of `experiments.evaluate`."""
    sequences: int | None = None
    """Recordings per row (default: the preset's)."""
    data: Path | None = None
    """Folder with the real recordings; left out without it."""
    rows: Path | None = None
    """Where the scores of each recording are kept, to resume an interrupted run from."""


def protocols_of(options: Options) -> dict[str, Protocol]:
    """Protocols by name: those of `evaluate` at both mismatches, and the same for a second."""
    known = protocols()
    found = {f"{m}, .2 s": known[m] for m in ("0.03", "0.15")}
    if options.preset == "full":
        found |= {f"{m}, 1 s": dataclasses.replace(known[m], intervals=40)
                  for m in ("0.03", "0.15")}
    return found


def systems_of(options: Options) -> dict[str, System]:
    """What is compared; a debug run does not wait for what learns."""
    if options.preset == "full":
        return SYSTEMS
    return SYSTEMS | {"lgan": Lgan(iterations=20)}


def main(options: Options) -> dict[str, Any]:
    begin(options, "compare_systems")
    plots.require()
    if options.data is not None and not options.data.is_dir():
        raise EvflowDataError("EV016", f"there is no folder {options.data}.", "Check --data.")
    count = options.sequences or {"debug": 3, "full": 30}[options.preset]
    params, systems = load_weights(options.weights), systems_of(options)
    result: dict[str, Any] = {"simulated": {}, "real": {}}
    for name, protocol in protocols_of(options).items():
        result["simulated"][name] = averages(all_scores(
            Setup(options.weights, options.seed), systems, (name, protocol), count, options.rows))
    if options.data is not None:
        for name in REAL:
            try:
                recording = read_recording(options.data / name)
                result["real"][name] = held_out(params, recording, systems)
            except EvflowDataError as error:
                print(f"{name} left out: {error}")
    text = table(result)
    print(text)
    config = dataclasses.asdict(options) | {"systems": {k: repr(v) for k, v in systems.items()}}
    write_result(options.out / "compare_systems.json", result, config)
    write_text(options.out / "compare_systems.md", text)
    picture(result, options.out / "compare_systems.png")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""Evaluate networks that turn events into video or flow.

    python -m experiments.evaluate_network --weights e2vid-small
    python -m experiments.evaluate_network --weights E2VID_plus.pth.tar --data ijrr/* \\
        --protocol etnet --aggregate sequences --warmup-s 0
    python -m experiments.evaluate_network --weights runs/flow/evflownet.safetensors

Weights: released names, .safetensors files, published checkpoints. --data takes recordings of any
format: IJRR, MVSEC, HQF, EVIMO2v2 (flow alone: no frames), EVREAL. The cuts are those of `CUTS`
(shared/recorded.py), by the sequence's name; files called NAME_cut have theirs already. Without
--data: synthetic cameras behind three circuits that no training simulates (shared/targets.py), and,
where the environment variable EVFLOW_DATA names a folder with them, two real recordings and two
slices of rotations, whose flow follows from the gyroscope.

Images are scored linear and in the log domain, log(1 + 255 I) / log 256; flow of real recordings by
FWL. Writes evaluate_network.json, .md and .png.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evflow.commands.options import check_finite, parse_size
from evflow.downstream import EVFlowNet
from evflow.downstream.released import load_network
from evflow.errors import EvflowDataError
from evflow.metrics import PROTOCOLS
from evflow.report import plots
from experiments.shared import held_out
from experiments.shared.common import at_least, begin, conclude, run_script
from experiments.shared.network_outputs import Synthetic, real_flow, real_video
from experiments.shared.network_scores import picture, report
from experiments.shared.recorded_parts import parts, rotations

LEAST_SIDE, LEAST_MS = 32, 1  # in fewer pixels the high thresholds of a target see no event


@dataclasses.dataclass(frozen=True)
class Options:
    """Score networks on recordings, or on synthetic cameras."""

    weights: tuple[str, ...] = ("e2vid-small",)
    """Names or paths."""
    data: tuple[Path, ...] = ()
    """Recordings; without them synthetic cameras, and what EVFLOW_DATA has."""
    out: Path = Path("out/evaluate_network")
    protocol: Literal["evreal", "etnet", "global"] = "evreal"
    """How images are scored: which SSIM, clipped or not."""
    aggregate: Literal["frames", "sequences"] | None = None
    """Mean over all frames, or over the means of sequences (default: the protocol's)."""
    warmup_s: float = 10.0
    """Seconds before the cut from which networks run (EVREAL: 10; ET-Net and S2R: 0)."""
    histeq: Literal["none", "global", "local", "clahe"] = "none"
    """Equalise the histograms of images and frames."""
    robust: bool = False
    """Stretch images between their percentiles 1 and 99, as EVREAL does for E2VID."""
    whole: bool = False
    """Without cuts."""
    size: str | None = None
    """Sensor size (346x260) of --data, where the files do not tell it or are wrong."""
    window_ms: float = 33.0
    """Of recordings without frames."""
    scenes: int = 12
    """Synthetic clips of each camera."""
    side: int = 64
    """Their height and width in pixels."""


def main(options: Options) -> dict[str, Any]:
    """Score every network on everything that it can see; returns what is written."""
    begin(options, "evaluate_network")
    plots.require()
    check_finite(options)
    if not options.weights:
        raise EvflowDataError("EV020", "--weights names no network.", "Name one or more.")
    if options.size is not None and not options.data:
        raise EvflowDataError("EV020", "--size without --data.", "Name the recordings.")
    at_least(0, warmup_s=options.warmup_s)
    at_least(LEAST_MS, window_ms=options.window_ms)
    at_least(LEAST_SIDE, side=options.side)
    protocol = PROTOCOLS[options.protocol]
    protocol = dataclasses.replace(protocol, aggregate=options.aggregate or protocol.aggregate)
    networks = {name: load_network(name) for name in options.weights}
    lpips = held_out.installed_lpips(say=print)
    found = parts(options.data, options.warmup_s, options.window_ms, whole=options.whole,
                  size=parse_size(options.size))
    slices = {} if options.data else rotations()
    synthetic = None if options.data else Synthetic(options.side, options.scenes)
    result: dict[str, Any] = {}
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name, trained in networks.items():
        row: dict[str, Any] = {"synthetic": synthetic.scores(trained, lpips) if synthetic else {}}
        if isinstance(trained.network, EVFlowNet):
            row["flow"] = real_flow(trained, found, slices)
        else:
            row["video"], pairs = real_video(
                trained, found, protocol, lpips, histeq=options.histeq, robust=options.robust)
            shown |= {f"{part}, {name}": pair for part, pair in pairs.items()}
        result[name] = row
    if options.data and not any(row.get("video") or row.get("flow") for row in result.values()):
        raise EvflowDataError(
            "EV011", f"nothing of {', '.join(map(str, options.data))} could be scored.",
            "Give recordings with frames, or weights of an EV-FlowNet, which needs none.")
    text = report(
        result, f"SSIM preset {options.protocol}, mean over {protocol.aggregate}, warm-up of up to "
        f"{options.warmup_s:g} s where recordings are as long, histeq {options.histeq}.")
    conventions = {task: held_out.scored_by(task, lpips is not None) for task in ("video", "flow")}
    conclude(options, "evaluate_network",
             result | ({"synthetic": conventions} if synthetic else {}), text)
    if shown:
        picture(shown, options.out / "evaluate_network.png")
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""Evaluate networks that turn events into video or flow.

    python -m experiments.evaluate_network --weights e2vid-small
    python -m experiments.evaluate_network --weights E2VID_plus.pth.tar --data ijrr/* \\
        --protocol etnet --aggregate sequences --warmup-s 0
    python -m experiments.evaluate_network --weights runs/flow/evflownet.safetensors

Weights: released names, .safetensors files, published checkpoints. --data takes recordings of any
format: IJRR, MVSEC, HQF, EVIMO2v2 (flow alone: its event cameras have no frames), EVREAL. The cuts
are those of `CUTS` (shared/recorded.py), by the sequence's name; files called NAME_cut have
theirs already. Without --data: synthetic cameras behind three circuits that no training simulates
(shared/targets.py), and, where the environment variable EVFLOW_DATA names a folder with them,
two real recordings and two slices of rotations, whose flow the gyroscope tells.

Images are scored linear and in the log domain, log(1 + 255 I) / log 256; flow of real recordings by
FWL. Writes evaluate_network.json, .md and .png.
"""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evflow.commands.options import check_finite, parse_size
from evflow.downstream import EVFlowNet, reconstruct
from evflow.downstream.released import Trained, load_network
from evflow.errors import EvflowDataError
from evflow.metrics import (
    PROTOCOLS,
    ImageProtocol,
    load_lpips,
    score_images,
)
from evflow.report import plots
from evflow.training.config import as_dict
from experiments.shared import held_out
from experiments.shared.common import at_least, begin, run_script, write_result, write_text
from experiments.shared.network_outputs import Synthetic, real_flow
from experiments.shared.network_scores import picture, report
from experiments.shared.recorded import (
    Part,
    Rotation,
    cut_of,
    equalised,
    read_part,
    read_rotation,
    sequence_name,
    stretched,
)

REAL = ("newton_cradle_davis346.aedat4", "ijrr_slider_depth")
ROTATIONS = ("ijrr_boxes_rotation", "ijrr_dynamic_rotation")
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


def parts(options: Options) -> list[Part]:
    """The real recordings asked for, or at hand; what cannot be read is said and left out."""
    cut, found = not options.whole, []
    at_hand = os.environ.get("EVFLOW_DATA")
    paths = list(options.data)
    if not paths and at_hand:
        # Shorter than their cuts: slices of sequences.
        cut = False
        paths = [p for name in REAL if (p := Path(at_hand) / "data/recordings" / name).exists()]
    size = parse_size(options.size) if options.data else None
    names = [sequence_name(path) for path in paths]
    if twice := {name for name in names if names.count(name) > 1}:
        raise EvflowDataError("EV020", f"more than one recording is called {sorted(twice)}.",
                              "Rename a file: it is by its name that a sequence is known.")
    for path in paths:
        start, stop = cut_of(path) if cut else (0.0, math.inf)
        if stop < math.inf:
            print(f"{path}: {start:g} to {stop:g} s count (--whole for all of it)")
        try:
            found.append(read_part(path, options.warmup_s, options.window_ms, cut, size))
        except EvflowDataError as error:
            if options.data and path == paths[-1] and not found:
                raise
            print(f"{path} left out: {error}")
    return found


def rotations() -> dict[str, Rotation]:
    """Slices of rotations under EVFLOW_DATA."""
    folder = Path(os.environ.get("EVFLOW_DATA", "")) / "data/recordings"
    return {name: read_rotation(folder / name) for name in ROTATIONS
            if os.environ.get("EVFLOW_DATA") and (folder / name / "extra.npz").is_file()}


def images_of(trained: Trained, part: Part, options: Options) -> tuple[np.ndarray, np.ndarray]:
    """Images and frames (T, H, W) that count, as they are scored."""
    if part.frames is None:
        raise EvflowDataError("EV011", f"{part.name} has no frames of this camera.",
                              "Score flow on it: FWL needs events alone.")
    made = reconstruct(trained.network, trained.params, part.events, part.edges_us[1:],
                       **trained.how)[part.warmup:]
    made = stretched(made) if options.robust else made
    return (equalised(made, options.histeq),
            equalised(part.frames[part.warmup:], options.histeq))


def protocol_of(options: Options) -> ImageProtocol:
    """How images are scored, and their scores averaged."""
    protocol = PROTOCOLS[options.protocol]
    return dataclasses.replace(protocol, aggregate=options.aggregate or protocol.aggregate)


def scored_how(options: Options) -> str:
    """The same in words."""
    return (f"SSIM preset {options.protocol}, mean over {protocol_of(options).aggregate}, "
            f"warm-up of up to {options.warmup_s:g} s where recordings are as long, "
            f"histeq {options.histeq}.")


def real_video(
    trained: Trained, found: list[Part], options: Options, lpips: Any
) -> tuple[dict[str, Any], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Scores linear and in the log domain, and the images behind them."""
    pairs = {}
    for part in found:
        try:
            pairs[part.name] = images_of(trained, part, options)
        except EvflowDataError as error:
            print(f"{part.name} left out: {error}")
    if not pairs:
        return {}, pairs
    protocol = protocol_of(options)
    linear = score_images(pairs, protocol, lpips)
    log = score_images(pairs, dataclasses.replace(protocol, domain="log", clip=True))
    for row, same in ((linear, log), *((linear["sequences"][n], log["sequences"][n])
                                       for n in pairs)):
        row["log_mse"] = same["mse"]
    return linear, pairs


def main(options: Options) -> dict[str, Any]:
    """Score every network on everything that it can see; returns what is written."""
    begin(options, "evaluate_network")
    plots.require()
    check_finite(options)
    at_least(0, warmup_s=options.warmup_s)
    at_least(LEAST_MS, window_ms=options.window_ms)
    at_least(LEAST_SIDE, side=options.side)
    networks = {name: load_network(name) for name in options.weights}
    try:
        lpips = load_lpips()
    except EvflowDataError as error:
        print(f"without LPIPS: {error}")
        lpips = None
    found, slices = parts(options), {} if options.data else rotations()
    synthetic = None if options.data else Synthetic(options.side, options.scenes)
    result: dict[str, Any] = {}
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name, trained in networks.items():
        row: dict[str, Any] = {"synthetic": synthetic.scores(trained, lpips) if synthetic else {}}
        if isinstance(trained.network, EVFlowNet):
            row["flow"] = real_flow(trained, found, slices)
        else:
            row["video"], pairs = real_video(trained, found, options, lpips)
            shown |= {f"{part}, {name}": pair for part, pair in pairs.items()}
        result[name] = row
    if options.data and not any(row.get("video") or row.get("flow") for row in result.values()):
        raise EvflowDataError(
            "EV011", f"nothing of {', '.join(map(str, options.data))} could be scored.",
            "Give recordings with frames, or weights of an EV-FlowNet, which needs none.")
    text = report(result, scored_how(options))
    conventions = {task: held_out.scored_by(task, lpips is not None) for task in ("video", "flow")}
    write_result(options.out / "evaluate_network.json",
                 result | ({"synthetic": conventions} if synthetic else {}), as_dict(options))
    write_text(options.out / "evaluate_network.md", text)
    if shown:
        picture(shown, options.out / "evaluate_network.png")
    print(text)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

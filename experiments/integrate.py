"""Direct integrated images by the thresholds of every system (paper, Table X).

    python -m experiments.integrate --preset debug
    python -m experiments.integrate --recording ijrr/boxes_6dof --span-s 5 20   # IJRR, whole
    python -m experiments.integrate --recording mvsec/indoor_flying1 --span-s 10 70

A frame plus the contrast of the events after it predicts a later frame: the better the thresholds,
the better the image. Scored at 1, 5 and 10 frames and after 1e5 and 5e5 events (the first frame
after them): RMSE and PSNR on 0..255, windowed SSIM (Gaussian, sigma 1.5) and ECC's SSIM of one
window, averaged over images. Thresholds are those of the first half of a recording, images are of
the second; a system's logarithm is that of its calibration, ours of the light that it measured.
"ours, maps" is the whole estimate; the set network and the flows stand beside it by themselves. "no
events" is the old frame itself. The paper averages over recordings that it names in part.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax

from evflow import load_weights
from evflow.baselines import SYSTEMS
from evflow.camera import CameraPrior
from evflow.errors import EvflowDataError
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes import SceneConfig, make_bank
from experiments.shared import integrated
from experiments.shared.cameras import Protocol, hidden_recording
from experiments.shared.common import begin, conclude, run_script
from experiments.shared.integrated_pages import picture, table
from experiments.shared.recordings import real_recordings

SIZES = {"DAVIS240": (180, 240), "DAVIS346": (260, 346), "VGA": (480, 640)}
SCENE = SceneConfig(speed_px_s=(60.0, 300.0), static_fraction=0.0, contrast=(0.6, 1.0))
# In the picture, beside the systems that were asked for
SHOWN = ("no events", "default .2", "ecc", "ecc median", "ours, maps")
QUICK = ("ecc", "ecc offset 40", "ecc median", "jaer normalised", "s2r")
# All but what learns from each recording for minutes; `--systems lgan` asks for that.
EACH = tuple(name for name, system in SYSTEMS.items() if math.isinf(system.most_recordings))


@dataclasses.dataclass(frozen=True)
class Options:
    """Score direct integrated images."""

    preset: Literal["debug", "full"] = "debug"
    recording: tuple[Path, ...] = ()
    """Recordings with frames (default: those under $EVFLOW_DATA, and simulated ones)."""
    span_s: tuple[float, float] | None = None
    """Seconds of the recordings to use, from their first frame."""
    systems: tuple[str, ...] = ()
    """Systems of evflow.baselines to compare (default: the preset's)."""
    weights: str = "default"
    out: Path = Path("out/integrate")
    seed: int = 9_000_003
    seeds: int | None = None
    """Simulated cameras of each size (default: the preset's)."""
    held_out: bool = True
    """Calibrate on the first half of a recording, score on the second; else, and where it is too
    short, both on all of it ("in sample"), as published: per-pixel fits gain most by that."""
    images: int = 24
    """Images per recording and horizon at most, evenly spread."""


def cases(options: Options) -> Iterator[integrated.Case]:
    """Real recordings, then simulated ones of each size (debug: one, and a small one)."""
    full = options.preset == "full"
    for name, recording in real_recordings(options.recording, options.span_s, None if full else 1):
        kind = {240: "DAVIS240", 346: "DAVIS346"}.get(recording.events.size[0], "")
        yield integrated.Case(name, kind, recording)
    if options.recording:
        return
    k_bank, k_data = jax.random.split(jax.random.key(options.seed))
    bank = make_bank(k_bank, 96, photos=False)
    prior = CameraPrior(theta=(0.1, 0.4), mismatch=(0.03, 0.03))
    for size, (kind, shape) in enumerate(SIZES.items() if full else [("DAVIS240", (90, 120))]):
        protocol = Protocol(prior=prior, scene=SCENE, shape=shape, intervals=12)
        for seed in range(options.seeds or (5 if full else 3)):
            key = jax.random.fold_in(jax.random.fold_in(k_data, size), seed)
            hidden = hidden_recording(key, bank, protocol)
            yield integrated.Case(f"simulated {shape[1]}x{shape[0]}", kind, hidden.recording,
                                  hidden.camera, hidden.nominal)


def main(options: Options) -> dict[str, Any]:
    begin(options, "integrate")
    plots.require()
    params = load_weights(options.weights)
    systems = options.systems or (QUICK if options.preset == "debug" else EACH)
    if unknown := sorted(set(systems) - set(SYSTEMS)):
        raise EvflowDataError("EV020", f"systems {unknown}.", f"Choose from {sorted(SYSTEMS)}.")
    seen = (*SHOWN, *options.systems)
    collected: integrated.Found = {}
    shown: dict[str, integrated.Example] = {}
    with bar("recordings") as progress:
        for number, whole in enumerate(cases(options), 1):
            part, case, title = integrated.calibrated_and_scored(whole, options.held_out)
            by = integrated.thresholds(case, part, params, systems)
            group = f"{title}, {case.camera}"
            for horizon, scores in integrated.scored(case, by, options.images).items():
                place = collected.setdefault(group, {}).setdefault(horizon, {})
                for name, values in scores.items():
                    place.setdefault(name, []).append([*values, by[name].seconds])
            if group not in shown and (row := integrated.example(case, by, seen)):
                shown[group] = row
            progress(number, number)
    result = integrated.averages(collected)
    conclude(options, "integrate", result, table(result))
    picture(options.out / "integrate.png", list(shown.values()))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

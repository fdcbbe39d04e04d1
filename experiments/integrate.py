"""Direct integrated images by the thresholds of every system (paper, Table X).

    python -m experiments.integrate --preset debug
    python -m experiments.integrate --recording ijrr/boxes_6dof --span-s 5 20   # IJRR, whole
    python -m experiments.integrate --recording mvsec/indoor_flying1 --span-s 10 70

A frame plus the contrast of the events after it predicts a later frame: the better the thresholds,
the better the image. Scored at 1, 5 and 10 frames and after 1e5 and 5e5 events (the first frame
after them): RMSE and PSNR on 0..255, windowed SSIM (Gaussian, sigma 1.5) and ECC's SSIM of one
window, averaged over images. Thresholds are those of the first half of a recording, images are of
the second; a system's log map is that of its calibration. "ours, maps" is the whole estimate; the
set network, the flow and the paper's flow stand beside it by themselves. "no events" is the old
frame itself. The paper averages over recordings that it names only in part.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from evflow import load_weights, read_recording
from evflow.baselines import SYSTEMS
from evflow.baselines.base import usable
from evflow.camera import CameraPrior
from evflow.errors import EvflowDataError
from evflow.process.terminal import bar
from evflow.report import plots
from evflow.scenes import SceneConfig, make_bank
from experiments.shared.cameras import Protocol, hidden_recording
from experiments.shared.change_systems import cut
from experiments.shared.common import begin, conclude, run_script
from experiments.shared.images import SCORES, mean_ci
from experiments.shared.integrated import Case, halves, image, scored, spans, thresholds
from experiments.shared.integrated_pages import picture, table
from experiments.shared.recordings import held_recordings

SIZES = {"DAVIS240": (180, 240), "DAVIS346": (260, 346), "VGA": (480, 640)}
SCENE = SceneConfig(speed_px_s=(60.0, 300.0), static_fraction=0.0, contrast=(0.6, 1.0))
# In the picture, beside the systems that were asked for
SHOWN = ("no events", "default .2", "ecc", "ecc median", "ours, maps")


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


LEAST = 4  # usable intervals of a half: fewer tell no thresholds
QUICK = ("ecc", "ecc offset 40", "ecc median", "jaer normalised", "s2r")
# All but what learns from each recording for minutes; `--systems lgan` asks for that.
EACH = tuple(name for name, system in SYSTEMS.items() if math.isinf(system.most_recordings))


def cases(options: Options) -> Iterator[Case]:
    """Real recordings, then simulated ones of cameras of each size (debug: one, and a small
    one)."""
    full = options.preset == "full"
    for path in options.recording or held_recordings()[:None if full else 1]:
        recording = cut(read_recording(path), options.span_s)
        kind = {240: "DAVIS240", 346: "DAVIS346"}.get(recording.events.size[0], "")
        yield Case(path.stem, kind, recording)
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
            yield Case(f"simulated {shape[1]}x{shape[0]}", kind, hidden.recording,
                       hidden.camera, hidden.nominal)


def main(options: Options) -> dict[str, Any]:
    begin(options, "integrate")
    plots.require()
    params = load_weights(options.weights)
    systems = options.systems or (QUICK if options.preset == "debug" else EACH)
    unknown = sorted(set(systems) - set(SYSTEMS))
    if unknown:
        raise EvflowDataError("EV020", f"systems {unknown}.", f"Choose from {sorted(SYSTEMS)}.")
    seen = (*SHOWN, *options.systems)
    collected: dict[str, dict[str, dict[str, list[Any]]]] = {}
    shown: dict[str, tuple[str, np.ndarray, dict[str, np.ndarray]]] = {}
    with bar("recordings") as progress:
        for number, case in enumerate(cases(options), 1):
            part, title = case.recording, f"{case.name} (in sample)"
            if options.held_out and len(usable(part)) >= 2 * LEAST:
                part, rest = halves(part)
                case, title = dataclasses.replace(case, recording=rest), case.name
            by = thresholds(case, part, params, systems)
            group = f"{title}, {case.camera}"
            for horizon, row in scored(case, by, options.images).items():
                for name, values in row.items():
                    place = collected.setdefault(group, {}).setdefault(horizon, {})
                    place.setdefault(name, []).append([*values, by[name].seconds])
            chosen = spans(case.recording, 5, 1) or spans(case.recording, 1, 1)
            if chosen and group not in shown:
                shown[group] = (case.name, case.recording.frame_dn(chosen[0][1]), {
                    n: image(case.recording, chosen[0], by[n]) for n in by if n in seen})
            progress(number, number)
    result = {group: {horizon: {name: {
        **{s: mean_ci(np.array(found)[:, i]) for i, s in enumerate(SCORES)},
        "images": sum(r[-2] for r in found), "seconds": float(np.mean([r[-1] for r in found]))}
        for name, found in row.items()} for horizon, row in horizons.items()}
        for group, horizons in collected.items()}
    conclude(options, "integrate", result, table(result))
    picture(options.out / "integrate.png", list(shown.values()))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

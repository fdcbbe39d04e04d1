"""What the frames cost: the estimate beside the same method with the true video between them.

    python -m experiments.true_video --preset full

The recordings of `experiments.evaluate`, refined with the true 1000 frames/s video in place of
frames 25 ms apart: what remains for theta is the counts' own noise. It is no bound: it starts from
the camera alone, and `estimate_camera` goes on to regress each pixel. The same method on other
paths says what the path is worth: ours (optical flow), flow in straight lines, and frames that fade
into each other. Of a pixel's theta: its regression on the path; of eta: that every noise event is
known as such (Poisson, all pixels and all of the time), and beside it, what separating noise from
signal gives with the true video and those thresholds. Every figure is printed beside that of
`estimate_camera` and as their ratio, by number of signal events and by speed.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from evflow import estimate_camera, finish
from evflow.estimation.pooled import pool_recording
from evflow.estimation.refine import refinement_chunks
from evflow.recordings.windows import plan_windows
from experiments.shared.cameras import Hidden, Protocol
from experiments.shared.common import StudyOptions, begin, conclude, estimator, markdown, run_script
from experiments.shared.known_video import noise_on_video, paths_between, refined
from experiments.shared.many import Setup, enough, study
from experiments.shared.protocols import ENOUGH, protocols
from experiments.shared.video_strata import mean, strata

NAMES = ("theta_on", "theta_off")
HEADS = ("protocol", "figure, stratum", "recordings", "ours", "true video", "ratio",
         "same method: flow", "straight", "fade")
PATHS = ("path", "straight", "blended")
FAR = 20.0  # times the network's std


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Compare the estimate with what a known video allows."""

    out: Path = Path("out/true_video")
    seed: int = 1_000_003
    """The recordings of `experiments.evaluate`."""
    sequences: int | None = None
    """Recordings per row (default: the preset's)."""


def score(params: Any, hidden: Hidden, _protocol: Protocol) -> dict[str, float] | None:
    recording = hidden.recording
    if len(recording.events) <= ENOUGH:
        return None
    pairs = plan_windows(recording).pairs
    chunks = refinement_chunks(recording, pairs)
    starts = np.cumsum([pairs[0][0], *(len(c.dt_s) for c in chunks)])
    stats, _ = pool_recording(params, recording)
    start, std = finish(params, stats)
    unsure = jax.tree.map(lambda s: FAR * s, std)  # what is known must not hold it back
    along = paths_between(hidden, chunks, starts)
    paths = {kind: refined(between, start, unsure) for kind, between in along.items()}
    best = paths["known"][0]
    found = estimate_camera(recording, params)
    rates = noise_on_video(params, along["known"], best, start)
    signal, counts = hidden.signal_events(), recording.events.count_map()
    exposure = 1e-6 * recording.events.duration_us * counts[0].size
    result = {"speed": float(np.mean(np.concatenate([c.motion_px for c in chunks])))}
    for i, name in enumerate(NAMES):
        true, pixels = float(getattr(hidden.nominal, name)), getattr(hidden.camera, name)
        fired = counts[i] > 0
        eta = f"eta_{name[6:]}"
        noise = float(getattr(hidden.nominal, eta))
        result |= {
            f"signal/{name}": float(signal[i]),
            f"ours/{name}": abs(float(getattr(found.summary, name)) - true),
            f"ours/{name} of pixels that fired": mean(np.abs(
                np.asarray(getattr(found.camera, name)) - pixels)[fired]),
            f"ours/{eta}": abs(float(getattr(found.summary, eta)) - noise),
            f"known/{eta}": float(np.sqrt(2 / np.pi * noise / exposure)),
            f"ours/{eta} beside the known video": abs(float(getattr(found.summary, eta)) - noise),
            f"known/{eta} beside the known video": abs(float(rates[i]) - noise)}
        for kind, (summary, maps) in paths.items():
            result |= {
                f"{kind}/{name}": abs(float(getattr(summary, name)) - true),
                f"{kind}/{name} of pixels that fired": mean(np.abs(maps[i] - pixels)[fired])}
    return result


def main(options: Options) -> dict[str, Any]:
    begin(options, "true_video")
    estimator(options.weights, "summary")
    sequences = options.count(options.sequences, debug=4, full=100)
    setup = Setup(options.weights, options.seed)
    result: dict[str, Any] = {}
    for name, protocol in protocols().items():
        result[name] = strata(enough(study(
            score, setup, [protocol] * sequences, options.workers, name)))
    conclude(options, "true_video", result, markdown(HEADS, (
        (name, k, f"{v['recordings']}", f"{v['ours']:.4f}", f"{v['known']:.4f}",
         f"{v['ratio']:.2f}", *(f"{v[p]:.4f}" if p in v else "" for p in PATHS))
        for name, found in result.items() for k, v in found.items())))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""Images and flow that networks make of real recordings and of synthetic cameras, scored."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow.downstream import EVFlowNet, prepared, reconstruct
from evflow.downstream.released import Trained
from evflow.downstream.simulated import SequenceConfig
from evflow.errors import EvflowDataError
from evflow.metrics import FwlConvention, ImageProtocol, fwl, score_flow, score_images
from experiments.shared import held_out, targets
from experiments.shared.recorded import Part, Rotation, equalised, stretched

SKIPPED, WINDOWS = 6, 20  # of synthetic clips


def images_of(
    trained: Trained, part: Part, histeq: str, robust: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Images and frames (T, H, W) of the part that counts, equalised; images stretched where
    `robust`. Raises EV011 without frames."""
    if part.frames is None:
        raise EvflowDataError("EV011", f"{part.name} has no frames of this camera.",
                              "Score flow on it: FWL needs events alone.")
    made = reconstruct(trained.network, trained.params, part.events, part.edges_us[1:],
                       **trained.how)[part.warmup:]
    made = stretched(made) if robust else made
    return equalised(made, histeq), equalised(part.frames[part.warmup:], histeq)


def real_video(
    trained: Trained, found: list[Part], protocol: ImageProtocol, lpips: Any, *,
    histeq: str = "none", robust: bool = False,
) -> tuple[dict[str, Any], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Scores of recordings, linear and (`log_mse`) in the log domain, and `images_of` each. A
    recording without frames is reported and left out."""
    pairs = {}
    for part in found:
        try:
            pairs[part.name] = images_of(trained, part, histeq, robust)
        except EvflowDataError as error:
            print(f"{part.name} left out: {error}")
    if not pairs:
        return {}, pairs
    linear = score_images(pairs, protocol, lpips)
    log = score_images(pairs, dataclasses.replace(protocol, domain="log", clip=True))
    for row, same in ((linear, log), *((linear["sequences"][n], log["sequences"][n])
                                       for n in pairs)):
        row["log_mse"] = same["mse"]
    return linear, pairs


def real_flow(trained: Trained, found: list[Part], slices: dict[str, Rotation]) -> dict[str, Any]:
    """FWL of recordings window by window, and of rotations beside the gyroscope's flow."""
    rows: dict[str, Any] = {}
    for part in found:
        flows = reconstruct(trained.network, trained.params, part.events, part.edges_us[1:],
                            **trained.how)
        rows[part.name] = score_flow(
            part.events, part.edges_us[part.warmup:], flows[part.warmup:])
    how = FwlConvention(reference="first")
    for name, one in slices.items():
        tensor = jnp.asarray(
            prepared(one.events, trained.network.bins, trained.split))[None, None]
        flow = np.asarray(held_out.outputs(
            trained.network, trained.params, tensor, trained.normalised)[0, 0])
        x, y, t, p, ones = map(jnp.asarray, (*one.xy.T, one.t, one.p, np.ones(len(one.t))))
        made, ideal = (fwl(x, y, t, p, ones, jnp.asarray(f), how) for f in (flow, one.flow))
        rows[name] = {"fwl": float(made), "convention": how.as_dict(), "fwl_truth": float(ideal),
                      "events_per_window": float(len(one.t))}
    return rows


class Synthetic:
    """Clips of the target cameras, made once."""

    def __init__(self, side: int, scenes: int) -> None:
        bank = targets.held_out_bank(48, photos=False)
        shape = (side, side)
        seen = [targets.target(camera, circuit, shape)
                for camera in targets.CAMERAS for circuit in targets.CIRCUITS]
        self.clips = {t.name: held_out.gather(targets.clips(
            t, bank, SequenceConfig(scene=targets.SCENES), scenes, WINDOWS))
            for t in seen}

    def scores(self, trained: Trained, lpips: Any) -> dict[str, dict[str, float | None]]:
        """Means over clips, of every camera."""
        rows = {}
        for name, clips in self.clips.items():
            made = _outputs(trained, clips)
            found = (held_out.flow_scores(made, clips, SKIPPED)
                     if isinstance(trained.network, EVFlowNet)
                     else held_out.video_scores(made, clips, SKIPPED, lpips))
            rows[name] = {k: _mean(v) for k, v in found.items()}
        return rows


def _outputs(trained: Trained, clips: held_out.Clips) -> Any:
    """A network's outputs for clips, time first. Networks with other event tensors than the clips'
    are run clip by clip."""
    network, params = trained.network, trained.params
    if network.bins == clips.tensors.shape[-1] and not trained.split:
        return held_out.outputs(network, params, clips.tensors, trained.normalised)
    return np.stack([reconstruct(network, params, events, edges[1:], **trained.how)
                     for events, edges in zip(clips.events, clips.edges_us, strict=True)], 1)


def _mean(scores: np.ndarray) -> float | None:
    """Mean over the clips with a score; None without any."""
    known = scores[np.isfinite(scores)]
    return float(known.mean()) if known.size else None

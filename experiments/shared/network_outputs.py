"""What networks make of real recordings and of synthetic cameras, scored."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow.downstream import EVFlowNet, prepared, reconstruct
from evflow.downstream.released import Trained
from evflow.downstream.simulated import SequenceConfig
from evflow.metrics import FwlConvention, fwl, score_flow
from experiments.shared import held_out, targets
from experiments.shared.recorded import Part, Rotation

SKIPPED, WINDOWS = 6, 20  # of synthetic clips


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
    """What a network makes of clips, time first; those that take other event tensors than the
    clips', one clip after the other."""
    network, params = trained.network, trained.params
    if network.bins == clips.tensors.shape[-1] and not trained.split:
        return held_out.outputs(network, params, clips.tensors, trained.normalised)
    return np.stack([reconstruct(network, params, events, edges[1:], **trained.how)
                     for events, edges in zip(clips.events, clips.edges_us, strict=True)], 1)


def _mean(scores: np.ndarray) -> float | None:
    """Of the clips that have a score; None where none has."""
    known = scores[np.isfinite(scores)]
    return float(known.mean()) if known.size else None

"""What `experiments.see_better` scores a network on: clips of a target whose camera is known, or a
real recording and its own frames.

Both give one number per clip (of a recording: per frame, or per window for flow) and measure.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np

from evflow import Recording, read_recording
from evflow.downstream import EVFlowNet, Network, reconstruct
from evflow.errors import EvflowDataError
from evflow.metrics import score_flow
from evflow.process.provenance import sha256
from experiments.shared import held_out
from experiments.shared.held_out import Scores
from experiments.shared.recorded import Part, part_of

Params = dict[str, Any]
WINDOW_MS = 30.0  # of flow


class ScoredOn(Protocol):
    """normalised: whether the network has event tensors of deviation 1; lpips: weights or None."""

    def scores(
        self, network: Network, params: Params, normalised: bool, lpips: Params | None
    ) -> Scores: ...

    def without_network(self, task: str, lpips: Params | None) -> dict[str, Scores]: ...

    def images(
        self, network: Network, params: Params, normalised: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Images (N, H, W) that a network makes, and the frames beside them."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class OfClips:
    """Clips of a target; the first windows are not scored."""

    clips: held_out.Clips
    skipped: int

    def scores(
        self, network: Network, params: Params, normalised: bool, lpips: Params | None
    ) -> Scores:
        made = held_out.outputs(network, params, self.clips.tensors, normalised)
        if isinstance(network, EVFlowNet):
            return held_out.flow_scores(made, self.clips, self.skipped)
        return held_out.video_scores(made, self.clips, self.skipped, lpips)

    def without_network(self, task: str, lpips: Params | None) -> dict[str, Scores]:
        return held_out.without_network(task, self.clips, self.skipped, lpips)

    def images(
        self, network: Network, params: Params, normalised: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """The last of every clip."""
        made = held_out.outputs(network, params, self.clips.tensors, normalised)
        return np.asarray(made[-1]), np.asarray(self.clips.frames[-1])


@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """A real recording as a target and its own test. source: digest of its files."""

    name: str
    source: str
    recording: Recording

    @staticmethod
    def read(name: str, path: Path) -> Recorded:
        """Raises as `read_recording`; EV011 without frames, which the camera is measured by."""
        recording = read_recording(path)
        if not recording.has_frames:
            raise EvflowDataError("EV011", f"{path} has no frames to measure its camera by.",
                                  "Give a recording with frames.")
        return Recorded(name, sha256(path)[:16], recording)

    def scores(
        self, network: Network, params: Params, normalised: bool, lpips: Params | None
    ) -> Scores:
        """Every frame that events come before; of flow the windows of `WINDOW_MS`."""
        if isinstance(network, EVFlowNet):
            part = self._windows()
            return _flow_scores(part, self._made(network, params, normalised, part))
        return _image_scores(*self.images(network, params, normalised), lpips)

    def without_network(self, task: str, lpips: Params | None) -> dict[str, Scores]:
        if task == "video":
            frames = self._frames()[1]
            return {"even grey": _image_scores(np.full_like(frames, 0.5), frames, lpips)}
        part = self._windows()
        width, height = self.recording.events.size
        still = np.zeros((len(part.edges_us) - 1, 2, height, width), np.float32)
        return {"no flow": _flow_scores(part, still)}

    def images(
        self, network: Network, params: Params, normalised: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of every frame that events come before."""
        part, frames = self._frames()
        return self._made(network, params, normalised, part), frames

    def _made(
        self, network: Network, params: Params, normalised: bool, part: Part
    ) -> np.ndarray:
        return np.asarray(reconstruct(network, params, part.events, part.edges_us[1:],
                                      normalised=normalised))

    def _frames(self) -> tuple[Part, np.ndarray]:
        part = part_of(self.recording, self.name, 0.0, np.inf, 0.0, WINDOW_MS)
        assert part.frames is not None
        return part, part.frames

    def _windows(self) -> Part:
        recording = self.recording
        alone = dataclasses.replace(recording, frames=recording.frames[:0],
                                    frame_times=recording.frame_times[:0])
        return part_of(alone, self.name, 0.0, np.inf, 0.0, WINDOW_MS)


def _image_scores(made: np.ndarray, frames: np.ndarray, lpips: Params | None) -> Scores:
    """Of each image (N, H, W)."""
    return held_out.image_scores(jnp.asarray(made)[None], jnp.asarray(frames)[None], lpips)


def _flow_scores(part: Part, flows: np.ndarray) -> Scores:
    """FWL of each window; NaN without events."""
    edges = part.edges_us
    rows = [score_flow(part.events, edges[i:i + 2], flows[i:i + 1],
                       convention=held_out.CONVENTION)["fwl"] for i in range(len(flows))]
    return {"fwl": np.array([np.nan if fwl is None else fwl for fwl in rows])}

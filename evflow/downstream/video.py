"""Frames reconstructed by a trained network for recordings without any, and scores of images
against recorded frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np

from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.released import Trained, load_network
from evflow.downstream.sync import Sync, sync_times
from evflow.downstream.tensor import reconstructions
from evflow.errors import EvflowDataError
from evflow.estimation.result import CameraEstimate
from evflow.io.images.folder import MADE
from evflow.metrics.image_scores import ImageProtocol, score_images
from evflow.metrics.perceptual import Params
from evflow.notes import Note
from evflow.types import Recording

FRAME_US = 30_000  # windows that the released networks were trained on
WARM_UP = 5  # images until a network has seen the scene: .15 s
# RMS of log(theta / truth): .65 on hidden cameras (a constant: .39), 1.2 on a Newton's cradle.
GUESS_ERROR = 1.0
GUESSED = Note(
    "theta.guessed", "the frames were made from the events by a network: their contrast is its "
    "guess, not measured light, and thresholds scale with it. Their errors are widened by that of "
    "such guesses, which is as large as the thresholds themselves.")
SCORED_AT_ONCE = 64  # images held for scoring

Progress = Callable[[int, int], None]


def images_of(trained: Trained) -> Trained:
    """The network; raises EV020 if it gives flow instead of images."""
    if isinstance(trained.network, EVFlowNet):
        raise EvflowDataError("EV020", "these weights are of EV-FlowNet, which gives flow.",
                              "Choose weights of E2VID or FireNet.")
    return trained


def with_reconstructed_frames(
    recording: Recording, trained: Trained | str = "e2vid-small", *, sync: Sync = "ms",
    window_us: int = FRAME_US, warm_up: int = WARM_UP, progress: Progress | None = None,
) -> Recording:
    """The recording with frames reconstructed from its events, in place of any it has.

    A note says that they are reconstructed: brightness and contrast are the network's guess.

    Args:
        recording: with events.
        trained: E2VID or FireNet, or the name or path of one.
        sync: when to reconstruct, see `sync_times`.
        window_us: interval of the frames for sync "ms".
        warm_up: number of first frames to leave out.
        progress: called with (done, all).

    Returns:
        A recording with float32 frames in DN, the network's 0..1 as 0..255.

    Raises:
        EvflowDataError: EV001 (no events), EV017 (too short), EV020 (a network that gives flow),
            and as `load_network`.
    """
    name = trained if isinstance(trained, str) else "a given network"
    trained = images_of(load_network(trained) if isinstance(trained, str) else trained)
    times = sync_times(recording, sync, window_us=window_us)
    if len(times) < warm_up + 2:
        raise EvflowDataError(
            "EV017", f"the events give {len(times)} images, and the first {warm_up} are the "
            "network's warm-up.", "Two more are needed: use a longer recording.")
    frames = np.empty((len(times) - warm_up, *recording.events.size[::-1]), np.float32)
    images = reconstructions(
        trained.network, trained.params, recording.events, times, **trained.how, hold=True)
    for i, image in enumerate(images):
        if i >= warm_up:
            frames[i - warm_up] = 255.0 * np.clip(image, 0.0, 1.0)
        if progress:
            progress(i + 1, len(times))
    note = Note("frames.made", f"{len(frames)} frames were {MADE} {name}")
    return Recording(recording.events, frames, times[warm_up:], (*recording.notes, note),
                     full_scale=255)


def doubted(found: CameraEstimate) -> CameraEstimate:
    """An estimate from reconstructed frames: adds a note, and `GUESS_ERROR` to the std of every
    threshold and mismatch."""
    def widened(std: Any, of: Any, names: Iterable[str]) -> Any:
        return dataclasses.replace(std, **{
            name: jnp.hypot(getattr(std, name), GUESS_ERROR * getattr(of, name))
            for name in names})

    scaled = ("theta_on", "theta_off")
    return dataclasses.replace(
        found, std=widened(found.std, found.camera, scaled),
        summary_std=widened(found.summary_std, found.summary, (*scaled, "sigma_on", "sigma_off")),
        notes=(GUESSED, *found.notes))


class FrameScores:
    """Scores of images against frames at their times, computed for `SCORED_AT_ONCE` images at a
    time; the first `warm_up` are skipped."""

    def __init__(
        self, protocol: ImageProtocol, lpips_params: Params | None, warm_up: int = WARM_UP
    ) -> None:
        self._protocol, self._lpips, self._skip = protocol, lpips_params, warm_up
        self.warm_up = warm_up
        self._held: list[tuple[np.ndarray, np.ndarray]] = []
        self._parts: list[dict[str, Any]] = []

    def add(self, image: np.ndarray, frame_dn: np.ndarray) -> None:
        """One more image (H, W), 1 is white, and the frame (H, W) in DN."""
        if self._skip:
            self._skip -= 1
            return
        self._held.append((image, frame_dn / np.float32(255)))
        if len(self._held) == SCORED_AT_ONCE:
            self._score()

    def _score(self) -> None:
        images, frames = (np.stack(a) for a in zip(*self._held, strict=True))
        self._parts.append(score_images({"": (images, frames)}, self._protocol, self._lpips))
        self._held = []

    def result(self) -> dict[str, Any] | None:
        """Means over frames with protocol and LPIPS network; None where nothing was scored."""
        if self._held:
            self._score()
        if not self._parts:
            return None
        first, total = self._parts[0], sum(p["frames"] for p in self._parts)
        kinds = [k for k in first["sequences"][""] if k != "frames"]
        means = {k: sum(p[k] * p["frames"] for p in self._parts) / total
                 if all(p[k] is not None for p in self._parts) else None for k in kinds}
        return {"protocol": dataclasses.asdict(self._protocol), "lpips_net": first["lpips_net"],
                "warm_up": self.warm_up, "frames": total, **means}

"""Scores of a trained network on clips of held-out scenes, one number per clip and measure."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.downstream import Network, normalise, run
from evflow.errors import EvflowDataError
from evflow.metrics import (
    PROTOCOLS,
    FwlConvention,
    frame_scores,
    load_lpips,
    log_map,
    mse,
    score_flow,
)
from evflow.metrics.flow_scores import OUTLIER_PX
from evflow.types import Events
from experiments.shared.targets import Clip

Array = jax.Array
Params = dict[str, Any]
Scores = dict[str, np.ndarray]  # (N,) each

VIDEO = ("ssim", "log_mse", "mse", "psnr", "lpips")
FLOW = ("aee", "outlier_percent", "fwl", "fwl_truth")
# Bilinear votes blur: over 30 ms of few events even the true flow then scores .87 (64 px, high
# thresholds); rounded to the nearest pixel it scores 1.15.
CONVENTION = FwlConvention(splat="round")
ENDPOINTS = {"aee": "pixels with events", "outlier_px": OUTLIER_PX}
RISING = ("ssim", "psnr", "fwl")  # better where larger
PRESET = "evreal"
PROTOCOL = PROTOCOLS[PRESET]  # of images; log_mse is the mse of `log_map` of both


@dataclasses.dataclass(frozen=True, eq=False)
class Clips:
    """N clips of T windows: events and edges_us (T + 1,) of each; tensors (T, N, H, W, bins),
    borders (T + 1, N, H, W), flow (T, N, 2, H, W)."""

    events: list[Events]
    edges_us: list[np.ndarray]
    tensors: Array
    borders: Array
    flow: np.ndarray

    @property
    def frames(self) -> Array:
        """Frames (T, N, H, W) at the windows' ends."""
        return self.borders[1:]


def scored_by(task: str, perceptual: bool = True) -> dict[str, Any]:
    """The conventions of `VIDEO`, or of `FLOW` for "flow". perceptual: with LPIPS."""
    if task == "flow":
        return {"fwl": CONVENTION.as_dict(), **ENDPOINTS}
    return {**dataclasses.asdict(PROTOCOL), "lpips_net": "alex v0.1" if perceptual else None}


def installed_lpips(say: Callable[[str], object] | None = None) -> Params | None:
    """Weights of LPIPS; None where they are not installed, with the reason passed to `say`."""
    try:
        return load_lpips()
    except EvflowDataError as error:
        if say is not None:
            say(f"without LPIPS: {error}")
        return None


def gather(clips: Iterable[Clip]) -> Clips:
    """All clips of a target, time first."""
    made = list(clips)
    tensors, borders, flow = (np.stack([getattr(c, name) for c in made], 1)
                              for name in ("tensors", "borders", "flow"))
    return Clips([c.events for c in made], [c.edges_us for c in made], jnp.asarray(tensors),
                 jnp.asarray(borders), flow)


@functools.partial(jax.jit, static_argnames=("network", "normalised"))
def outputs(network: Network, params: Params, tensors: Array, normalised: bool) -> Array:
    """Images (T, N, H, W) or flows (T, N, 2, H, W) of event tensors (T, N, H, W, bins)."""
    return run(network, params, normalise(tensors) if normalised else tensors)[0]


def video_scores(images: Array, clips: Clips, skipped: int, lpips: Params | None) -> Scores:
    """`VIDEO` of the windows after those skipped; without lpips where there are no weights."""
    return image_scores(images[skipped:], clips.frames[skipped:], lpips)


def image_scores(images: Array, frames: Array, lpips: Params | None) -> Scores:
    """`VIDEO` of images and frames (T, N, H, W), means over T."""
    found = _video(images, frames, lpips)
    return {name: np.asarray(found[name], np.float64) for name in VIDEO if name in found}


@jax.jit
def _video(images: Array, frames: Array, lpips: Params | None) -> dict[str, Array]:
    def clip(pair: tuple[Array, Array]) -> dict[str, Array]:
        scores = frame_scores(*pair, PROTOCOL, lpips)
        scores["log_mse"] = mse(*map(log_map, pair))
        return jax.tree.map(jnp.mean, scores)

    # Clip by clip: LPIPS of all at once would take gigabytes.
    return jax.lax.map(clip, tuple(jnp.swapaxes(a, 0, 1) for a in (images, frames)))


def flow_scores(flows: Array | np.ndarray, clips: Clips, skipped: int) -> Scores:
    """`FLOW` of the windows after those skipped; NaN where a clip has no events in them."""
    made = np.asarray(flows)
    rows = [score_flow(events, edges[skipped:], made[skipped:, i],
                       truth=clips.flow[skipped:, i], convention=CONVENTION)
            for i, (events, edges) in enumerate(zip(clips.events, clips.edges_us, strict=True))]
    return {name: np.array([np.nan if r.get(name) is None else r[name] for r in rows])
            for name in FLOW}


def without_network(task: str, clips: Clips, skipped: int, lpips: Params | None
                    ) -> dict[str, Scores]:
    """Scores of baselines without a network: uniformly grey images; for "flow" zero flow, and the
    mean of each clip's true flow (which no network knows)."""
    if task == "video":
        return {"even grey": video_scores(jnp.full_like(clips.frames, 0.5), clips, skipped, lpips)}
    mean = np.nanmean(clips.flow[skipped:], (0, 3, 4), keepdims=True)
    guesses = {"no flow": 0.0, "mean flow of the clip": mean}
    return {name: flow_scores(np.broadcast_to(guess, clips.flow.shape), clips, skipped)
            for name, guess in guesses.items()}

"""Figures of a trained network on held-out sequences."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.camera import Camera
from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.network import Network, Params, run
from evflow.downstream.simulated import Sequences, has_events, sample_sequences
from evflow.downstream.train import LearningConfig
from evflow.metrics.flow import aee
from evflow.metrics.image_scores import frame_scores
from evflow.scenes import make_bank
from experiments.shared.common import markdown
from experiments.shared.held_out import PROTOCOL, installed_lpips

Array = jax.Array

HELD_OUT = 4_000_037  # seed of scenes, textures and cameras never trained on


def measure(
    network: Network, params: Params, learning: LearningConfig, camera: Camera | None, batches: int
) -> dict[str, float]:
    """Mean figures of held-out sequences of the same kind: other textures (no photographs), other
    scenes and cameras. Of images after the first half of the windows, beside those of even grey;
    of flow where more than one event is left after ON and OFF cancel, beside those of none and of
    each window's median."""
    k_bank, k_data = jax.random.split(jax.random.key(HELD_OUT))
    bank = make_bank(k_bank, 48, photos=False)
    weights = installed_lpips() if learning.data.crop >= 32 else None  # smaller images have none
    score = _flow_figures if isinstance(network, EVFlowNet) else _image_figures
    sample = jax.jit(functools.partial(sample_sequences, config=learning.data))
    rows = []
    for i in range(batches):
        sequences = sample(jax.random.fold_in(k_data, i), bank, camera=camera)
        rows.append(jax.device_get(score(network, params, sequences, learning.normalised, weights)))
    return {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}


@functools.partial(jax.jit, static_argnames=("network", "normalised"))
def _image_figures(
    network: Network, params: Params, sequences: Sequences, normalised: bool, weights: Params | None
) -> dict[str, Array]:
    tensors = sequences.given(normalised)
    images, _ = run(network, params, tensors)
    late = len(images) // 2
    images, frames = images[late:], sequences.frames[late:]
    seen, grey = (frame_scores(a, frames, PROTOCOL, weights)
                  for a in (images, jnp.full_like(frames, 0.5)))
    return {name: jnp.mean(seen[name]) for name in seen} | {
        f"grey_{name}": jnp.mean(grey[name]) for name in seen}


@functools.partial(jax.jit, static_argnames=("network", "normalised"))
def _flow_figures(
    network: Network, params: Params, sequences: Sequences, normalised: bool, _: Any
) -> dict[str, Array]:
    tensors = sequences.given(normalised)
    flow, _ = network.apply(params, tensors)
    events, truth = has_events(sequences.tensors), sequences.flow
    # What no constant flow does better than, but for the median of vectors.
    median = jnp.nanmedian(
        jnp.where(events[..., None, :, :], truth, jnp.nan), (-2, -1), keepdims=True)
    guesses = {"": flow, "none_": jnp.zeros_like(flow),
               "constant_": jnp.broadcast_to(median, flow.shape)}
    rows: dict[str, Array] = {}
    for name, guess in guesses.items():
        error, beyond = aee(guess, truth, events)
        rows |= {f"{name}aee": jnp.nanmean(error), f"{name}outlier_percent": jnp.nanmean(beyond)}
    return rows


def table(result: dict[str, Any]) -> str:
    """Markdown, one row."""
    names = [name for name, value in result.items() if isinstance(value, int | float)]
    return markdown(names, [[f"{result[name]:.4g}" for name in names]])

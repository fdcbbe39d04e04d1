"""Training sequences with events by EventGAN from their frames, without a camera."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.baselines.eventgan import generate
from evflow.downstream.simulated import SequenceConfig, Sequences, sample_sequences
from evflow.downstream.tensor import signed
from evflow.scenes import TextureBank

Array = jax.Array


def sample(
    key: Array, bank: TextureBank, config: SequenceConfig, generator: dict[str, Any]
) -> Sequences:
    """The scenes of `sample_sequences` for this key, with the events that the generator makes of
    the frames at each window's borders."""
    sequences = sample_sequences(key, bank, config)
    events = signed(generate(generator, 255.0 * sequences.before, 255.0 * sequences.frames))
    weights = jnp.asarray(rebinning(events.shape[-1], config.bins), events.dtype)
    tensors = jnp.einsum("...b,bc->...c", events, weights)
    return dataclasses.replace(sequences, tensors=tensors)


def rebinning(bins: int, fewer: int) -> np.ndarray:
    """(bins, fewer): weights that distribute a bin's events to the bins around its time; each row
    sums to 1."""
    places = np.arange(bins) * ((fewer - 1) / (bins - 1))
    return np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(fewer)))

"""One training of an event network: what it is, what it draws from and what it starts from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from evflow import read_recording
from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.network import Network, Params
from evflow.downstream.recorded import recorded_bank, sample_recorded
from evflow.downstream.released import load_network
from evflow.downstream.simulated import sample_sequences
from evflow.downstream.train import LearningConfig
from evflow.errors import EvflowDataError
from evflow.network.weights import weights_path
from evflow.scenes import make_bank
from experiments.shared.conditions import digest


@dataclasses.dataclass(frozen=True)
class Run:
    """What identifies a run; another one does not go on in its folder. Files are identified by
    their content: the same file at another path is the same, another file at one path is not."""

    network: Network
    learning: LearningConfig
    lpips: str | None
    camera: str | None
    recordings: tuple[str, ...] = ()
    start: str | None = None

    @property
    def steps(self) -> int:
        return self.learning.steps


def run_of(
    network: Network, learning: LearningConfig, *, lpips: str | None, camera: Path | None,
    recordings: Sequence[Path], start: str | None,
) -> Run:
    """The run of this network with these files; EV020 where they contradict each other."""
    if recordings and isinstance(network, EVFlowNet) and network.scales == 1:
        raise EvflowDataError("EV020", "recordings have no true flow for this form of EV-FlowNet.",
                              "Pass --preset original, which learns from their frames.")
    if recordings and camera:
        raise EvflowDataError("EV020", "--camera with --recordings, which have their own.",
                              "Leave one out.")
    if start is not None:
        start = digest(path if (path := Path(start)).is_file() else weights_path(path))
    return Run(
        network, learning, lpips if lpips in (None, "auto") else digest(Path(lpips)),
        None if camera is None else digest(camera),
        # A folder may hold hours of images: it is identified by its place.
        tuple(str(path.resolve()) if path.is_dir() else digest(path) for path in recordings), start)


def source(recordings: Sequence[Path], learning: LearningConfig) -> tuple[Any, Any]:
    """What the steps draw from, and the function that draws."""
    if recordings:
        read = [read_recording(path) for path in recordings]
        return recorded_bank(read, learning.data), sample_recorded
    return make_bank(jax.random.fold_in(jax.random.key(learning.seed), 7)), sample_sequences


def start_params(start: str | None, run: Run) -> Params | None:
    """Params to go on from, None for fresh ones; EV018 where they are another network's."""
    if start is None:
        return None
    trained = load_network(start)
    if (trained.network, trained.normalised) != (run.network, run.learning.normalised):
        raise EvflowDataError(
            "EV018", f"{start} is {trained.network}, normalised={trained.normalised}; "
            f"this run trains {run.network}, normalised={run.learning.normalised}.",
            "Start from weights of the same network and preset, or leave --start out.")
    return trained.params

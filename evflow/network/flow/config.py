"""What the flow is made of: a frozen, hashable description, passed as a static argument.

The flow has `levels` levels of `steps` steps. Level i works on `channels / 2**i` channels; between
two levels the first half goes on and the second half leaves as latent z.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, TypeAlias

import jax

from evflow.errors import EvflowDataError

Array: TypeAlias = jax.Array
Params: TypeAlias = dict[str, Any]  # nested dict of arrays


@dataclasses.dataclass(frozen=True)
class FlowConfig:
    """Static structure of the conditional flow (paper, Section IV-B and IV-C).

    channels: voxel channels per pixel (2 polarities x 16 bins).
    levels, steps: L and K of Eq. 8.
    hidden: width of the coupling and injector networks.
    condition: channels of the condition u.
    coupling: "additive" (Eq. 5, |det| = 1) or "affine" (h_B exp(s) + t, |s| <= .2).
    injector: one affine function of u alone at the head of every level.
    asinh: element-wise asinh before the first level, for counts with many zeros.
    log_scale_bound: how far training moves an actnorm's log-scale from its data init. Small, as
        the float32 inverse is lost once log-scales spread: measured round trip over 64 steps
        5e-4 at a standard deviation of .2, 5e2 at .5.
    injector_bound: bound of the injector's log-scales; large, as the voxels of empty pixels vary
        a hundredth as much as those of active ones.
    min_std: floor of a channel's standard deviation in data_init, in units of the flow's input.
    seed: of the channel shuffles; part of the network, not of its initialisation.
    remat: recompute a step in the backward pass rather than store it. Gradient of an NLL at 4096
        pixels, 2 cores: .155 s and 35 MB, against .205 s and 210 MB stored.
    """

    channels: int = 32
    levels: int = 4
    steps: int = 16
    hidden: int = 64
    condition: int = 40
    coupling: Literal["additive", "affine"] = "additive"
    injector: bool = True
    asinh: bool = True
    log_scale_bound: float = 0.1
    injector_bound: float = 2.0
    min_std: float = 0.05
    seed: int = 0
    remat: bool = True

    def __post_init__(self) -> None:
        for name in ("levels", "steps", "hidden", "condition"):
            if getattr(self, name) < 1:
                raise EvflowDataError(
                    "EV020", f"FlowConfig({name}={getattr(self, name)}).", "It must be >= 1.")
        if self.channels < 1 or self.channels % 2**self.levels:
            raise EvflowDataError(
                "EV020", f"FlowConfig(channels={self.channels}, levels={self.levels}).",
                f"Every level halves its channels: use a multiple of {2**self.levels}.")
        if self.coupling not in ("additive", "affine"):
            raise EvflowDataError(
                "EV020", f"FlowConfig(coupling={self.coupling!r}).",
                "Choose 'additive' or 'affine'.")
        for name in ("log_scale_bound", "injector_bound", "min_std"):
            if not 0 < getattr(self, name) < float("inf"):
                raise EvflowDataError(
                    "EV020", f"FlowConfig({name}={getattr(self, name)}).",
                    "It must be > 0 and finite.")

    @property
    def injector_limit(self) -> float:
        """The bound in use: with affine couplings .5 at most, as both together take the inverse
        of an N(0, 1) draw beyond what float32 holds (measured at 2)."""
        return min(self.injector_bound, 0.5) if self.coupling == "affine" else self.injector_bound

    @property
    def level_channels(self) -> tuple[int, ...]:
        """Channels of each level, (32, 16, 8, 4) by default; the last is the width of y."""
        return tuple(self.channels >> level for level in range(self.levels))

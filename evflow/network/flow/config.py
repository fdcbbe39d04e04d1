"""The structure of the flow: a frozen, hashable description, passed as a static argument.

The flow has `levels` levels of `steps` steps. Level i works on `channels / 2**i` channels; between
two levels the first half goes on and the second half leaves as latent z.
"""

from __future__ import annotations

import dataclasses
from typing import Any, TypeAlias

import jax

from evflow.checks import require
from evflow.errors import EvflowDataError

Array: TypeAlias = jax.Array
Params: TypeAlias = dict[str, Any]  # nested dict of arrays


@dataclasses.dataclass(frozen=True)
class FlowConfig:
    """Static structure of the conditional flow (paper, Section IV-B and IV-C).

    Attributes:
        channels: voxel channels per pixel (2 polarities x 16 bins).
        levels: L of Eq. 8.
        steps: K of Eq. 8, steps in each level.
        hidden: width of the coupling and injector networks.
        condition: channels of the condition u.
        injector: an affine function of u alone at the start of every level.
        asinh: element-wise asinh before the first level, for counts with many zeros.
    """

    channels: int = 32
    levels: int = 4
    steps: int = 16
    hidden: int = 64
    condition: int = 40
    injector: bool = True
    asinh: bool = True

    def __post_init__(self) -> None:
        for name in ("levels", "steps", "hidden", "condition"):
            require(self, name, getattr(self, name) >= 1, ">= 1")
        if self.channels < 1 or self.channels % 2**self.levels:
            raise EvflowDataError(
                "EV020", f"FlowConfig(channels={self.channels}, levels={self.levels}).",
                f"Every level halves its channels: use a multiple of {2**self.levels}.")

    @property
    def level_channels(self) -> tuple[int, ...]:
        """Channels of each level, (32, 16, 8, 4) by default; the last is the width of y."""
        return tuple(self.channels >> level for level in range(self.levels))

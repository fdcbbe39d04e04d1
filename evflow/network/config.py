"""The static structure of the network: `default`, and `paper` as printed.

A configuration is hashable (a static argument of jit); the weights' name says which one they have.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

from evflow.network.flow.config import FlowConfig


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Static structure of the network.

    Attributes:
        bins: time bins of a window, for each polarity.
        changes: m, intensity changes per window.
        piece: encoder features per change.
        encoder_hidden: width of the encoder.
        summary_hidden: width of the summary's networks.
        summary_features: features of a pixel that the summary pools over pixels with events.
        rate_features: features that it pools for the noise rates.
        gates: learned weightings of the pixels in its sums.
        pool: estimate a camera summary from all pixels and condition on it (a single pixel cannot
            determine its threshold: Bayes error .105 against .003 pooled).
        code: "changes" builds the condition from the m signed intensity changes alone, so that a
            video is enough to generate; "feature" passes the encoder's hidden feature, which
            contains the events themselves (paper).
        output: "log" or "tanh" coordinates of the parameters (see coordinates.py).
    """

    flow: FlowConfig = FlowConfig(condition=41)
    bins: int = 16
    changes: int = 16
    piece: int = 24
    encoder_hidden: int = 96
    summary_hidden: int = 96
    summary_features: int = 64
    rate_features: int = 16
    gates: int = 4
    pool: bool = True
    code: Literal["changes", "feature"] = "changes"
    output: Literal["log", "tanh"] = "log"

    @property
    def spread(self) -> bool:
        """Whether the network estimates standard deviations of a pixel's parameters."""
        return self.code == "changes"


PAPER_MODEL = ModelConfig(
    flow=FlowConfig(condition=96, injector=False, asinh=False), piece=6, pool=False,
    code="feature", output="tanh")

MODELS = {"default": ModelConfig(), "paper": PAPER_MODEL}

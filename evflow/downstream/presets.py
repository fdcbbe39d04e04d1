"""What the event networks are and learn from, by name: `small` trains on two cores and fits into
2 MB, `published` is the setting of the papers for one GPU, `original` EV-FlowNet's first one, which
needs no true flow, `debug` takes seconds.

    network, learning = training("e2vid", "small")
"""

from __future__ import annotations

import dataclasses

from evflow.downstream.e2vid import E2VID, E2VID_PLUS, E2VID_SMALL
from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.firenet import FireNet
from evflow.downstream.network import Network
from evflow.downstream.prior import WidePrior
from evflow.downstream.simulated import SequenceConfig
from evflow.downstream.train import LearningConfig
from evflow.errors import EvflowDataError

KINDS: dict[str, type[Network]] = {"e2vid": E2VID, "firenet": FireNet, "evflownet": EVFlowNet}

WIDE = SequenceConfig(prior=WidePrior())
_FLOW = dataclasses.replace(WIDE, windows=4, crop=64)
_TINY = dataclasses.replace(WIDE, sequences=2, windows=4, crop=16, steps_per_window=2)
_LARGE = dataclasses.replace(WIDE, sequences=4, windows=40, crop=128)

TRAININGS: dict[tuple[str, str], tuple[Network, LearningConfig]] = {
    ("e2vid", "small"): (E2VID_SMALL, LearningConfig(WIDE, steps=3000, warmup=50)),
    ("firenet", "small"): (FireNet(), LearningConfig(
        dataclasses.replace(WIDE, sequences=4), steps=3000, warmup=50)),
    # Base 12 is the largest that stays below 2 MB: 0.50 M parameters.
    ("evflownet", "small"): (EVFlowNet(base=12), LearningConfig(
        _FLOW, steps=6000, warmup=50, rate=2e-3)),
    ("e2vid", "debug"): (E2VID(base=4, encoders=1, blocks=0), LearningConfig(_TINY, steps=4)),
    ("firenet", "debug"): (FireNet(base=4), LearningConfig(_TINY, steps=4)),
    ("evflownet", "debug"): (EVFlowNet(base=4), LearningConfig(_TINY, steps=4)),
    ("e2vid", "published"): (E2VID_PLUS, LearningConfig(
        _LARGE, steps=60_000, warmup=500, rate=3e-4)),
    ("firenet", "published"): (FireNet(), LearningConfig(
        _LARGE, steps=60_000, warmup=500, rate=3e-4)),
    ("evflownet", "published"): (EVFlowNet(), LearningConfig(
        dataclasses.replace(_LARGE, sequences=8, windows=4), steps=60_000, warmup=500, rate=1e-4)),
    ("evflownet", "original"): (EVFlowNet(scales=4), LearningConfig(
        dataclasses.replace(_LARGE, sequences=8, windows=4), steps=60_000, warmup=500, rate=3e-4)),
}


def training(network: str, preset: str = "small") -> tuple[Network, LearningConfig]:
    """The network of a kind ("e2vid", "firenet", "evflownet") and how it is trained; EV020."""
    if (network, preset) not in TRAININGS:
        raise EvflowDataError("EV020", f"network {network!r}, preset {preset!r}.",
                              f"Choose of {[' '.join(pair) for pair in TRAININGS]}.")
    return TRAININGS[network, preset]

"""Named configurations of networks and trainings: `small` trains on two cores and fits into
2 MB, `published` is after the papers for one GPU, `original` EV-FlowNet's first form, which needs
no true flow, `debug` takes seconds. Stoffregen et al. (ECCV 2020) train E2VID on 2 sequences of
112 px at a rate of 1e-4, with temporal consistency 2 and LPIPS by VGG; here are 4 of 128 px, 3e-4,
.2, and L1 + SSIM or LPIPS by AlexNet.

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
# With scenes and cameras as for images, in half of the windows fewer than one pixel in eight shows
# any motion. Noise on every bin would hide the events' deviation.
_FLOW = dataclasses.replace(
    WIDE, sequences=16, windows=2, crop=64, noise=0.0, prior=WidePrior(theta=(0.05, 0.5)),
    scene=dataclasses.replace(WIDE.scene, contrast=(0.5, 1.0), speed_px_s=(10.0, 350.0)))
# Long enough for scenes that pause: a network trained on fewer windows forgets them. And many
# scenes before a resting camera: noise must not accumulate into shapes where little happens.
_LONG = dataclasses.replace(
    WIDE, sequences=3, windows=40, scene=dataclasses.replace(WIDE.scene, resting_fraction=0.4))
_TINY = dataclasses.replace(WIDE, sequences=2, windows=4, crop=16, steps_per_window=2)
_LARGE = dataclasses.replace(WIDE, sequences=4, windows=40, crop=128)
_LARGE_FLOW = dataclasses.replace(
    _LARGE, sequences=8, windows=4, noise=0.0, hot_pixels=0.0)  # as flow is published

TRAININGS: dict[tuple[str, str], tuple[Network, LearningConfig]] = {
    ("e2vid", "small"): (E2VID_SMALL, LearningConfig(_LONG, steps=3000, warmup=50)),
    ("firenet", "small"): (FireNet(), LearningConfig(
        dataclasses.replace(WIDE, sequences=4), steps=3000, warmup=50)),
    # Three encoders leave the first, which sees the motion, 16 features; 0.22 M parameters.
    ("evflownet", "small"): (EVFlowNet(base=16, encoders=3), LearningConfig(
        _FLOW, steps=3000, warmup=20, rate=2e-3, skip=0, elsewhere=0.0, normalised=True)),
    ("e2vid", "debug"): (E2VID(base=4, encoders=1, blocks=0), LearningConfig(_TINY, steps=4)),
    ("firenet", "debug"): (FireNet(base=4), LearningConfig(_TINY, steps=4)),
    ("evflownet", "debug"): (EVFlowNet(base=4), LearningConfig(_TINY, steps=4)),
    ("e2vid", "published"): (E2VID_PLUS, LearningConfig(
        _LARGE, steps=60_000, warmup=500, rate=3e-4)),
    ("firenet", "published"): (FireNet(), LearningConfig(
        _LARGE, steps=60_000, warmup=500, rate=3e-4)),
    ("evflownet", "published"): (EVFlowNet(), LearningConfig(
        _LARGE_FLOW, steps=60_000, warmup=500, rate=1e-4)),
    ("evflownet", "original"): (EVFlowNet(scales=4), LearningConfig(
        _LARGE_FLOW, steps=60_000, warmup=500, rate=3e-4)),
}


def training(network: str, preset: str = "small") -> tuple[Network, LearningConfig]:
    """The network of a kind ("e2vid", "firenet", "evflownet") and how it is trained; EV020."""
    if (network, preset) not in TRAININGS:
        raise EvflowDataError("EV020", f"network {network!r}, preset {preset!r}.",
                              f"Choose of {[' '.join(pair) for pair in TRAININGS]}.")
    return TRAININGS[network, preset]

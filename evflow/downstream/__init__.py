"""Networks that turn events into video (E2VID, FireNet) and optical flow (EV-FlowNet). Published
weights can be loaded.

    network, params = load_published("E2VID_plus.pth.tar")
    images = reconstruct(network, params, events, frame_times_us)
    recording = with_reconstructed_frames(recording, "e2vid-small")  # where it has none
"""

from evflow.downstream.e2vid import E2VID, E2VID_LIGHTWEIGHT, E2VID_PLUS, E2VID_SMALL
from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.firenet import FireNet
from evflow.downstream.network import Network, run
from evflow.downstream.published import load_published
from evflow.downstream.released import Trained, load_network, save_network
from evflow.downstream.sync import sync_times, window_edges
from evflow.downstream.tensor import (
    event_tensor,
    normalise,
    prepared,
    reconstruct,
    reconstructions,
    signed,
)
from evflow.downstream.torch_file import Checkpoint, read_checkpoint
from evflow.downstream.video import with_reconstructed_frames

__all__ = [
    "E2VID",
    "E2VID_LIGHTWEIGHT",
    "E2VID_PLUS",
    "E2VID_SMALL",
    "Checkpoint",
    "EVFlowNet",
    "FireNet",
    "Network",
    "Trained",
    "event_tensor",
    "load_network",
    "load_published",
    "normalise",
    "prepared",
    "read_checkpoint",
    "reconstruct",
    "reconstructions",
    "run",
    "save_network",
    "signed",
    "sync_times",
    "window_edges",
    "with_reconstructed_frames",
]

"""A sequence of a data set for its users: events, frames and ground truth. NumPy only.

Units: times in us from the sequence's first frame, flow in pixels per frame interval, intensity
changes and thresholds in natural-log units, noise rates in Hz per pixel and polarity.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from evflow.errors import EvflowDataError
from evflow.types import Events, Recording

SPLITS = ("train", "test")
CAMERA = ("theta_on", "theta_off", "eta_on", "eta_off")
NOMINAL = (*CAMERA, "sigma_on", "sigma_off")

Arrays = dict[str, np.ndarray]


def sequence_names(train: int, test: int) -> tuple[str, ...]:
    """("train/00000", ..., "test/00000", ...): the sequences of a set, ordered by number."""
    counts = zip(SPLITS, (train, test), strict=True)
    return tuple(f"{split}/{i:05d}" for split, count in counts for i in range(count))


@dataclasses.dataclass(frozen=True, eq=False)
class EventSequence:
    """A hidden camera that watched a moving scene, for T frames of H x W pixels.

    events: sorted, 0 <= t < frame_times[-1]. frames: (T, H, W) uint8. frame_times: (T,) int64 us,
        the first is 0.
    flow: (T-1, 2, H, W) float32, (x, y): displacement from frame i to frame i+1 of the scene point
        at each pixel of frame i. flow_visible: (T-1, H, W) bool: also visible in frame i+1.
    changes: (T-1, H, W) float32, change of true log intensity between the two frames, without noise
        or rounding, in the sensor's log map.
    camera: theta_on, theta_off, eta_on, eta_off, each (H, W) float32; the noise rates are those at
        the sequence's mean intensity.
    nominal: their medians, and the threshold mismatch sigma_on, sigma_off.
    """

    events: Events
    frames: np.ndarray
    frame_times: np.ndarray
    flow: np.ndarray
    flow_visible: np.ndarray
    changes: np.ndarray
    camera: dict[str, np.ndarray]
    nominal: dict[str, float]

    @property
    def recording(self) -> Recording:
        """What a user of the camera has: events and frames."""
        return Recording(self.events, self.frames, self.frame_times)

    @property
    def truth(self) -> Arrays:
        """The ground truth, which a user lacks, by the names in files."""
        return {"flow": self.flow, "flow_visible": self.flow_visible, "changes": self.changes,
                **{f"camera/{name}": self.camera[name] for name in CAMERA},
                "nominal": np.array([self.nominal[name] for name in NOMINAL], np.float64)}

    @staticmethod
    def of(recording: Recording, truth: Arrays) -> EventSequence:
        """Recording and truth combined; EV009 if an array has the wrong dtype or shape."""
        steps, height, width = recording.frames.shape
        layout = truth_layout(steps, height, width)
        for name, (shape, dtype) in layout.items():
            found = truth[name].shape, truth[name].dtype
            if found != (shape, dtype):
                raise EvflowDataError(
                    "EV009", f"{name} is {found[1]} {found[0]} beside frames of "
                    f"{recording.frames.shape}; expected {dtype} {shape}.", "Make it again.")
        return EventSequence(
            recording.events, recording.frames, recording.frame_times,
            truth["flow"], truth["flow_visible"], truth["changes"],
            {name: truth[f"camera/{name}"] for name in CAMERA},
            dict(zip(NOMINAL, truth["nominal"].tolist(), strict=True)))


def truth_layout(
    steps: int, height: int, width: int
) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Shape and dtype of every array of `EventSequence.truth`, for that many frames."""
    single, pixels = np.dtype(np.float32), (height, width)
    return {"flow": ((steps - 1, 2, *pixels), single),
            "flow_visible": ((steps - 1, *pixels), np.dtype(bool)),
            "changes": ((steps - 1, *pixels), single),
            **{f"camera/{name}": (pixels, single) for name in CAMERA},
            "nominal": ((len(NOMINAL),), np.dtype(np.float64))}

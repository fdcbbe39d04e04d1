"""evflow: measure an event camera from its recording, and simulate any video as it would see it.

The public names load on first use, so that `import evflow` and `evflow --help` stay instant.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "EvflowDataError": "errors",
    "Events": "types",
    "Recording": "types",
    "Window": "types",
    "Camera": "camera",
    "CameraPrior": "camera",
    "SENSORS": "sensors",
    "SensorModel": "sensors",
    "Summary": "camera",
    "Finding": "inspection",
    "Report": "inspection",
    "check": "inspection",
    "linearised": "io.adjust",
    "read_events": "io",
    "read_recording": "io",
    "iter_windows": "io",
    "open_writer": "io",
    "write_events": "io",
    "write_recording": "io",
    "read_noise_histogram": "pixels",
    "with_faults": "pixels",
    "with_noise_histogram": "pixels",
    "delta_log_intensity": "intensity",
    "voxelize": "voxel",
    "simulate": "simulator",
    "simulate_counts": "simulator",
    "simulate_stream": "simulator",
    "simulate_voxels": "simulator",
    "Code": "model",
    "Stats": "model",
    "code_from_video": "model",
    "encode": "model",
    "estimate": "model",
    "estimate_with_std": "model",
    "finish": "model",
    "forward": "model",
    "generate": "model",
    "inverse": "model",
    "log_prob": "model",
    "squash": "model",
    "summarize": "model",
    "unsquash": "model",
    "load_weights": "weights",
    "save_weights": "weights",
    "compare": "metrics.streams",
    "write_report": "report.camera",
    "CameraEstimate": "camera_estimate",
    "estimate_camera": "recording",
}

__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"evflow.{_HOME[name]}"), name)
    raise AttributeError(f"module 'evflow' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__

"""Recordings from and to files. NumPy only: reading never imports JAX."""

from evflow.io.base import (
    open_writer,
    read_events,
    read_recording,
    write_events,
    write_recording,
)
from evflow.io.dsec import DsecWriter
from evflow.io.windows import WindowPlan, condensed, iter_windows, plan_windows

__all__ = [
    "DsecWriter",
    "WindowPlan",
    "condensed",
    "iter_windows",
    "open_writer",
    "plan_windows",
    "read_events",
    "read_recording",
    "write_events",
    "write_recording",
]

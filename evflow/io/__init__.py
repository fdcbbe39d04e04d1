"""Reading and writing recordings. NumPy only: reading never imports JAX."""

from evflow.io.formats.dsec import DsecWriter
from evflow.io.registry import (
    open_writer,
    read_events,
    read_recording,
    write_events,
    write_recording,
)

__all__ = [
    "DsecWriter",
    "open_writer",
    "read_events",
    "read_recording",
    "write_events",
    "write_recording",
]

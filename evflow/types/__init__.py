"""The data types shared by all packages: `Events`, `Recording`, `Window`. Host side, NumPy only.

An object that exists is valid: construction checks shape, dtype, NaN, order, coordinates and
polarity once, and raises an `EvflowDataError` that says what was seen, where, and what to do.
Nothing is sorted, clipped or dropped. Arrays are kept read-only, and without a copy where their
dtype already fits. Units: times are int64 microseconds on the recording's own clock, a size is
(width, height), an image is (height, width), brightness is in DN (digital numbers).
"""

from evflow.types.events import Events
from evflow.types.recording import BIT_DEPTHS, Recording, Window, release

__all__ = ["BIT_DEPTHS", "Events", "Recording", "Window", "release"]

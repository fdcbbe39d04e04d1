"""The one exception for bad data, with stable codes.

Every message says what was seen, where, what it probably means and what to do about it.
An `EvflowDataError` is always about the user's file, arrays or options; a `ValueError` or
`TypeError` raised by evflow is a programming error.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial

CODES: dict[str, str] = {
    "EV001": "empty input",
    "EV002": "wrong shape",
    "EV003": "wrong dtype or values that do not fit it",
    "EV004": "timestamps not sorted",
    "EV005": "coordinates outside the sensor",
    "EV006": "unknown polarity convention",
    "EV007": "NaN or infinite values",
    "EV008": "unknown or unreadable file format",
    "EV009": "damaged or truncated file",
    "EV010": "an optional package is missing",
    "EV011": "no intensity frames",
    "EV012": "frames and events do not overlap in time",
    "EV013": "refusing to overwrite",
    "EV014": "camera parameters out of range",
    "EV015": "sizes of camera, frames and events disagree",
    "EV016": "file or folder not found",
    "EV017": "too little information to estimate a camera",
    "EV018": "weights do not fit this version of the network",
    "EV019": "the disk is full or the output cannot be written",
    "EV020": "option out of range",
    "EV021": "polarity inverted",
    "EV022": "polarity lost",
    "EV023": "wrong time unit",
    "EV024": "frames and events not aligned",
    "EV025": "a gap in the events",
    "EV026": "the clock jumps",
    "EV027": "saturated or black frames",
    "EV028": "repeated frames",
    "EV029": "frames mirrored",
    "EV030": "frames dropped",
    "EV031": "bit depth of the frames",
    "EV032": "colour frames",
    "EV033": "pixels far busier than their neighbours",
    "EV034": "events and frames are unrelated",
    "EV035": "events bunch at the frames",
    "EV036": "the light flickers",
    "EV037": "frames and events displaced",
    "EV038": "repeated events",
    "EV039": "the event rate is capped",
}


class EvflowDataError(Exception):
    """Bad input: something about the user's file, arrays or options.

    `str(error)` is one line, "EV004 timestamps not sorted: <seen> <fix>".

    Attributes:
        code: one of `CODES`, "EV001" and so on; stable, so programs may branch on it.
        seen: what was found, and where.
        fix: what to do about it; "" if there is no advice.
        where: the file, or the place in it, that `seen` names; None for arrays and options.

    Example:
        >>> try:
        ...     recording = ef.read_recording("flight.h5")
        ... except ef.EvflowDataError as error:
        ...     print(error.code, error.fix)
    """

    def __init__(self, code: str, seen: str, fix: str = "", *, where: object = None) -> None:
        self.code, self.seen, self.fix = code, seen, fix
        self.where = None if where is None else str(where)
        super().__init__(f"{code} {CODES[code]}: {seen}{' ' + fix if fix else ''}")

    def __reduce__(self) -> tuple[Callable[..., EvflowDataError], tuple[str, str, str]]:
        """Pickle by parts, so that the error can pass between processes."""
        return partial(type(self), where=self.where), (self.code, self.seen, self.fix)


@contextlib.contextmanager
def naming(path: object) -> Iterator[None]:
    """Prefix the messages of errors raised in the block with `path`, unless they name a file."""
    try:
        yield
    except EvflowDataError as e:
        if e.where is not None:
            raise
        raise EvflowDataError(e.code, f"{path}: {e.seen}", e.fix, where=path) from e

"""Input validation: checks that turn user arrays into `Events` or a `Recording`. NumPy only.

Every check returns its argument in the canonical dtype (without a copy where it fits) or raises
an `EvflowDataError` that says what was seen, where, and what to do. Nothing is repaired.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError

Size = tuple[int, int]

COLUMNS = ("x", "y", "t", "p")
LATEST_US = 1 << 62
MOST_SIDE = 1 << 16  # pixels; coordinates of events have 16 bits
RESET_US = 1_000_000  # a step back by more than this is another clock, not a late packet


def plain(name: str, value: Any, unknown: str = "0") -> Any:
    """`value` as a NumPy array in native byte order; JAX arrays pass unchanged. Raises EV003 for
    masked arrays (the mask would be lost; `unknown` is what may fill it), datetime64 or
    timedelta64, and objects that are not arrays."""
    if hasattr(value, "aval"):
        return value
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise EvflowDataError(
            "EV003", f"{name} has {np.ma.count_masked(value):,} masked values, which would be "
            "treated as valid.",
            f"Remove or fill them: value.compressed(), value.filled({unknown}).")
    try:
        array = np.asarray(value)
    except EvflowDataError:
        raise
    except Exception as e:  # e.g. tensors on a GPU or with gradients; each library
        raise EvflowDataError(
            "EV003", f"{name} is a {type(value).__name__}, which cannot be made an array ({e}).",
            "For a PyTorch tensor: tensor.detach().cpu().float().numpy().") from e
    if array.dtype.kind in "mM":
        kind = {"m": "timedelta", "M": "datetime"}[array.dtype.kind]
        raise EvflowDataError(
            "EV003", f"{name} has dtype {array.dtype}, a type with its own time unit.",
            f"Times are integer us: t.astype('{kind}64[us]').astype(np.int64).")
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def need(value: Any, kind: Any, name: str, fix: str) -> None:
    """Raise EV020 unless `value` is an instance of `kind`, a class or a union of classes."""
    if not isinstance(value, kind):
        expected = getattr(kind, "__name__", kind)
        raise EvflowDataError(
            "EV020", f"{name} is of type {type(value).__name__}; expected {expected}.", fix)


def require(config: Any, name: str, good: bool, rule: str) -> None:
    """Raise EV020 unless `good`: the field `name` of a configuration must follow `rule`."""
    if not good:
        kind, value = type(config).__name__, getattr(config, name)
        raise EvflowDataError("EV020", f"{kind}({name}={value!r}).", f"It must be {rule}.")


def require_seed(config: Any) -> None:
    """Raise EV020 where the seed of a configuration has more than 32 bits: JAX would drop the
    others, and another seed's run would begin."""
    require(config, "seed", -2**31 <= config.seed < 2**32, "of at most 32 bits")


def check_size(size: Any) -> Size:
    """(width, height) as ints in 1..65536; raises EV020."""
    try:
        width, height = (operator.index(v) for v in size)
    except (TypeError, ValueError):
        width = height = 0
    if not (0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE):
        raise EvflowDataError(
            "EV020", f"size is {size!r}.", "Give (width, height) in pixels, e.g. (346, 260).")
    return width, height


def check_exposure(exposure_us: float) -> int:
    """Microseconds >= 0 as an int; raises EV020."""
    one = isinstance(exposure_us, int | float | np.number)
    if not (one and 0 <= exposure_us < 2**62):
        raise EvflowDataError("EV020", f"exposure_us={exposure_us!r}.",
                              "Give microseconds, >= 0; 0 if it is unknown.")
    return int(exposure_us)


def check_full_scale(full_scale: float) -> int:
    """The DN of a saturated pixel, a whole number 0..65535, as an int; raises EV020."""
    one = isinstance(full_scale, int | float | np.number)
    if not (one and 0 <= full_scale < 2**16 and full_scale == int(full_scale)):
        raise EvflowDataError(
            "EV020", f"full_scale={full_scale!r:.60}.", "Give the DN of a saturated pixel, such as "
            "1023 for 10 bits or 4095 for 12; 0 if it is unknown.")
    return int(full_scale)


def integer_us(t: int) -> int:
    """A time that must be an integer; raises EV003."""
    try:
        return operator.index(t)
    except TypeError:
        raise EvflowDataError(
            "EV003", f"the time {t!r} is a {type(t).__name__}; times are integer us.",
            "Give int(t) for microseconds, round(1e6 * t) for seconds.") from None


def check_times(t: np.ndarray, name: str, *, strict: bool) -> np.ndarray:
    """Times (N,) as sorted int64 (strict: strictly increasing); raises EV003, EV004."""
    if t.size == 0:
        return np.zeros(0, np.int64)
    if t.dtype.kind not in "iu":
        raise EvflowDataError(
            "EV003", f"{name} has dtype {t.dtype} (first value {t[0]}); times are integer us.",
            "Multiply seconds by 1e6 and round: np.rint(t * 1e6).astype(np.int64).")
    if t.dtype == np.uint64 and t.max() > np.iinfo(np.int64).max:
        raise EvflowDataError(
            "EV003", f"{name} reaches {t.max()}, which does not fit int64.",
            "Times are microseconds; was a negative time stored as unsigned?")
    t = t.astype(np.int64, copy=False)
    back = t[1:] <= t[:-1] if strict else t[1:] < t[:-1]
    if back.any():
        raise _unsorted(t, np.flatnonzero(back), name)
    if beyond(t[0], t[-1]):
        raise EvflowDataError(
            "EV003", f"{name} spans {t[0]:,} to {t[-1]:,} us, "
            "beyond 2^62 us (146,000 years).", "Wrong time unit, or bytes that are not times?")
    return t


def beyond(first: float | np.integer, last: float | np.integer) -> bool:
    """Whether the difference of two times in [first, last] (us) might overflow int64."""
    return int(first) <= -LATEST_US or int(last) > LATEST_US


def _unsorted(t: np.ndarray, steps: np.ndarray, name: str) -> EvflowDataError:
    first, most = int(steps[0]), max(int(t[i]) - int(t[i + 1]) for i in steps[:100_000])
    times = "time" if len(steps) == 1 else "times"
    verb = "do not advance" if most == 0 else "go back"
    seen = (f"{name}: timestamps {verb} {len(steps):,} {times}, first at index {first + 1:,}: "
            f"{t[first]:,} -> {t[first + 1]:,} us (at most {most:,} us back).")
    fix = ("Two of them are equal: wrong time unit, or repeated entries?" if most == 0 else
           "A camera reset, or two recordings joined? Split them there." if most > RESET_US else
           "Nothing is sorted silently: if the order does not matter, sort all columns with "
           "np.argsort(t, kind='stable').")
    return EvflowDataError("EV004", seen, fix)


def check_polarity(p: np.ndarray) -> np.ndarray:
    """Polarity (N,) as bool, True = ON; from bool, {0, 1} or {-1, 1}; raises EV006."""
    if p.size == 0 or p.dtype == bool:
        return p.astype(bool, copy=False)
    if p.dtype.kind in "iu":
        low, high = int(p.min()), int(p.max())
        if low >= 0 and high <= 1:
            return p.astype(bool)
        if low == -1 and high <= 1 and p.all():
            return p > 0
    some = np.unique(p[:1_000_000]) if p.dtype.kind in "iuf" else p
    values = ", ".join(str(v) for v in some[:5])
    raise EvflowDataError(
        "EV006", f"p has dtype {p.dtype} and holds {values}.",
        "Expected bool, {0, 1} or {-1, 1}; a -1 stored as an unsigned byte reads as 255: use int8.")


def check_columns(*given: Any) -> dict[str, np.ndarray]:
    """x, y, t, p as 1-D arrays of equal length without NaN; raises EV002, EV003, EV007."""
    columns = {name: np.asarray(plain(name, v))
               for name, v in zip(COLUMNS, given, strict=True)}
    for name, a in columns.items():
        if a.ndim != 1:
            fix = "Columns must be 1-D arrays of equal length."
            if a.ndim == 2 and 4 in a.shape:
                rows = "events.T" if a.shape[1] == 4 else "events"
                fix = f"All columns in one array? Unpack it: x, y, t, p = {rows}."
            raise EvflowDataError("EV002", f"{name} has shape {a.shape}.", fix)
    lengths = {name: len(a) for name, a in columns.items()}
    if len(set(lengths.values())) > 1:
        raise EvflowDataError("EV002", f"columns differ in length: {lengths}.")
    for name, a in columns.items():
        if a.dtype.kind == "f" and not (finite := np.isfinite(a)).all():
            where = int(np.argmin(finite))
            raise EvflowDataError(
                "EV007", f"{name} is {a[where]} at event {where:,} ({(~finite).sum():,} in all).")
    return columns


def check_coordinates(x: np.ndarray, y: np.ndarray, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """x, y as uint16 inside `size`; raises EV003, EV005."""
    if x.size == 0:
        return np.zeros(0, np.uint16), np.zeros(0, np.uint16)
    for name, a in (("x", x), ("y", y)):
        if a.dtype.kind not in "iu":
            raise EvflowDataError(
                "EV003", f"{name} has dtype {a.dtype} (first value {a[0]}).",
                "Were they undistorted? Use the raw integer pixel coordinates.")
    width, height = size
    if min(x.min(), y.min()) < 0 or x.max() >= width or y.max() >= height:
        outside = (x < 0) | (x >= width) | (y < 0) | (y >= height)
        swapped = min(x.min(), y.min()) >= 0 and x.max() < height and y.max() < width
        first = int(np.argmax(outside))
        raise EvflowDataError(
            "EV005",
            f"{outside.sum():,} of {x.size:,} events ({100 * outside.mean():.1f} %) lie outside "
            f"{width}x{height}: x {x.min()}..{x.max()}, y {y.min()}..{y.max()}, first at event "
            f"{first:,} (x={x[first]}, y={y[first]}).",
            f"size is (width, height): did you mean ({height}, {width})?" if swapped else
            "Wrong sensor size or bit mask? Pass this sensor's size.")
    return x.astype(np.uint16, copy=False), y.astype(np.uint16, copy=False)


def check_frames(frames: np.ndarray, size: Size, full_scale: int = 0) -> None:
    """Check shape (T, H, W), dtype, size and finite values; raises EV002, EV003, EV007, EV015.

    full_scale: the DN of white, 0 if it is unknown; float frames are not taken for fractions of
    white if it is known, as that of a part of a recording is: dark parts are not fractions.
    """
    width, height = size
    if frames.ndim == 4 and frames.shape[-1] in (3, 4):
        raise EvflowDataError(
            "EV002", f"frames are colour, {frames.shape}.",
            "Convert them: frames = evflow.light.colour.luma(frames[..., 2::-1]) for RGB(A), "
            "frames[..., :3] for OpenCV's BGR(A).")
    if frames.ndim != 3:
        raise EvflowDataError("EV002", f"frames have shape {frames.shape}.", "Expected (T, H, W).")
    if frames.dtype not in (np.uint8, np.uint16, np.float32):
        fix = {"f": " Convert them: frames.astype(np.float32).",
               "i": " Convert them: frames.astype(np.uint16), if none is negative.",
               "b": " Convert them: 255 * frames.astype(np.uint8)."}.get(frames.dtype.kind, "")
        raise EvflowDataError("EV003", f"frames have dtype {frames.dtype}.",
                              f"Expected uint8, uint16 or float32 DN.{fix}")
    if frames.shape[1:] != (height, width):
        swapped = (" Are the frames transposed, or are width and height of size swapped?"
                   if frames.shape[1:] == (width, height) else "")
        raise EvflowDataError(
            "EV015", f"frames are {frames.shape[2]}x{frames.shape[1]} (width x height) but events "
            f"are {width}x{height}.", f"Both must come from the same sensor, uncropped.{swapped}")
    if frames.dtype == np.float32 and len(frames):
        _float_frames(frames, white_known=full_scale >= 255)


def _float_frames(frames: np.ndarray, white_known: bool) -> None:
    for index, frame in enumerate(frames):  # one by one: no (T, H, W) temporary
        finite = np.isfinite(frame)
        if not finite.all():
            raise EvflowDataError(
                "EV007", f"frame {index} has {(~finite).sum():,} NaN or infinite values.",
                "Frames must be linear DN; a logarithm of pixels <= 0, or missing pixels?")
    low, high = float(frames.min()), float(frames.max())
    fractions = low >= 0 and 0 < high <= 1 and not white_known
    if low < 0 or high > 255 or fractions:
        fix = ("Multiply by 255, if 1 is white. If they are really so dark: Recording(..., "
               "full_scale=255); of a file, leave them out: --no-frames." if fractions else
               "Rescale, or pass uint16.")
        raise EvflowDataError(
            "EV003", f"float frames span {low:g}..{high:g}; expected DN 0..255.", fix)


def read_only(array: np.ndarray) -> np.ndarray:
    """A read-only view; the caller's own array stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view

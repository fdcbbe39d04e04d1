"""Validation of incoming video, frame by frame and in blocks."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike

from evflow.camera.arguments import number
from evflow.checks import plain
from evflow.errors import EvflowDataError
from evflow.light.log_maps import to_dn
from evflow.light.ranges import DARKEST_DN, check_bits, meaning


def blocks(
    frames_iter: Iterable[ArrayLike], times_iter: Iterable[ArrayLike],
    shape: tuple[int, ...], length: int, *, copy: bool, full_scale: float | None = None,
) -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
    """Validated flat frames (bytes or float32 DN) and int64 times, in blocks independent of the
    input's chunks: first the first frame alone, then `length` frames at a time.

    Args:
        frames_iter, times_iter: single frames or blocks, and matching times.
        shape: (H, W).
        length: frames of a block.
        copy: copy frames on arrival, for sources that reuse one buffer.
        full_scale: value of white in float and uint16 frames. None is 255 for floats, of which
            some must then exceed DARKEST_DN, and 65535 for uint16, of which some must exceed
            FEW_BITS.

    Raises:
        EvflowDataError: EV001 for less than two frames; EV002, EV003, EV004, EV007 and EV015 for
            bad ones.
    """
    pairs = ((_flat(frame, copy, full_scale), t)
             for frame, t in _single_frames(frames_iter, times_iter, shape, full_scale))
    taken = list(itertools.islice(pairs, 1))
    if not taken:
        raise EvflowDataError("EV001", "the video has no frames.", "Give at least two frames.")
    count = 0
    while taken:
        count += len(taken)
        yield [frame for frame, _ in taken], np.array([t for _, t in taken], np.int64)
        taken = list(itertools.islice(pairs, length))
    if count < 2:
        raise EvflowDataError("EV001", "the video has one frame.",
                              "Events need a change: give at least two frames (of a part, "
                              "--start and --stop, a longer one).")


def _flat(frame: np.ndarray, copy: bool, full_scale: float | None) -> np.ndarray:
    if frame.dtype == np.uint16:
        frame = to_dn(frame, full_scale or 65535.0)
    dtype = np.uint8 if frame.dtype == np.uint8 else np.float32
    return frame.astype(dtype, copy=copy).ravel()


def _single_frames(
    frames_iter: Iterable[ArrayLike], times_iter: Iterable[ArrayLike],
    shape: tuple[int, ...], full_scale: float | None,
) -> Iterator[tuple[np.ndarray, int]]:
    """Validated (frame, time) pairs, from single frames or blocks."""
    if full_scale is not None and not 0 < number(full_scale) < np.inf:
        raise EvflowDataError(
            "EV020", f"full_scale={full_scale!r:.60}.", "Give the value of white.")
    dtype, last, index, doubt, bright = None, None, 0, None, full_scale is not None
    peak = 0  # of uint16 frames
    for block, times in itertools.zip_longest(frames_iter, times_iter):
        if block is None or times is None:
            raise EvflowDataError(
                "EV002", f"the {'frames' if block is None else 'times'} end after {index} frames.",
                "Give one time per frame, in blocks of the same lengths.")
        block = np.asarray(plain("frames", block))
        times = np.atleast_1d(np.asarray(plain("times", times)))
        block = block[None] if block.ndim == 2 else block
        if full_scale not in (None, 255) and block.dtype.kind == "f":
            block = block * block.dtype.type(255 / full_scale)
        _check_block(block, times, shape, dtype, index)
        if full_scale is not None:
            _check_white(block, full_scale, index)
        if block.dtype.kind == "f" and not bright:
            doubt, bright = doubt or meaning(block), float(block.max(initial=0)) > DARKEST_DN
        peak = max(peak, int(block.max(initial=0))) if block.dtype == np.uint16 else peak
        dtype = block.dtype
        for frame, t in zip(block, times.tolist(), strict=True):
            if last is not None and t <= last:
                raise EvflowDataError(
                    "EV004", f"frame {index} is at {t} us, the one before at {last} us.",
                    "Frame times must increase strictly.")
            last, index = t, index + 1
            yield frame, t
    if doubt and not bright:
        raise EvflowDataError(
            "EV003", f"no value of the float frames is above {DARKEST_DN:g} where white is 255: "
            f"{doubt.what}?", doubt.fix)
    if full_scale is None:
        check_bits(peak)


def _check_white(block: np.ndarray, full_scale: float, index: int) -> None:
    """Raise EV003 for integers beyond white, EV020 for bytes with another white than 255; floats
    have been scaled by it."""
    if block.dtype == np.uint8 and full_scale != 255:
        raise EvflowDataError(
            "EV020", f"full_scale={full_scale} with uint8 frames, whose white is 255.", "Leave it "
            "out; or scale them to floats: evflow.light.log_maps.to_dn(frames, full_scale).")
    if block.dtype == np.uint16 and (high := int(block.max(initial=0))) > full_scale:
        over = int(block.reshape(len(block), -1).max(1).argmax())
        raise EvflowDataError(
            "EV003", f"frame {index + over} reaches {high}, beyond white at full_scale="
            f"{full_scale:g}.", "Pass the value of white, 1023 for 10 bits, 4095 for 12, 65535 for "
            "16; what is brighter than white: np.minimum(frames, full_scale).")


def _check_block(
    block: np.ndarray, times: np.ndarray, shape: tuple[int, ...], dtype: np.dtype | None,
    index: int,
) -> None:
    if block.ndim != 3 or len(times) != len(block):
        raise EvflowDataError("EV002", f"frames {block.shape} with times {times.shape}.",
                              "Expected (T, H, W) gray frames and T times.")
    if block.shape[1:] != shape:
        raise EvflowDataError(
            "EV015", f"frames are {block.shape[1:]} (H, W), the camera is {shape}.",
            "Resize one of them.")
    if dtype is not None and block.dtype != dtype:
        raise EvflowDataError("EV003", f"frame {index} is {block.dtype}, earlier ones {dtype}.")
    if not np.issubdtype(times.dtype, np.integer):
        raise EvflowDataError("EV003", f"frame times are {times.dtype}.",
                              "Give integer microseconds (seconds x 1e6).")
    if times.dtype == np.uint64 and times.max(initial=0) >= 2**63:
        raise EvflowDataError("EV003", f"frame times reach {times.max()}, more than int64 holds.",
                              "Was a negative time stored as unsigned?")
    if block.dtype in (np.uint8, np.uint16):
        return
    if not np.issubdtype(block.dtype, np.floating):
        raise EvflowDataError("EV003", f"frames are {block.dtype}.",
                              "Expected uint8, uint16 or floating DN on 0..255.")
    low, high = block.min(initial=0.0), block.max(initial=0.0)
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = ~np.isfinite(block)
        at = np.argwhere(bad)[0]
        raise EvflowDataError(
            "EV007", f"{bad.sum()} values of the frames are not finite, first in frame "
            f"{index + int(at[0])} at y={at[1]}, x={at[2]}.")
    if low < 0 or high > 255.5:
        doubt = meaning(block) if low < 0 else None
        raise EvflowDataError(
            "EV003", f"float frames reach from {low:.4g} to {high:.4g}, where DN are 0..255"
            f"{f': {doubt.what}?' if doubt else '.'}",
            doubt.fix if doubt else "Scale them: evflow.light.log_maps.to_dn(frames, white).")

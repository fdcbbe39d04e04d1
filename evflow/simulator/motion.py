"""Motion between two frames: optical flow (OpenCV DIS) both ways, and where it can be trusted.

DIS finds motion of up to a few patches of its coarsest picture, about 20 pixels in fine or
repetitive textures, so it starts from the shift of the whole picture where that explains more.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np

from evflow.process.threads import behind

PATCHES = 16  # pixels: two of DIS' patches
SMOOTHING = 2  # iterations of DIS' variational refinement: more are slower and no better
MOTION_QUANTILE = 99.5  # per cent of pixels that are slower than a `speed`
LEAST_SIDE, SHIFTED_SIDE = 8, 160  # on the shorter side: of halved frames that show a shift; at
# which it is found
BETTER = 0.9  # of the difference without a shift: what a shift must reach to be believed
APART_PX, APART = 1.0, 0.05  # forward and backward flow may differ by so much, and of the motion
CHANGED, MISFITS = 5.0, 3.0  # codes: differences of frames that are more than their noise
MISFIT = 0.5  # of the local contrast: what a right flow leaves far below, and a wrong one exceeds
LOST, MUCH = 0.9, 0.4  # of the pixels that change, and these of the picture: so many are wrong
# where another scene begins, and else where things turn by 30 degrees


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """Of frame a (H, W) to frame b. there: (H, W, 2) float32 pixels (x, y) that carry a into b;
    back: those that carry b into a; halves: both at half the resolution, (h, w, 2); trusted: where
    these undo each other, (h, w) bool on a and on b; failed: share of the pixels that change, and
    stay in view, whose flow is wrong; lost: whether next to nothing of a is found in b, as where a
    film is cut."""

    there: np.ndarray
    back: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]
    trusted: tuple[np.ndarray, np.ndarray]
    failed: float
    lost: bool


def motion_between(a: np.ndarray, b: np.ndarray) -> Motion:
    """Motion between frames (H, W) in DN 0..255."""
    height, width = a.shape
    a, b = _coded(a), _coded(b)
    first, second = halved(a), halved(b)
    shift = _shift(first, second)
    there, back = (flow[:height, :width] for flow in _flows(
        _padded(_gray8(a)), _padded(_gray8(b)), *shift))
    halves = halved(there), halved(back)
    return Motion(there, back, halves, *_verdict(first, second, *halves))


def _flows(a: np.ndarray, b: np.ndarray, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Of a to b, and back, from a shift; at the same time where OpenCV has but one thread."""
    if cv2.getNumThreads() > 1:
        return _flow(a, b, x, y), _flow(b, a, -x, -y)
    back: list[np.ndarray] = []
    with behind(1) as later:
        later(lambda: back.append(_flow(b, a, -x, -y)))
        there = _flow(a, b, x, y)
    return there, back[0]


def _flow(a: np.ndarray, b: np.ndarray, x: float, y: float) -> np.ndarray:
    """Of a to b, from a shift. Of a new object of OpenCV's: one that began from a shift before
    finds another flow without."""
    dis: Any = cv2.DISOpticalFlow_create(  # type: ignore[attr-defined]
        cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setVariationalRefinementIterations(SMOOTHING)
    found: np.ndarray = dis.calc(a, b, _even(a.shape, x, y) if x or y else None)
    return found


def halved(values: np.ndarray) -> np.ndarray:
    """At half the resolution, the means of 2x2 pixels."""
    height, width = values.shape[:2]
    return cv2.resize(values, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)


def grid(shape: tuple[int, ...]) -> np.ndarray:
    """(H, W, 2) float32: where each pixel is (x, y)."""
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in shape[1::-1]))
    return np.stack([x, y], -1)


def inside(at: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) uint8, 255 or 0: positions (H, W, 2) within a frame of `shape`, to half a pixel."""
    height, width = shape[:2]
    return cv2.inRange(at, (-0.5, -0.5, 0, 0), (width - 0.5, height - 0.5, 0, 0))


def looked_up(
    image: np.ndarray, at: np.ndarray, how: int = cv2.INTER_LINEAR, into: np.ndarray | None = None
) -> np.ndarray:
    """An image (H, W) or (H, W, C) at positions (H, W, 2) in pixels (x, y), by OpenCV's
    interpolation `how`; outside, its edge."""
    unused: Any = None
    return cv2.remap(image, at, unused, how, into, cv2.BORDER_REPLICATE)


def length(flow: np.ndarray) -> np.ndarray:
    """Of each vector of a flow (H, W, 2), (H, W). OpenCV's rounds by where its result lies."""
    return np.sqrt(np.square(flow[..., 0]) + np.square(flow[..., 1]))


def speed(flow: np.ndarray) -> float:
    """How far the fast pixels of a flow (..., 2) move: as np.percentile of their lengths, which
    takes three times as long."""
    found = length(flow).ravel()
    place = (found.size - 1) * MOTION_QUANTILE / 100
    low = int(place)
    parted, share = np.partition(found, low), place - low
    below = above = parted[low]
    if low + 1 < found.size:
        above = parted[low + 1 :].min()
    apart = above - below
    return float(below + apart * share if share < 0.5 else above - apart * (1 - share))


def _coded(frame: np.ndarray) -> np.ndarray:
    """DN of light as 8-bit codes, by the square root: textures in the dark count too."""
    return cv2.sqrt(np.maximum(frame, 0) * np.float32(255))


def _gray8(frame: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)


def _padded(image: np.ndarray) -> np.ndarray:
    """At least PATCHES pixels on each side: DIS ends the process at some narrower frames."""
    return np.pad(image, [(0, max(0, PATCHES - n)) for n in image.shape], mode="edge")


def _even(shape: tuple[int, ...], x: float, y: float) -> np.ndarray:
    """(H, W, 2) float32: the same flow everywhere; as pairs, a tenth of the time."""
    return np.full(shape, complex(x, y), np.complex64).view(np.float32).reshape(*shape, 2)


def _shift(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Pixels (x, y) that carry all of one frame into the other, of the halved frames by phase
    correlation; 0 unless they explain much of the difference."""
    pixel = 2
    if min(a.shape) < LEAST_SIDE:
        return 0.0, 0.0
    while min(a.shape) > SHIFTED_SIDE:
        a, b, pixel = halved(a), halved(b), 2 * pixel
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(a.copy(), b.copy(), window)  # writes into what it is given
    height, width = a.shape
    i, j = round(x), round(y)
    if i == j == 0 or max(abs(2 * i) - width, abs(2 * j) - height) > 0:
        return 0.0, 0.0
    rest = _overlap(b, i, j) - _overlap(a, -i, -j)
    if np.abs(rest).mean() >= BETTER * np.abs(_overlap(b, i, j) - _overlap(a, i, j)).mean():
        return 0.0, 0.0
    return pixel * x, pixel * y


def _overlap(image: np.ndarray, x: int, y: int) -> np.ndarray:
    """The part of an image that another, shifted by (x, y), covers."""
    height, width = image.shape
    return image[max(0, y):height + min(0, y), max(0, x):width + min(0, x)]


def _verdict(
    a: np.ndarray, b: np.ndarray, there: np.ndarray, back: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], float, bool]:
    """(trusted, failed, lost) of Motion, of halved frames and flows. A flow is wrong where the
    other does not undo it, or where the frame that it warps differs from the real one by half the
    contrast around; a change of light alone is neither."""
    at, seen_in_b = _ends(there)
    trusted_there = _undone(there, back, at)
    trusted = trusted_there, _undone(back, there, _ends(back)[0])
    texture = _texture(a)
    misfit = cv2.blur(np.abs(texture - _texture(looked_up(b, at))), (3, 3))
    contrast = cv2.blur(np.abs(texture), (5, 5))
    changes = seen_in_b & (cv2.blur(cv2.absdiff(a, b), (3, 3)) > CHANGED)
    wrong = ~trusted_there | (misfit > np.maximum(MISFIT * contrast, MISFITS))
    failed = float((wrong & changes).sum() / max(1, changes.sum()))
    return trusted, failed, failed > LOST and float(changes.mean()) > MUCH


def _ends(flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a halved flow, in whole pixels, leads on the halved frame; whether inside it."""
    at = cv2.scaleAdd(flow, 0.5, grid(flow.shape))
    return at, inside(at, flow.shape) > 0


def _undone(flow: np.ndarray, other: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Whether `other`, where a flow leads, leads back."""
    rest = flow + looked_up(other, at)
    return (length(rest) < APART_PX + APART * length(flow)) & (inside(at, flow.shape) > 0)


def _texture(image: np.ndarray) -> np.ndarray:
    return image - cv2.blur(image, (7, 7))

"""Motion between two frames: optical flow (OpenCV DIS) both ways, and where it can be trusted.

DIS finds motion of up to a few patches of its coarsest scale, about 20 pixels in fine or repetitive
textures. So it starts from a shift of the whole picture where that explains most of the change.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np

from evflow.process.threads import behind

PATCHES = 16  # pixels: two of DIS' patches
SMOOTHING = 2  # iterations of DIS' variational refinement: more are slower and no better
MOTION_QUANTILE = 99.5  # per cent: `speed` is this quantile of the pixels' motion
LEAST_SIDE = 8  # pixels of halved frames, shorter side: below, no shift is searched
SHIFTED_SIDE = 160  # to which halved frames are reduced for the search
BETTER = 0.9  # a shift is used if the difference falls below this share of that without
APART_PX, APART = 1.0, 0.05  # tolerance of forward against backward flow: pixels, share of motion
CHANGED, MISFITS = 5.0, 3.0  # codes: differences between frames above their noise
MISFIT = 0.5  # of the local contrast: residuals of correct flow are far below, of wrong flow above
# Flow is lost if LOST of the changing pixels, and these are MUCH of the picture, have wrong flow:
# so in a new scene, and where things turn by 30 degrees.
LOST, MUCH = 0.9, 0.4


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """Optical flow between frames a and b (H, W). there: (H, W, 2) float32 pixels (x, y) from a to
    b; back: from b to a; halves: both at half resolution, (h, w, 2); trusted: (h, w) bool on a and
    on b, where the two are consistent; failed: share of changing pixels, which stay in view, with
    wrong flow; lost: whether hardly anything of a is found in b, as at a cut."""

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
    """Flow from a to b and from b to a, starting from a shift; in parallel where OpenCV has one
    thread."""
    if cv2.getNumThreads() > 1:
        return _flow(a, b, x, y), _flow(b, a, -x, -y)
    back: list[np.ndarray] = []
    with behind(1) as later:
        later(lambda: back.append(_flow(b, a, -x, -y)))
        there = _flow(a, b, x, y)
    return there, back[0]


def _flow(a: np.ndarray, b: np.ndarray, x: float, y: float) -> np.ndarray:
    """Flow from a to b, starting from a shift. Uses a new OpenCV object, as one that was once given
    a shift returns different results without."""
    dis: Any = cv2.DISOpticalFlow_create(  # type: ignore[attr-defined]
        cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setVariationalRefinementIterations(SMOOTHING)
    found: np.ndarray = dis.calc(a, b, _even(a.shape, x, y) if x or y else None)
    return found


def halved(values: np.ndarray) -> np.ndarray:
    """Half the resolution, means of 2x2 pixels."""
    height, width = values.shape[:2]
    return cv2.resize(values, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)


def grid(shape: tuple[int, ...]) -> np.ndarray:
    """(H, W, 2) float32: position (x, y) of each pixel."""
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in shape[1::-1]))
    return np.stack([x, y], -1)


def inside(at: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) uint8, 255 where positions (H, W, 2) lie within a frame of `shape`, to half a pixel,
    else 0."""
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
    """(H, W): length of each vector of a flow (H, W, 2). Not cv2.magnitude, whose rounding depends
    on the memory address of its result."""
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
    """DN as 8-bit codes by the square root, so that dark textures count too."""
    return cv2.sqrt(np.maximum(frame, 0) * np.float32(255))


def _gray8(frame: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)


def _padded(image: np.ndarray) -> np.ndarray:
    """Padded to at least PATCHES pixels per side: DIS crashes on some narrower frames."""
    return np.pad(image, [(0, max(0, PATCHES - n)) for n in image.shape], mode="edge")


def _even(shape: tuple[int, ...], x: float, y: float) -> np.ndarray:
    """(H, W, 2) float32: constant flow; filled as pairs, which is ten times as fast."""
    return np.full(shape, complex(x, y), np.complex64).view(np.float32).reshape(*shape, 2)


def _shift(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Shift (x, y) in pixels from one halved frame to the other, by phase correlation; 0 unless it
    explains much of the difference."""
    pixel = 2
    if min(a.shape) < LEAST_SIDE:
        return 0.0, 0.0
    while min(a.shape) > SHIFTED_SIDE:
        a, b, pixel = halved(a), halved(b), 2 * pixel
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(a.copy(), b.copy(), window)  # modifies its arguments
    height, width = a.shape
    i, j = round(x), round(y)
    if i == j == 0 or max(abs(2 * i) - width, abs(2 * j) - height) > 0:
        return 0.0, 0.0
    rest = _overlap(b, i, j) - _overlap(a, -i, -j)
    if np.abs(rest).mean() >= BETTER * np.abs(_overlap(b, i, j) - _overlap(a, i, j)).mean():
        return 0.0, 0.0
    return pixel * x, pixel * y


def _overlap(image: np.ndarray, x: int, y: int) -> np.ndarray:
    """The part of an image that overlaps with one shifted by (x, y)."""
    height, width = image.shape
    return image[max(0, y):height + min(0, y), max(0, x):width + min(0, x)]


def _verdict(
    a: np.ndarray, b: np.ndarray, there: np.ndarray, back: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], float, bool]:
    """(trusted, failed, lost) of `Motion`, from halved frames and flows. Flow is wrong where the
    backward flow is inconsistent, or where the warped frame differs from the real one by half the
    local contrast; a change of light alone is neither."""
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
    """Target of a halved flow in whole pixels, and whether it is inside the frame."""
    at = cv2.scaleAdd(flow, 0.5, grid(flow.shape))
    return at, inside(at, flow.shape) > 0


def _undone(flow: np.ndarray, other: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Whether `other`, at the targets `at` of a flow, leads back."""
    rest = flow + looked_up(other, at)
    return (length(rest) < APART_PX + APART * length(flow)) & (inside(at, flow.shape) > 0)


def _texture(image: np.ndarray) -> np.ndarray:
    return image - cv2.blur(image, (7, 7))

"""Pictures that move by known amounts, at any time: what lies between the frames of a video."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import skimage.data
from scipy.ndimage import map_coordinates, spline_filter

from evflow.simulator.between import intervals
from evflow.simulator.motion import speed as speed_of
from evflow.types import Events

Pairs = Iterator[tuple[np.ndarray, int]]
Matrix = np.ndarray  # (2, 3), of pixels (x, y, 1) to those of the picture
SKIMAGE = ("camera", "coffee", "chelsea", "brick", "grass", "gravel", "rocket")
SIDE = 768  # pixels of a texture
FADES = 16  # mixtures per frame
PERIOD_US, PHASES = 33_333, 16  # of a frame
FINER = 16  # bins of a phase, of which the amplitudes are taken


@dataclasses.dataclass(frozen=True)
class Moving:
    """A picture (H, W) in DN seen under `view(u)`, u in frames, and perhaps an object before it:
    another picture, seen through a disc of `radius` that itself moves by `across(u)` pixels."""

    picture: np.ndarray
    view: Callable[[float], Matrix]
    object: np.ndarray | None = None
    across: Callable[[float], np.ndarray] | None = None
    radius: float = 0.0

    def frame(self, u: float, size: tuple[int, int]) -> np.ndarray:
        """The frame (H, W) at time u in DN, float32, of a size (width, height)."""
        seen = _seen(self.picture, self.view(u), size)
        if self.object is None or self.across is None:
            return seen
        (dx, dy), away = self.across(u), self.beyond(u, size)
        cover = np.clip(0.5 - away, 0, 1).astype(np.float32)
        shift = np.array([[1.0, 0, -dx], [0, 1, -dy]])
        return seen + cover * (_seen(self.object, shift, size) - seen)

    def swept(self, frames: int, size: tuple[int, int]) -> np.ndarray | None:
        """Pixels (H, W) over which the object's edge goes in so many frames; None without one."""
        if self.across is None:
            return None
        beyond = np.stack([self.beyond(u, size) for u in np.arange(0, frames - 0.9, 0.1)])
        return (beyond.min(0) <= 1) & (beyond.max(0) >= -1)

    def beyond(self, u: float, size: tuple[int, int]) -> np.ndarray:
        """How far each pixel lies outside of the object's edge (H, W); negative inside."""
        assert self.across is not None
        x, y = np.meshgrid(*map(np.arange, size))
        dx, dy = self.across(u)
        away: np.ndarray = np.hypot(x - dx - size[0] / 2, y - dy - size[1] / 2) - self.radius
        return away


def _seen(picture: np.ndarray, view: Matrix, size: tuple[int, int]) -> np.ndarray:
    """By cubic splines: exact to a fraction of a DN, and alike at every sub-pixel shift."""
    known = _coefficients(picture)
    if np.array_equal(view[:, :2], np.eye(2)):
        return np.clip(_shifted(known, float(view[0, 2]), float(view[1, 2]), size), 0, 255)
    x, y = np.meshgrid(*map(np.arange, size))
    at_x, at_y = (r[0] * x + r[1] * y + r[2] for r in view)
    seen = map_coordinates(known, [at_y, at_x], np.float32, order=3, mode="mirror", prefilter=False)
    return np.clip(seen, 0, 255)


def _shifted(known: np.ndarray, dx: float, dy: float, size: tuple[int, int]) -> np.ndarray:
    """What `map_coordinates` gives of a mere shift, whose weights are the same everywhere."""
    (i, fx), (j, fy) = ((math.floor(d), d - math.floor(d)) for d in (dx, dy))
    rows, columns = (_mirrored(np.arange(at - 1, at + n + 2), whole) for at, n, whole in zip(
        (j, i), size[::-1], known.shape, strict=True))
    part = known[np.ix_(rows, columns)]
    filtered = cv2.sepFilter2D(part, -1, _weights(fx), _weights(fy), anchor=(0, 0))
    return filtered[: size[1], : size[0]]


def _weights(f: float) -> np.ndarray:
    """Of four neighbours, a cubic B-spline's at the fraction f between the middle ones."""
    g = 1 - f
    return np.array([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], np.float32) / 6


def _mirrored(at: np.ndarray, whole: int) -> np.ndarray:
    at = np.abs(at) % (2 * whole - 2)
    return np.minimum(at, 2 * whole - 2 - at)


_KEPT: dict[int, tuple[np.ndarray, np.ndarray]] = {}


def _coefficients(picture: np.ndarray) -> np.ndarray:
    if id(picture) not in _KEPT:
        _KEPT[id(picture)] = picture, spline_filter(picture, 3, np.float32, "mirror")
    return _KEPT[id(picture)][1]


def photographs() -> dict[str, np.ndarray]:
    """Grey photographs in DN, float32, by name: scikit-image's that need no download, and those
    under EVFLOW_DATA where it is set."""
    found = {}
    for name in SKIMAGE:
        image = getattr(skimage.data, name)()
        found[name] = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    folder = Path(os.environ.get("EVFLOW_DATA", "/nowhere")) / "data/images"
    for path in sorted(folder.glob("*/*.jpg")) + sorted(folder.glob("*/images/*.jpg"))[:4]:
        found[path.stem] = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return {name: image.astype(np.float32) for name, image in found.items()}


def textures() -> dict[str, np.ndarray]:
    """Waves of 5 to 60 pixels; discs that cover each other, with edges of a pixel."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    waves = np.zeros((SIDE, SIDE), np.float32)
    for _ in range(40):
        angle, phase = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        wave = 5 * 12 ** rng.uniform()
        waves += np.sin(2 * np.pi * (np.cos(angle) * x + np.sin(angle) * y) / wave + phase)
    discs = np.full((SIDE, SIDE), 120.0, np.float32)
    for _ in range(900):
        cx, cy = rng.uniform(0, SIDE, 2)
        radius = 6 * 10 ** rng.uniform()
        cover = np.clip(radius - np.hypot(x - cx, y - cy) + 0.5, 0, 1)
        discs += cover * (np.float32(rng.uniform(15, 240)) - discs)
    return {"waves": 127.5 + 110 * np.tanh(waves / 6), "discs": discs}


@functools.cache
def pictures() -> dict[str, np.ndarray]:
    """`photographs` and `textures`."""
    return photographs() | textures()


def moving(motion: str, picture: str, speed: float, size: tuple[int, int]) -> Moving:
    """A scene by the name of its motion. pan, hand, turn, object, crossing: at pixels per frame;
    rotation: at degrees, zoom: at per cent per frame. crossing: the object's background goes the
    other way, half as fast."""
    shown = pictures()[picture]
    if motion in ("object", "crossing"):
        other = pictures()["chelsea" if picture == "camera" else "camera"]
        step = speed * np.array([1, 1 / 6])
        view = pan(speed / 2) if motion == "crossing" else pan(0.0)
        return Moving(shown, view, other, lambda u: (u - 4) * step, size[1] / 4)
    rate = speed / (min(size) / 2)
    views = {"pan": pan(speed), "hand": hand(speed), "turn": turn(rate, -0.4 * rate, size),
             "rotation": turn(math.radians(speed), 0.0, size),
             "zoom": turn(0.0, -math.log1p(speed / 100), size)}
    return Moving(shown, views[motion])


def pan(speed: float) -> Callable[[float], Matrix]:
    """A constant velocity in pixels per frame, a sixth of it downwards."""
    step = speed * np.array([1, 1 / 6]) / np.hypot(1, 1 / 6)
    return lambda u: np.array([[1, 0, u * step[0]], [0, 1, u * step[1]]])


def hand(speed: float) -> Callable[[float], Matrix]:
    """A camera held by hand: two sines and their velocity's root mean square."""
    rates = 2 * np.pi * np.array([[1 / 13, 1 / 5.3], [1 / 9, 1 / 6.1]])  # of x and y, per frame
    swing = speed / rates / np.sqrt([[1.0, 4.0], [2.0, 4.0]])

    def view(u: float) -> Matrix:
        shift = (swing * np.sin(rates * u + [[0.3, 1.1], [2.0, 0.7]])).sum(1)
        return np.column_stack([np.eye(2), shift])

    return view


def turn(angle: float, growth: float, size: tuple[int, int]) -> Callable[[float], Matrix]:
    """Rotation about the middle by radians per frame, and the logarithm by which steps across the
    picture grow."""
    middle = np.array(size) / 2

    def view(u: float) -> Matrix:
        grown = np.exp(growth * u)
        c, s = grown * np.cos(angle * u), grown * np.sin(angle * u)
        turned = np.array([[c, -s], [s, c]])
        return np.column_stack([turned, middle - turned @ middle])

    return view


def video(moving: Moving, frames: int, size: tuple[int, int], dense: int) -> Pairs:
    """Frames 0, 1 / dense, ... frames - 1 (H, W) and their times in us."""
    for k in range((frames - 1) * dense + 1):
        yield moving.frame(k / dense, size), round(k * PERIOD_US / dense)


def faded(pairs: Iterable[tuple[np.ndarray, int]]) -> Pairs:
    """A video (frame, us) filled up by mixtures of neighbours."""
    for (a, t0), (b, t1) in itertools.pairwise(pairs):
        for k in range(FADES):
            s = k / FADES
            yield ((1 - s) * a + s * b).astype(np.float32), round(t0 + s * (t1 - t0))
    yield b.astype(np.float32), t1


def bilinear(pairs: Iterable[tuple[np.ndarray, int]]) -> Pairs:
    """A video (frame, us) filled up in steps of a pixel along straight paths, warped bilinearly."""
    for i in intervals((frame.astype(np.float32), t) for frame, t in pairs):
        steps = max(1, math.ceil(speed_of(i.motion.there)))
        shares = np.arange(1, steps) / steps
        straight = dataclasses.replace(i, bends=None).at(shares, sharp=False)
        times = np.round(i.a.time + shares * (i.b.time - i.a.time)).astype(int)
        yield i.a.dn, i.a.time
        yield from zip(straight, times.tolist(), strict=True)
    yield i.b.dn, i.b.time


WAYS = {"fade": faded, "bilinear": bilinear}


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """What `scores` asks of events. counts (2, H, W) by polarity; rate by phase over its mean, from
    the second frame on; waves: amplitudes at the frame rate and its double."""

    number: int
    counts: np.ndarray
    rate: np.ndarray
    waves: np.ndarray


def seen(events: Events) -> Seen:
    phase = events.t[events.t >= PERIOD_US] % PERIOD_US / PERIOD_US
    rate, edges = np.histogram(phase, PHASES * FINER, (0, 1))
    middles = (edges[1:] + edges[:-1]) / 2
    waves = [2 * (np.exp(2j * np.pi * k * middles) * rate).sum() / rate.sum() for k in (1, 2)]
    rate = rate.reshape(PHASES, FINER).sum(1)
    return Seen(len(events), events.count_map(), rate / rate.mean(), np.array(waves))


def scores(made: Seen, truth: Seen, swept: np.ndarray | None = None) -> dict[str, float]:
    """Share of events, also of those where `swept` (H, W); rate by phase; combs in per cent;
    correlation of counts."""
    ratio, comb = made.rate / truth.rate, 100 * np.abs(made.waves - truth.waves)
    found = {"share": made.number / truth.number, "least": float(ratio.min()),
             "most": float(ratio.max()), "at_rate": float(comb[0]), "at_double": float(comb[1]),
             "r": float(np.corrcoef(made.counts.ravel(), truth.counts.ravel())[0, 1])}
    return found if swept is None else {
        **found, "swept": float(made.counts[:, swept].sum() / truth.counts[:, swept].sum())}

"""The asynchronous Kalman filter against a plain float64 loop over events."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from evflow.baselines.akf import Akf, since_last
from evflow.baselines.integration import Integration
from evflow.camera import Camera
from evflow.errors import EvflowDataError
from evflow.light.logarithm import Logarithm
from evflow.types import Events

SIZE = (6, 5)  # width, height
T0 = 1_643_243_628_737_093


def stream(seed: int, n: int = 400, span: int = 90_000) -> Events:
    """Random events, a quarter of them of one pixel, several at an instant."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, SIZE[0], n), rng.integers(0, SIZE[1], n)
    x[::4], y[::4] = 2, 2
    t = T0 + np.sort(rng.integers(0, span, n) // 50 * 50)
    return Events(x, y, t, rng.integers(0, 2, n), SIZE)


def camera(seed: int) -> Camera:
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.05, 0.4, (2, SIZE[1], SIZE[0])).astype(np.float32)
    return Camera(jnp.asarray(theta[0]), jnp.asarray(theta[1]), *jnp.zeros((2, SIZE[1], SIZE[0])))


def shown(seed: int, count: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Frames that use the whole range, and their times among the events."""
    frames = np.random.default_rng(seed).integers(0, 256, (count, SIZE[1], SIZE[0]), np.uint8)
    return frames, T0 + 10_000 + 20_000 * np.arange(count)


def log64(dn: float, offset: float) -> float:
    if offset:
        return float(np.log(dn + offset))
    return float(np.log(dn)) if dn > 20 else dn * np.log(20) / 20


def dn64(log: float, offset: float) -> float:
    if offset:
        return float(np.exp(log) - offset)
    return float(np.exp(log)) if log > np.log(20) else log * 20 / np.log(20)


def trust64(dn: float, offset: float) -> float:
    slope = 1 / (dn + offset) if offset else (1 / dn if dn > 20 else np.log(20) / 20)
    return 7e5 * max(1 - abs(2 * dn / 255 - 1) ** 6, 0.09) / (255 * slope) ** 2


@dataclasses.dataclass
class Slow:
    """One pixel, update by update: its frames (K,) and their times, its events {number: step}."""

    frames: list[float]
    frame_times: list[int]
    step: dict[int, float]
    t_us: list[int]
    between: bool
    offset: float

    def __post_init__(self) -> None:
        self.x, self.variance, self.since = log64(127.5, self.offset), 0.09, 0.0
        self.last, self.frame = 0, -1

    def reference(self, now: int) -> tuple[float, float]:
        if self.frame < 0:
            return 0.0, 0.0
        here, offset = self.frames[self.frame], self.offset
        forward, trust = log64(here, offset), trust64(here, offset)
        if not self.between or self.frame + 1 == len(self.frames):
            return forward + self.since, trust
        then = self.frames[self.frame + 1]
        begin, end = self.frame_times[self.frame:self.frame + 2]
        total = sum(s for i, s in self.step.items() if begin < self.t_us[i] <= end)
        change = log64(then, offset) - forward
        ratio = total / change if change else 0.0
        gain = 1 / ratio if 0.6 < ratio < 100 else 1.0
        share = (now - begin) / (end - begin)
        ahead = dn64(forward + gain * self.since, offset)
        back = dn64(log64(then, offset) - gain * (total - self.since), offset)
        return (log64((1 - share) * ahead + share * back, offset),
                (1 - share) * trust + share * trust64(then, offset))

    def relaxed(self, now: int) -> tuple[float, float]:
        dt = (now - self.last) * 1e-6
        y, trust = self.reference(now)
        inverse = 1 / self.variance + trust * dt
        return (self.x - y) / self.variance / inverse + y, 1 / inverse + 0.005 * dt

    def take_frame(self, now: int, number: int) -> None:
        self.x, self.variance = self.relaxed(now)
        self.last, self.frame, self.since = now, number, 0.0
        if number == 0:
            self.x, self.variance = log64(self.frames[0], self.offset), 0.09

    def take_event(self, now: int, number: int, variance: float) -> None:
        self.x, self.variance = self.relaxed(now)
        self.last = now
        self.x, self.since = self.x + self.step[number], self.since + self.step[number]
        self.variance += variance


def event_variance(events: Events, i: int) -> float:
    """Q of an event, by a search through all before it."""
    x, y, t = (a.astype(int) for a in (events.x, events.y, events.t))
    if not (0 < x[i] < SIZE[0] - 1 and 0 < y[i] < SIZE[1] - 1):
        return 10.0
    near = [k for k in range(i) if abs(x[k] - x[i]) < 2 and abs(y[k] - y[i]) < 2]
    same = [t[k] for k in near if x[k] == x[i] and y[k] == y[i]]
    isolated = 0.03e-6 * (t[i] - t[max(near, default=0)])
    own = t[i] - max(same) if same else 10**9
    return float(isolated + (0.05e-6 * own if own <= 10_000 else 0.0))


def loop(
    events: Events, frames: np.ndarray, frame_times: np.ndarray, eye: Camera, times: np.ndarray,
    *, between: bool, offset: float,
) -> np.ndarray:
    out, t_us = np.zeros((len(times), SIZE[1], SIZE[0])), events.t.tolist()
    for v, u in np.ndindex(SIZE[1], SIZE[0]):
        theta = (-float(eye.theta_off[v, u]), float(eye.theta_on[v, u]))
        mine = np.flatnonzero((events.x == u) & (events.y == v)).tolist()
        slow = Slow(frames[:, v, u].astype(float).tolist(), frame_times.tolist(),
                    {i: theta[int(events.p[i])] for i in mine}, t_us, between, offset)
        todo = [(t_us[i], 0, i) for i in mine]
        todo += [(int(t), 1, k) for k, t in enumerate(times)]
        todo += [(int(t), 2, k) for k, t in enumerate(frame_times)]
        for now, kind, i in sorted(todo):
            if kind == 0:
                slow.take_event(now, i, event_variance(events, i))
            elif kind == 1:
                out[i, v, u] = slow.relaxed(now)[0]
            else:
                slow.take_frame(now, i)
    return out


@pytest.mark.parametrize("offset", [0.0, 255.0])
@pytest.mark.parametrize("reference", ["between", "latest"])
def test_equals_a_loop_in_float64(reference: str, offset: float) -> None:
    events, (frames, frame_times), eye = stream(0), shown(1), camera(2)
    times = T0 + np.array([0, 9_000, 10_000, 10_001, 30_000, 30_000, 44_444, 70_000, 85_000])
    akf = Akf(logarithm=Logarithm(offset, "log" if offset else "linlog"), reference=reference)
    found = akf.log_images(events, frames, frame_times, eye, times)
    expected = loop(events, frames, frame_times, eye, times,
                    between=reference == "between", offset=offset)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_looking_changes_nothing() -> None:
    events, (frames, frame_times), eye = stream(3), shown(4), camera(5)
    few, many = np.array([T0 + 65_000]), T0 + np.arange(11_000, 65_001, 3_000)
    once = Akf().log_images(events, frames, frame_times, eye, few)
    often = Akf().log_images(events, frames, frame_times, eye, many)
    np.testing.assert_allclose(once[-1], often[-1], rtol=0, atol=1e-6)


def test_without_frames_and_without_trust_it_integrates() -> None:
    events, (frames, frame_times), eye = stream(6), shown(7), camera(8)
    times = T0 + np.array([20_000, 25_000])
    for given, at in ((frames[:0], frame_times[:0]), (frames[:1], frame_times[:1])):
        akf = Akf(trust=0.0).log_images(events, given, at, eye, times)
        plain = Integration().log_images(events, given, at, eye, times)
        np.testing.assert_allclose(akf, plain, rtol=0, atol=1e-5)


def test_between_frames_it_reaches_the_next_one_and_latest_does_not_know_it() -> None:
    events, (frames, frame_times), eye = stream(9), shown(10), camera(11)
    frames = np.clip(frames, 30, 220)
    sure = {"trust": 1e7}
    frame_times = frame_times + 10  # apart from events, which count in full at their own instant
    end = frame_times[2:3]
    reached = Akf(**sure).reconstruct(events, frames, frame_times, eye, end)
    np.testing.assert_allclose(reached[0], frames[2], rtol=0, atol=0.5)
    latest = Akf(reference="latest", **sure)
    other = frames.copy()
    other[2:] = 99
    np.testing.assert_array_equal(latest.reconstruct(events, frames, frame_times, eye, end),
                                  latest.reconstruct(events, other, frame_times, eye, end))


def test_since_last_sees_the_pixels_around() -> None:
    events = Events([2, 3, 5, 2], [2, 3, 0, 2], T0 + np.array([0, 100, 250, 400]),
                    [1, 0, 1, 1], SIZE)
    near, own = since_last(events)
    np.testing.assert_allclose(near, [0, 100e-6, 250e-6, 300e-6])
    np.testing.assert_allclose(own, [np.inf, np.inf, np.inf, 400e-6])


def test_refuses_what_does_not_fit() -> None:
    events, (frames, frame_times), eye = stream(12), shown(13), camera(14)
    silent = Events([], [], np.zeros(0, np.int64), [], SIZE)
    held = Akf().reconstruct(silent, frames, frame_times, eye, frame_times[1:] - 1)
    assert np.isfinite(held).all()
    for bad, code in (({"frames": frames[:, :3]}, "EV015"), ({"frames": frames[:2]}, "EV002"),
                      ({"camera": Camera.constant((3, 3))}, "EV015"),
                      ({"frames": frames.astype(np.uint16)}, "EV003"),
                      ({"times": frame_times[::-1]}, "EV004")):
        good = {"frames": frames, "frame_times": frame_times, "camera": eye, "times": frame_times}
        with pytest.raises(EvflowDataError, match=code):
            Akf().reconstruct(events, **(good | bad))

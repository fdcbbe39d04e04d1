"""Events of noise-free videos: exact times, conserved contrast, any chunking, dead times."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.recordings import equal
from helpers.videos import SHAPE, by_pixel, drifting, milliseconds

from evflow.camera import Camera, CameraPrior
from evflow.camera.sensors import SensorModel
from evflow.light.log_maps import LOG_MAPS, to_log
from evflow.simulator import active, circuits, pack, simulate, simulate_stream
from evflow.simulator.active import step_still
from evflow.simulator.spikes import floor_divide
from evflow.types import Events

KEY = jax.random.key(0)
MISMATCH = CameraPrior(theta=(0.15, 0.3), mismatch=(0.05, 0.05), noise="none")
QUIET = Camera.sample(jax.random.key(1), SHAPE, MISMATCH)
NOISY = dataclasses.replace(QUIET, eta_on=QUIET.eta_on + 20.0, eta_off=QUIET.eta_off + 10.0)
EVERYTHING = SensorModel(cutoff_hz=200.0, refractory_s=5e-4, leak_hz=5.0, leak_jitter=0.2,
                         leak_fpn_decades=0.2, shot_hz=20.0, eta_intensity=True,
                         noise_resets_memory=True)
V2E = dataclasses.replace(EVERYTHING, timestamps="v2e")


@pytest.mark.parametrize("model", [SensorModel(), EVERYTHING, V2E])
def test_events_are_sorted_integers_inside_the_video(model: SensorModel) -> None:
    frames = drifting(40)
    events = simulate(KEY, frames, milliseconds(40, 500), NOISY, model=model)
    assert len(events) > 1000
    checked = Events(events.x, events.y, events.t, events.p, (SHAPE[1], SHAPE[0]))  # raises if not
    equal(checked, events)
    assert (events.t.dtype, events.x.dtype, events.p.dtype) == (np.int64, np.uint16, bool)
    assert events.size == (SHAPE[1], SHAPE[0])
    assert events.t[0] > 500
    assert events.t[-1] <= 39_500
    assert 0.2 < events.p.mean() < 0.8


@pytest.mark.parametrize("model", [SensorModel(), EVERYTHING, V2E])
@pytest.mark.parametrize("start", [10_000_000, -7, 1_643_243_628_737_093])
def test_the_clock_may_start_anywhere(model: SensorModel, start: int) -> None:
    frames = drifting(40)
    events = simulate(KEY, frames, milliseconds(40), NOISY, model=model)
    later = simulate(KEY, frames, milliseconds(40, start), NOISY, model=model)
    equal(later, dataclasses.replace(events, t=events.t + start))


@pytest.mark.parametrize("model", [SensorModel(), EVERYTHING, V2E])
def test_keys_of_32_and_of_64_bits_are_the_same_events(
    monkeypatch: pytest.MonkeyPatch, model: SensorModel
) -> None:
    frames, times = drifting(20), milliseconds(20, 500)
    assert pack.Keys.of(frames[0].size, 8 * 500).dtype is np.uint32
    short = simulate(KEY, frames, times, NOISY, model=model)
    monkeypatch.setattr(pack.Keys, "of", lambda pixels, _: pack.Keys(
        (pixels - 1).bit_length(), np.uint64))
    equal(simulate(KEY, frames, times, NOISY, model=model), short)


@pytest.mark.parametrize("length", [200, 2_047, 30_000, 524_287, 3_000_000])
def test_events_of_any_block_are_sorted(length: int) -> None:
    """By time, OFF before ON, noise after signal, pixel: keys of 32 bits, and of 64 in halves and
    whole."""
    rng, pixels = np.random.default_rng(length), 640 * 480
    keys = pack.Keys.of(pixels, length)
    t, on, noise = rng.integers(1, length + 1, 2_000), *rng.integers(0, 2, (2, 2_000))
    pixel = rng.permutation(pixels)[:2_000]
    at = np.lexsort((pixel, noise, on, t))
    parts = np.split(keys((t << 2) + 2 * on + noise, pixel), [3, 1_500])
    events, labels = pack.sort(keys, parts, 7, (480, 640))
    for found, right in ((events.t - 7, t), (events.p, on), (labels, noise),
                         (events.y.astype(int) * 640 + events.x, pixel)):
        np.testing.assert_array_equal(found, right[at])


@pytest.mark.parametrize("model", [EVERYTHING, V2E])
def test_one_key_gives_the_same_bytes_for_any_chunking(model: SensorModel) -> None:
    """70 frames are no multiple of a block (8), so padding is met too."""
    frames, times = drifting(70), milliseconds(70)
    whole = simulate(KEY, frames, times, NOISY, model=model)
    for length in (1, 7, 33):
        cuts = range(0, 70, length)
        blocks = simulate_stream(KEY, (frames[i : i + length] for i in cuts),
                                 (times[i : i + length] for i in cuts), NOISY, model=model)
        equal(Events.concatenate(list(blocks)), whole)
    single = simulate_stream(KEY, iter(frames), iter(times.tolist()), NOISY, model=model)
    equal(Events.concatenate(list(single)), whole)
    other = simulate(jax.random.key(9), frames, times, NOISY, model=model)
    assert not np.array_equal(other.t, whole.t)


def test_chunks_are_consecutive_and_the_future_changes_nothing() -> None:
    frames, times = drifting(70), milliseconds(70)
    chunks = list(simulate_stream(KEY, [frames], [times], NOISY, model=EVERYTHING))
    assert len(chunks) == 9
    for i, (one, two) in enumerate(itertools.pairwise(chunks), 1):
        assert one.t[-1] <= 8_000 * i < two.t[0]
    first = simulate(KEY, frames[:41], times[:41], NOISY, model=EVERYTHING)
    equal(first, Events.concatenate(chunks).slice(0, 40_001))


def test_streams_are_lazy() -> None:
    """The first events come out after a few blocks, of a video that never ends."""
    def forever() -> itertools.count:
        return itertools.cycle(drifting(8))

    stream = simulate_stream(KEY, forever(), itertools.count(0, 1000), QUIET)
    assert next(stream).t[-1] <= 8_000
    assert next(stream).t[0] > 8_000


@pytest.mark.parametrize("model", [SensorModel(), SensorModel(refractory_s=1e-3)])
def test_frames_may_be_hours_apart(model: SensorModel) -> None:
    """The same crossings as in milliseconds, at times to the hour's fraction."""
    frames = drifting(12)
    fast = simulate(KEY, frames, 1_000_000 * np.arange(12), QUIET, model=model)
    slow = simulate(KEY, frames, 3600 * 1_000_000 * np.arange(12), QUIET, model=model)
    np.testing.assert_array_equal(slow.count_map(), fast.count_map())
    assert np.abs(np.sort(slow.t) / 3600 - fast.t).max() < 2.0


def test_keys_matter_only_where_something_is_random() -> None:
    first, second = (simulate(jax.random.key(k), drifting(40), milliseconds(40), QUIET)
                     for k in (0, 1))
    equal(first, second)


@pytest.mark.parametrize("model", [
    SensorModel(), SensorModel(refractory_s=3e-3), SensorModel(leak_hz=20.0), EVERYTHING,
    SensorModel(kind="esim", refractory_s=1e-3), SensorModel(leak_hz=50.0, leak_jitter=2.0),
    SensorModel(log_map="log_eps"), SensorModel(shot_hz=50.0, eta_intensity=True)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_pixels_that_are_passed_over_have_nothing_to_send(
    model: SensorModel, dtype: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bytes where every pixel is stepped; and most of a quiet scene is passed over."""
    frames, times = drifting(40).astype(dtype), milliseconds(40)
    active_ones = simulate(KEY, frames, times, NOISY, model=model)
    pieces, shares = circuits._Thresholds.pieces, []

    def all_pieces(pixels: circuits._Thresholds, at: np.ndarray, block: active.Block) -> Any:
        shares.append(len(at) / frames[0].size)
        return pieces(pixels, np.arange(frames[0].size), block)

    monkeypatch.setattr(circuits._Thresholds, "pieces", all_pieces)
    equal(active_ones, simulate(KEY, frames, times, NOISY, model=model))
    still = np.broadcast_to(frames[:1], frames.shape)
    shares.clear()
    assert len(simulate(KEY, still, times, QUIET, model=SensorModel())) == 0
    assert max(shares) == 0


def test_a_source_may_write_over_its_last_frames() -> None:
    frames, times = drifting(30), milliseconds(30)

    def live(length: int) -> Iterator[np.ndarray]:
        buffer = np.empty_like(frames[:length])
        for i in range(0, 30, length):
            buffer[:] = frames[i : i + length]
            yield buffer

    for length in (1, 3, 10):
        stamps = times.reshape(-1, length)
        equal(simulate(KEY, frames, times, NOISY), Events.concatenate(
            list(simulate_stream(KEY, live(length), stamps, NOISY))))


def test_events_of_very_long_intervals_stay_in_them() -> None:
    """Half a minute is more microseconds than float32 can count."""
    edges = np.cumsum([0, 33_554_435, 40_000_001, 1])
    frames = drifting(4, speed=3.0)
    for model in (SensorModel(), SensorModel(timestamps="v2e")):
        events = simulate(KEY, frames, edges, QUIET, model=model)
        assert len(events) > 200
        parts = [simulate(KEY, frames[:n], edges[:n], QUIET, model=model) for n in (2, 3)]
        assert all(part.t[-1] <= edge for part, edge in zip(parts, edges[1:], strict=False))
        equal(events.slice(0, int(edges[1]) + 1), parts[0])
        equal(events.slice(0, int(edges[2]) + 1), parts[1])


def test_a_slot_at_a_frame_is_not_after_it() -> None:
    """With one event per pixel and interval, v2e's only slot is the frame itself. The lengths are
    such that float32 rounds them up, by 1 and 3 us."""
    edges = np.cumsum([7, 20_000_003, 100_000_005, 60_000_001])
    frames = np.array([50, 65, 50, 65], np.uint8)[:, None, None] * np.ones(SHAPE, np.uint8)
    events = simulate(KEY, frames, edges, Camera.constant(SHAPE, 0.2, 0.15),
                      model=SensorModel(timestamps="v2e"))
    times, count = np.unique(events.t, return_counts=True)
    assert (count == SHAPE[0] * SHAPE[1]).all()
    assert (times <= edges[1:]).all()
    assert (edges[1:] - times <= 1).all()


def test_video_length_does_not_recompile() -> None:
    simulate(KEY, drifting(5), milliseconds(5), QUIET)
    before = step_still._cache_size()
    for count in (3, 40, 70):
        simulate(KEY, drifting(count), milliseconds(count), Camera.constant(SHAPE, 0.3, 0.4))
    assert step_still._cache_size() == before


def ramps(edges: np.ndarray, log_map: str) -> tuple[np.ndarray, np.ndarray]:
    """Log-linear videos, one slope per pixel (log units per us), up and down; frames at `edges`."""
    rates = np.linspace(0.4, 2.4, SHAPE[0] * SHAPE[1]) / float(edges[-1] - edges[0])
    slope = (rates * np.where(np.arange(rates.size) % 2, 1.0, -1.0)).reshape(SHAPE)
    there, back = LOG_MAPS[log_map]
    low, high = (float(there(jnp.float32(dn))) for dn in (21.0, 250.0))
    log = np.where(slope > 0, low, high) + slope * (edges - edges[0])[:, None, None]
    return np.asarray(back(jnp.asarray(log, jnp.float32))), slope


IRREGULAR = np.cumsum([3, 900, 1, 4_000, 17, 12_000, 20_000, 250, 6_000])


@pytest.mark.parametrize("log_map", ["linlog", "log_eps"])
@pytest.mark.parametrize("edges", [IRREGULAR, np.array([0, 50_000]), 5_000 * np.arange(11)])
def test_crossing_times_are_exact_on_a_log_ramp(edges: np.ndarray, log_map: str) -> None:
    """The k-th event of a pixel falls at k theta / slope, rounded up to the next microsecond."""
    frames, slope = ramps(edges, log_map)
    events = simulate(KEY, frames, edges, QUIET, model=SensorModel(log_map=log_map))
    pixel, t, p = by_pixel(events)
    theta = np.where(slope > 0, QUIET.theta_on, QUIET.theta_off).astype(float)
    total = np.abs(slope) * (edges[-1] - edges[0]) / theta
    counts = np.bincount(pixel, minlength=slope.size)
    assert (np.abs(counts - total.ravel() + 0.5) <= 0.5 + 1e-3).all()
    np.testing.assert_array_equal(p, slope.ravel()[pixel] > 0)
    k = np.arange(len(t)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    expected = edges[0] + k * (theta / np.abs(slope)).ravel()[pixel]
    assert (t - expected).min() > -0.5
    assert (t - expected).max() < 1.5


@pytest.mark.parametrize("camera", [QUIET, Camera.constant(SHAPE, 0.5, 0.1)])
@pytest.mark.parametrize("model", [SensorModel(), SensorModel(timestamps="v2e"),
                                   SensorModel(log_map="log_eps")])
def test_signal_events_conserve_contrast(model: SensorModel, camera: Camera) -> None:
    """theta_on N_on - theta_off N_off is the change of log intensity, to within one threshold."""
    frames = drifting(40)
    on, off = simulate(KEY, frames, milliseconds(40), camera, model=model).count_map()
    assert min(on.sum(), off.sum()) > 500
    log = np.asarray(to_log(frames, model.log_map), np.float64)
    theta_on, theta_off = np.asarray(camera.theta_on), np.asarray(camera.theta_off)
    rest = log[-1] - log[0] - (on * theta_on - off * theta_off)
    assert (rest < theta_on + 1e-4).all()
    assert (rest > -theta_off - 1e-4).all()


@pytest.mark.parametrize("model", [SensorModel(), SensorModel(timestamps="v2e"),
                                   SensorModel(cutoff_hz=30.0, refractory_s=1e-3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_silent_camera_sees_nothing_in_a_still_scene(model: SensorModel, dtype: type) -> None:
    still = np.repeat(drifting(1).astype(dtype), 30, axis=0)
    events = simulate(KEY, still, milliseconds(30), QUIET, model=model)
    assert len(events) == 0
    assert events.size == (SHAPE[1], SHAPE[0])


@pytest.mark.parametrize("period_us", [400, 2_500])
def test_refractory_pixels_wait_and_lose_no_contrast(period_us: int) -> None:
    """Frames 1 ms apart, then 0.2 s of stillness in which what is pending may fire."""
    frames = np.concatenate([drifting(40), np.repeat(drifting(40)[-1:], 20, axis=0)])
    times = np.concatenate([milliseconds(40), 39_000 + 10_000 * np.arange(1, 21)])
    camera = Camera.constant(SHAPE, 0.06, 0.06)
    free = simulate(KEY, frames, times, camera)
    pixel, t, _ = by_pixel(free)
    assert (np.diff(t)[np.diff(pixel) == 0] < period_us - 1).mean() > 0.2
    events = simulate(KEY, frames, times, camera, model=SensorModel(refractory_s=period_us * 1e-6))
    pixel, t, _ = by_pixel(events)
    gaps = np.diff(t)[np.diff(pixel) == 0]
    assert gaps.min() >= period_us - 1  # both ends are rounded up to a microsecond
    assert (gaps <= period_us + 1).sum() > 100
    assert len(events) < len(free)
    on, off = events.count_map().astype(int)
    log = np.asarray(to_log(frames), np.float64)
    rest = log[-1] - log[0] - 0.06 * (on - off)
    assert np.abs(rest).max() < 0.06 + 1e-4


def test_refractory_ramps_fire_as_soon_as_they_may() -> None:
    """One polarity: t_k = max(s_k, t_(k-1) + r), s_k being when the free pixel fires."""
    edges = np.array([0, 4_000, 9_000, 50_000, 400_000])
    frames, _ = ramps(edges[:4], "linlog")
    frames = np.concatenate([frames, frames[-1:]])
    free = simulate(KEY, frames, edges, QUIET)
    late = simulate(KEY, frames, edges, QUIET, model=SensorModel(refractory_s=6e-3))
    np.testing.assert_array_equal(late.count_map(), free.count_map())
    (pixel, expected, _), (_, t_late, _) = by_pixel(free), by_pixel(late)
    assert (t_late - expected).max() > 6_000
    for k in np.flatnonzero(np.diff(pixel) == 0) + 1:
        expected[k] = max(expected[k], expected[k - 1] + 6_000)
    np.testing.assert_allclose(t_late, expected, atol=1)  # us; chains of up to 34 events


@pytest.mark.parametrize(("by_light", "low", "high", "share"), [
    (True, 20.0, 255.0, 1.0), (True, 25.0, 62.0, 82 / 275), (False, 25.0, 62.0, 1.0)])
def test_low_pass_follows_its_difference_equation(
    by_light: bool, low: float, high: float, share: float
) -> None:
    """A step through the filter (fc = 40 Hz at 255 DN, or at all) against the recursion."""
    dt, count = 1e-3, 40
    frames = np.full((count, *SHAPE), high, np.float32)
    frames[0] = low
    theta = 0.01  # a coarse one would hide a corner that is off by a twentieth
    camera = Camera.constant(SHAPE, theta, theta)
    model = SensorModel(cutoff_hz=40.0, cutoff_by_light=by_light)
    events = simulate(KEY, frames, milliseconds(count), camera, model=model)
    eps, step = share * 2 * np.pi * 40 * dt, np.log(high / low)
    lp = np.log(low) + step * (1 - (1 - eps) ** np.arange(count))
    level = np.floor((lp - lp[0]) / theta)
    seen = np.histogram(events.t, milliseconds(count) + 1)[0] / np.prod(SHAPE)
    assert np.abs(np.cumsum(seen) - level[1:]).max() <= 1
    assert seen.sum() == pytest.approx((lp[-1] - lp[0]) / theta, abs=1.01)
    assert seen[0] == pytest.approx(eps * step / theta, abs=1.01)


def test_floor_division_is_exact_but_for_ties() -> None:
    """floor(a/theta) everywhere; at a = round(k theta) it may also be k (the exact quotient of
    the rounded product is often a hair below k, and XLA may or may not fuse the remainder)."""
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.01, 0.6, 50_000).astype(np.float32)
    k = rng.integers(0, 200, 50_000)
    part = rng.uniform(1e-4, 1 - 1e-4, 50_000)
    a = ((k + part) * theta.astype(float)).astype(np.float32)
    np.testing.assert_array_equal(floor_divide(jnp.asarray(a), jnp.asarray(theta)), k)
    tie = k.astype(np.float32) * theta
    at_tie = np.asarray(floor_divide(jnp.asarray(tie), jnp.asarray(theta)))
    assert ((at_tie == np.floor_divide(tie, theta)) | (at_tie == k)).all()


@pytest.mark.parametrize("step_us", [60_000_000, 7_200_000_000])
@pytest.mark.parametrize(("model", "dtype"), [
    (SensorModel(), np.float32), (SensorModel(), np.uint8), (SensorModel(kind="esim"), np.float32),
    (SensorModel(noise_resets_memory=True), np.uint8)])
def test_frames_far_apart_have_times_exact_to_the_microsecond(
    step_us: int, model: SensorModel, dtype: type
) -> None:
    """Against crossings worked out in float64, pixel by pixel; more than a block of frames, of
    which a few in the middle are near each other."""
    frames = drifting(20, speed=0.3).astype(dtype)
    steps = np.full(19, step_us)
    steps[9:12] = 1000
    times = 5 + np.concatenate([[0], np.cumsum(steps)])
    thresholds = [float(np.float32(v)) for v in (0.25, 0.1875)]  # exact in few bits: no ties
    events = simulate(jax.random.key(0), frames, times, Camera.constant(SHAPE, *thresholds),
                      model=model)
    dn = frames.astype(np.float64)
    logs = (np.log(dn / 255 + 1e-3) if model.kind == "esim" else
            np.where(dn <= 20, dn * np.log(20) / 20, np.log(np.maximum(dn, 1))))
    pixel, t, _ = by_pixel(events)
    checked = 0
    for at in range(0, SHAPE[0] * SHAPE[1], 7):
        series, expected = logs.reshape(20, -1)[:, at], []
        memory = series[0]
        for i in range(19):
            theta = thresholds[0] if series[i + 1] > memory else -thresholds[1]
            for _ in range(int((series[i + 1] - memory) / theta)):
                memory += theta
                share = (memory - series[i]) / (series[i + 1] - series[i])
                expected.append(times[i] + np.clip(np.ceil(share * steps[i]), 1, steps[i]))
        ours = t[pixel == at]
        assert len(ours) == len(expected)
        assert np.abs(ours - np.array(expected)).max(initial=0) <= 1
        checked += len(ours)
    assert checked > 100

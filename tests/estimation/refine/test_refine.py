"""Refinement by simulation: recorded and simulated traces agree where they must, sums add, and
the thresholds of a known path come back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from evflow import Recording, simulate
from evflow.camera import Camera, CameraPrior, Summary
from evflow.estimation.front_end import FrontEnd
from evflow.estimation.reading import ordered
from evflow.estimation.refine import (
    cut,
    make_chunk,
    pixel_posterior,
    plan_runs,
    refinement_chunks,
    stretches,
)
from evflow.estimation.refine.bounds import ERROR, EXCESS, NOTHING, bounded
from evflow.estimation.refine.moments import measure
from evflow.estimation.refine.pixels import PixelEvidence, pixel_evidence
from evflow.estimation.refine.stretches import plan_chunks
from evflow.estimation.refine.trace import (
    FRESH,
    NEVER,
    draw,
    trace_of_camera,
    trace_of_events,
)
from evflow.estimation.state import State, add_path
from evflow.light.log_maps import lin_log
from evflow.recordings import plan_windows
from evflow.recordings.faulty_pixels import hot_pixels
from evflow.recordings.windows import WindowPlan
from evflow.scenes import SceneConfig, make_bank
from evflow.types import Events
from experiments.shared.cameras import Protocol, hidden_recording

SHAPE = (12, 16)
STEPS, INTERVALS = 8, 3
SILENT = CameraPrior(theta=(0.15, 0.3), mismatch=(0.03, 0.03), noise="none")


@pytest.fixture(scope="module")
def video() -> tuple[np.ndarray, np.ndarray]:
    """(frames DN, times us): smooth random brightness, a frame every ms."""
    walk = np.cumsum(np.random.default_rng(0).normal(size=(STEPS * INTERVALS + 1, *SHAPE)), 0)
    return (110 + 12 * walk).clip(30, 240).astype(np.float32), 1000 * np.arange(len(walk))


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera.sample(jax.random.key(0), SHAPE, SILENT)


@pytest.fixture(scope="module")
def events(video: tuple[np.ndarray, np.ndarray], camera: Camera) -> Events:
    return simulate(jax.random.key(1), *video, camera)


def test_simulated_trace_is_the_trace_of_the_simulated_events(
    video: tuple[np.ndarray, np.ndarray], camera: Camera, events: Events
) -> None:
    frames, times = video
    theta = np.stack([np.ravel(camera.theta_on), np.ravel(camera.theta_off)])
    made = trace_of_camera(
        draw(jax.random.key(2), 0, SHAPE, INTERVALS, STEPS), np.asarray(lin_log(frames)),
        np.full(INTERVALS, STEPS * 1e-3), theta, np.zeros(2), np.array(FRESH), STEPS)
    seen = trace_of_events(events, times[::STEPS], STEPS)
    np.testing.assert_array_equal(made.counts, seen.counts)
    np.testing.assert_array_equal(made.first_on, seen.first_on)
    fired = np.asarray(seen.step) != NEVER
    assert fired.mean() > 0.5
    when = np.asarray(made.step) + np.asarray(made.fraction)
    np.testing.assert_allclose(when[fired], (seen.step + seen.fraction)[fired], atol=2e-3)
    np.testing.assert_array_equal(np.asarray(made.step)[~fired], NEVER)


def test_sightings_are_numbered_as_the_events_of_the_whole_recording() -> None:
    """Labels of simulated noise are looked up by these numbers, for stretches that begin late."""
    rng, count, (height, width) = np.random.default_rng(0), 400, (24, 32)
    times = 25_000 * np.arange(6)
    events = Events(rng.integers(0, width, count), rng.integers(0, height, count),
                    np.sort(rng.integers(0, times[-1], count)), rng.random(count) < 0.5,
                    (width, height))
    frames = rng.integers(60, 200, (len(times), height, width)).astype(np.uint8)
    seen = make_chunk(Recording(events, frames, times), (2, 3)).sightings
    assert events.t[seen.number].min() > times[2]
    np.testing.assert_array_equal(events.p[seen.number], seen.on)
    np.testing.assert_array_equal(
        events.y[seen.number].astype(int) * width + events.x[seen.number], seen.pixel)


def test_every_event_is_counted_once(events: Events) -> None:
    edges = np.arange(INTERVALS + 1) * STEPS * 1000
    trace = trace_of_events(events, edges, STEPS)
    np.testing.assert_array_equal(np.asarray(trace.counts).sum(0), events.count_map())


def test_after_the_first_event_the_balance_is_exact(
    video: tuple[np.ndarray, np.ndarray], camera: Camera, events: Events
) -> None:
    """On the true path the remainder of every pixel stays between the thresholds."""
    frames, times = video
    path = lin_log(frames)
    trace = trace_of_events(events, times[::STEPS], STEPS)
    step = np.where(np.asarray(trace.step) == NEVER, 0, trace.step)
    rows = np.indices(SHAPE)
    start = np.asarray(path)[step, *rows]
    origin = start + trace.fraction * (np.asarray(path)[step + 1, *rows] - start)
    counts = np.asarray(trace.counts).sum(0)
    on, off = counts[0] - trace.first_on, counts[1] - ~np.asarray(trace.first_on)
    carried = on * camera.theta_on - off * camera.theta_off
    remainder = np.asarray(path[-1] - origin - carried)
    fired = np.asarray(trace.step) != NEVER
    inside = (remainder < np.asarray(camera.theta_on) + 2e-3) & (
        remainder > -np.asarray(camera.theta_off) - 2e-3)
    assert inside[fired].all()


def test_moments_add_over_the_sensor(
    video: tuple[np.ndarray, np.ndarray], events: Events
) -> None:
    frames, times = video
    path, dt_s = np.asarray(lin_log(frames)), np.full(INTERVALS, STEPS * 1e-3)
    trace = trace_of_events(events, times[::STEPS], STEPS)

    def of(rows: slice) -> object:
        part = dataclasses.replace(
            trace, step=trace.step[rows], fraction=trace.fraction[rows],
            first_on=trace.first_on[rows], counts=trace.counts[:, :, rows])
        bright = np.ones((rows.stop - rows.start, SHAPE[1]), bool)
        return measure(part, path[:, rows], dt_s, bright, STEPS)

    whole = of(slice(0, SHAPE[0]))
    halves = [of(slice(0, 5)), of(slice(5, SHAPE[0]))]
    jax.tree.map(lambda w, a, b: np.testing.assert_allclose(w, a + b, rtol=1e-4, atol=1e-4),
                 whole, *halves)


def test_regression_finds_each_pixels_thresholds(
    video: tuple[np.ndarray, np.ndarray], camera: Camera, events: Events
) -> None:
    """True path, no noise: far better than the prior; without events, the prior."""
    frames, times = video
    evidence = pixel_evidence(events, times[::STEPS], np.asarray(lin_log(frames)), STEPS)
    np.testing.assert_array_equal(evidence.equations[6], events.count_map().sum(0))
    known = Summary(*(jnp.float32(v) for v in (0.22, 0.22, 0.0, 0.0, 0.08, 0.08)))
    theta, std = pixel_posterior(evidence, known)
    true = np.stack([camera.theta_on, camera.theta_off])
    many = events.count_map().min(0) >= 3
    assert many.sum() > 20
    assert np.abs(theta - true)[:, many].mean() < 0.3 * np.abs(0.22 - true)[:, many].mean()
    assert (np.abs(theta - true) < 3 * std).mean() > 0.97
    empty, wide = pixel_posterior(PixelEvidence.nothing(SHAPE), known)
    np.testing.assert_allclose(empty, 0.22, rtol=1e-5)
    np.testing.assert_allclose(wide, 0.08, rtol=1e-5)


@pytest.mark.parametrize(("share", "low", "least", "most"), [
    (1.0, False, 0.84, 0.88), (0.8, False, 0.84, 0.91), (0.8, True, 0.81, 0.88),
    (0.2, False, 0.94, 0.96)])
def test_contrast_that_the_path_lacks_is_made_up_for(
    share: float, low: bool, least: float, most: float
) -> None:
    """A path of .86 of the contrast, known events in a share of the pixels, any or those of low
    thresholds: where most pixels have events the thresholds are those of the summary, else those
    of a path of the usual contrast."""
    rng = np.random.default_rng(0)
    shape = (30, 40)
    true = 0.25 + 0.05 * rng.standard_normal((2, *shape))
    a, b = (np.cumsum(rng.integers(0, 2, (60, *shape)), 0) for _ in range(2))
    y = 0.86 * (true[0] * a - true[1] * b) + 0.02 * rng.standard_normal(a.shape)
    a, b, y = (v - v.mean(0) for v in (a, -b, y))
    sums = [(u * v).sum(0) for u, v in ((a, a), (a, b), (b, b), (a, y), (b, y), (y, y))]
    rank = true.mean(0) if low else rng.random(shape)
    heard = rank <= np.quantile(rank, share)
    evidence = dataclasses.replace(
        PixelEvidence.nothing(shape), equations=np.stack([*sums, np.full(shape, 60.0)]) * heard)
    theta, std = pixel_posterior(
        evidence, Summary(*(jnp.float32(v) for v in (0.25, 0.25, 0.0, 0.0, 0.05, 0.05))))
    gain = np.median((0.86 * true / theta)[:, heard])
    assert least < gain < most
    if share == 1.0:
        assert np.abs(theta - true).mean() < 0.1 * 0.05
        assert (np.abs(theta - true) < std).mean() > 0.68


def test_no_change_beyond_a_threshold_goes_unanswered(
    video: tuple[np.ndarray, np.ndarray], camera: Camera, events: Events
) -> None:
    """On the true path every bound holds, and the widest come close to what they bound."""
    frames, times = video
    path = np.asarray(lin_log(frames))
    rise, fall, span = pixel_evidence(events, times[::STEPS], path, STEPS).bounds
    on, off = np.asarray(camera.theta_on), np.asarray(camera.theta_off)
    for bound, most in ((rise, on), (fall, off), (span, on + off)):
        known = bound != NOTHING
        assert known.mean() > 0.3
        assert (bound[known] < most[known] + 2e-3).all()
        assert np.quantile(bound[known] / most[known], 0.95) > 0.6


def test_bounds_move_the_belief_only_where_they_contradict_it() -> None:
    mean = np.full((2, 3), 0.2)
    covariance = np.einsum("ij,k->ijk", np.diag([0.01, 0.01]), np.ones(3))
    bounds = np.full((2, 3), NOTHING)
    bounds[0] = NOTHING, 0.05, 0.6  # unknown, far below, far above
    after, spread = bounded(mean, covariance, bounds)
    np.testing.assert_allclose(after[:, 0], 0.2)
    assert abs(after[0, 1] - 0.2) < 0.02 < 0.1 < after[0, 2] - 0.2
    assert spread[0, 0, 2] < 0.8 * 0.01
    np.testing.assert_allclose(after[1], 0.2)  # theta_off is not concerned
    draws = np.random.default_rng(0).normal(0.2, 0.1, 1_000_000)
    weight = np.asarray(norm.cdf((draws - (0.6 - EXCESS)) / ERROR))
    np.testing.assert_allclose(after[0, 2], np.average(draws, weights=weight), atol=1e-3)


@pytest.mark.parametrize(("passages", "least"), [(1, 0.3), (5, 0.12)])
def test_passages_between_frames_shrink_thresholds_little(passages: int, least: float) -> None:
    """The frames saw nothing, the events went up three thresholds and back within an interval,
    for which a path taken at its word has thresholds of zero."""
    times = 25_000 * np.arange(2 * passages + 1)
    within = np.array([6, 8, 10, 12, 14, 16]) * 1000
    t = (times[:-1:2, None] + within).ravel()
    on = np.tile([True] * 3 + [False] * 3, passages)
    events = Events(np.zeros(len(t), int), np.zeros(len(t), int), t, on, (1, 1))
    path = np.full((2 * passages * STEPS + 1, 1, 1), 5.0)
    known = Summary(*(jnp.float32(v) for v in (0.4, 0.4, 0.0, 0.0, 0.1, 0.1)))
    theta, std = pixel_posterior(pixel_evidence(events, times, path, STEPS), known)
    assert (theta > least).all()
    assert (std > 0.03).all()


def test_chunks_are_runs_of_equal_length() -> None:
    recording = Recording(
        Events(np.zeros(2, int), np.zeros(2, int), np.array([0, 1_000_000]), np.ones(2, bool),
               (16, 12)), np.zeros((41, 12, 16), np.uint8), np.arange(41) * 25_000)
    runs = plan_runs(recording, [(0, 8), (10, 12), (12, 29), (35, 36)])
    whole = [list(range(8)), list(range(10, 18)), list(range(18, 26))]
    assert runs == [*whole, [26, 27, 28], [35]]
    assert plan_chunks(recording, runs) == whole
    assert plan_chunks(recording, plan_runs(recording, [(3, 5), (9, 10)])) == [[3, 4]]
    assert plan_chunks(recording, plan_runs(recording, [])) == []


def surveyed(recording: Recording, pairs: Sequence[tuple[int, int]]) -> State:
    """All stretches of a recording, read in order."""
    parts = cut(recording, WindowPlan(tuple(pairs), ()))
    simulated = ordered(parts, "full").simulated
    state = State({}, FrontEnd())
    for i, stretch in enumerate(parts):
        state = add_path(state, stretch, simulate=i in simulated)
    return state


def test_pixels_learn_from_every_stretch_and_few_are_simulated(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long recording simulates what its budget allows, but no event of a pixel is lost."""
    rng, n, shape = np.random.default_rng(0), 3000, (24, 32)
    y, x = (rng.integers(0, size, n) for size in shape)
    events = Events(x, y, np.sort(rng.integers(0, 680_000, n)), rng.random(n) < 0.5, shape[::-1])
    frames = rng.integers(40, 200, (18, *shape)).astype(np.uint8)
    recording = Recording(events, frames, np.arange(18) * 40_000)
    pairs = [(0, 10), (10, 17)]
    runs = plan_runs(recording, pairs)
    everything = surveyed(recording, pairs)
    assert [len(run) for run in runs] == [8, 8, 1]
    assert len(everything.chunks) == 2
    monkeypatch.setattr(stretches, "CHUNK_PIXELS", 1)
    little = surveyed(recording, pairs)
    assert len(little.chunks) == 1
    assert plan_chunks(recording, runs) == [runs[1]]  # the middle: a recording's ends are its worst
    assert everything.evidence is not None
    assert little.evidence is not None
    np.testing.assert_array_equal(everything.evidence.equations, little.evidence.equations)
    np.testing.assert_array_equal(everything.evidence.bounds, little.evidence.bounds)
    np.testing.assert_array_equal(everything.quiet, little.quiet)
    first, last = recording.frame_times[[pairs[0][0], pairs[-1][1]]].tolist()
    inside = recording.events.slice(first + 1, last + 1)
    assert everything.evidence.equations[6].sum() <= len(inside)
    assert everything.evidence.equations[6].sum() > 0.95 * len(inside)


def test_hot_pixels_are_those_that_fire_while_nothing_moves() -> None:
    """Static scene, .3 Hz of noise everywhere, two pixels at 100 Hz."""
    rng = np.random.default_rng(1)
    shape, edges = (24, 32), np.arange(9) * 25_000
    camera = Camera.constant(shape, eta_on=0.15, eta_off=0.15)
    hot = np.zeros(shape, bool)
    hot[3, 5] = hot[20, 30] = True
    camera = dataclasses.replace(camera, eta_on=jnp.where(hot, 100.0, camera.eta_on))
    scene = rng.uniform(40, 200, shape).astype(np.float32)
    times = np.arange(201) * 1000
    events = simulate(jax.random.key(3), np.broadcast_to(scene, (201, *shape)), times, camera)
    recording = Recording(events, np.broadcast_to(scene, (9, *shape)).astype(np.uint8), edges)
    chunks = refinement_chunks(recording, ((0, 2), (2, 4), (4, 6), (6, 8)))
    np.testing.assert_array_equal(hot_pixels(np.sum([c.quiet for c in chunks], 0), 0.3), hot)


def test_hot_pixels_come_alone() -> None:
    """A hundredfold rate in one pixel, or two, is a fault; in a patch of them something moved."""
    def rates(busy: float) -> np.ndarray:
        """In 400 quiet intervals of 25 ms."""
        return np.array([busy, 10.0, 400.0, 400.0 * -np.expm1(-busy / 400.0)])

    quiet = np.tile(rates(1.0)[:, None, None], (1, 40, 40))
    for place in ((5, 5), (20, 30), (20, 31)):
        quiet[(slice(None), *place)] = rates(100.0)
    quiet[:, 28:33, 5:9] = rates(100.0)[:, None, None]
    found = hot_pixels(quiet, 0.1)
    assert np.argwhere(found).tolist() == [[5, 5], [20, 30], [20, 31]]
    quiet[3, 5, 5] = 6.0  # all its events in six of the intervals: faults fire in bursts too
    assert hot_pixels(quiet, 0.1)[5, 5]
    quiet[0, 4:7, 3:8] += 3.0  # but here others send more than noise as well: edges that went by
    assert np.argwhere(hot_pixels(quiet, 0.1)).tolist() == [[20, 30], [20, 31]]
    quiet[3, 5, 5] = quiet[2, 5, 5]
    assert hot_pixels(quiet, 0.1)[5, 5]


def test_hot_pixels_amid_motion_are_looked_at_twice() -> None:
    """Ten frame intervals of 40 ms. A band of steady motion, 100 events a pixel, is quiet in one of
    them; below it all but noise is rest."""
    quiet, counts = np.zeros((4, 40, 40)), np.zeros((40, 40), int)
    quiet[1:3, :20], counts[:20] = np.array([0.04, 1.0])[:, None, None], 100
    quiet[1:3, 20:] = np.array([0.4, 10.0])[:, None, None]

    def busy(y: int, x: int, events: float, fired: float, times: float, sent: int) -> None:
        quiet[:, y, x] = events, 0.04 * times, times, fired
        counts[y, x] = sent

    busy(5, 5, 6, 1, 1, 104)  # an edge that the frames do not show
    busy(5, 15, 6, 2, 2, 96)  # twice, while the neighbours fire, too
    quiet[0, 3:8, 13:18] += 1
    busy(5, 25, 9, 1, 1, 320)  # by its rate 90 events, and many more than others
    quiet[1:3, 10:15, 3:8] = np.array([0.16, 4.0])[:, None, None]
    busy(12, 5, 8, 6, 8, 130)  # fires at most quiet times, of which others there know
    busy(30, 10, 12, 8, 10, 13)  # amid rest
    busy(30, 20, 12, 2, 10, 12)  # in bursts
    assert np.argwhere(hot_pixels(quiet, 0.2))[:, 0].tolist() == [5, 5, 5, 12, 30, 30]
    found = hot_pixels(quiet, 0.2, counts, 0.4)
    assert np.argwhere(found).tolist() == [[5, 25], [12, 5], [30, 10], [30, 20]]


def test_fast_motion_makes_few_hot_pixels() -> None:
    """Edges that go by between two frames alike leave events where the frames say nothing moved."""
    fast = Protocol(scene=SceneConfig(speed_px_s=(250.0, 500.0), contrast=(0.5, 1.0)),
                    intervals=24)
    bank = make_bank(jax.random.key(9), 8, photos=False)
    made = hidden_recording(jax.random.key(0), bank, fast)
    recording = made.recording
    quiet = surveyed(recording, plan_windows(recording).pairs).quiet
    assert quiet is not None
    rate = float(made.nominal.eta_on + made.nominal.eta_off)
    always = np.stack([*quiet[:3], quiet[2]])  # as if they fired all the time
    assert hot_pixels(always, rate).sum() > 6  # some to spare: 10 and, with jax 0.12, 8
    assert hot_pixels(quiet, rate).sum() < 0.5 * hot_pixels(always, rate).sum()

"""Flow metrics: sharpness of warped events, by real data and by definition; endpoint errors."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow import metrics
from evflow.errors import EvflowDataError
from evflow.metrics.flow import FwlConvention, splat
from evflow.types import Events

SIZE = (32, 24)  # width, height
fwl, rsat, aee = (jax.jit(metrics.fwl, static_argnames="convention"), jax.jit(metrics.rsat),
                  jax.jit(metrics.aee, static_argnames="outlier_px"))


def edge(velocity: float = 12.0, n: int = 1500, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Events of three vertical edges that move to the right, px per window: x, y, t, p, weight."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.random(n))
    x = rng.choice([4.0, 9.0, 13.0], n) + velocity * t
    columns = (x, rng.integers(0, 24, n), t, rng.choice([-1, 1], n), np.ones(n))
    return tuple(c.astype(np.float32) for c in columns)


def constant(u: float, v: float = 0.0) -> np.ndarray:
    return np.stack([np.full(SIZE[::-1], value, np.float32) for value in (u, v)])


def slow_fwl(events: tuple[np.ndarray, ...], u: float, how: FwlConvention) -> float:
    """FWL of a constant flow, written out."""
    def image(u: float) -> np.ndarray:
        x, y, t, p, _ = (a.astype(np.float64) for a in events)
        to = t.max() if how.reference == "last" else t.min()
        out = np.zeros(SIZE[::-1])
        for xi, yi, ti, pi in zip(x, y, t, p, strict=True):
            at, vote = xi + (to - ti) * u, pi if how.polarity == "signed" else 1.0
            spots = ([(round(at), vote)] if how.splat == "round" else
                     [(int(np.floor(at)) + d, vote * abs(1 - d - at % 1)) for d in (0, 1)])
            for column, value in spots:
                if 0 <= column < SIZE[0]:
                    out[int(yi), column] += value
        return cv2.GaussianBlur(out, (0, 0), how.blur, borderType=cv2.BORDER_REPLICATE
                                ) if how.blur else out

    return image(u).var() / image(0.0).var()


@pytest.mark.parametrize("how", [
    FwlConvention(), FwlConvention(reference="first"), FwlConvention(splat="round"),
    FwlConvention(polarity="signed"), FwlConvention(blur=1.0),
], ids=lambda how: "-".join(map(str, how.as_dict().values())))
def test_fwl_is_its_definition(how: FwlConvention) -> None:
    for u in (12.0, -5.0, 3.3):
        expected = slow_fwl(edge(), u, how)
        # cv2 cuts its Gaussian off earlier than 4 sigma.
        rtol = 2e-2 if how.blur else 1e-3
        np.testing.assert_allclose(
            float(fwl(*edge(), constant(u), convention=how)), expected, rtol=rtol)


def test_events_of_any_dtype_and_origin_score_the_same() -> None:
    x, y, t, p, weight = (np.asarray(a, np.float64) for a in edge())
    expected = [float(f(*edge(), constant(12.0))) for f in (metrics.fwl, metrics.rsat)]
    flow = np.asarray(constant(12.0), np.float64)
    for t_one, weights in ((t, weight), (t + 1.4e9, weight.astype(int)), (t, weight > 0)):
        found = [float(f(x, y, t_one, p > 0, weights, flow)) for f in (metrics.fwl, metrics.rsat)]
        np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_true_flow_is_the_sharpest_and_no_flow_is_1() -> None:
    values = {u: float(fwl(*edge(), constant(u))) for u in (-12.0, 0.0, 6.0, 12.0, 18.0)}
    assert max(values, key=values.__getitem__) == 12.0
    assert values[12.0] > 2
    assert values[0.0] == 1.0
    assert values[-12.0] < 1
    x, y, t, p, weight = edge()  # edges of one polarity each: where both fall together they add up
    ratios = {u: float(rsat(x, y, t, np.ones_like(p), weight, constant(u)))
              for u in (0.0, 12.0, -12.0)}
    assert ratios[12.0] < ratios[0.0] == 1.0 < ratios[-12.0] + 0.2


def test_rsat_is_its_definition() -> None:
    """Hagenaars et al.: both polarities' squares over the pixels of either, votes rounded."""
    x, y, t, p, weight = edge()
    flow = constant(7.0)

    def squares(u: float) -> float:
        at = np.round(x + (t.max() - t) * u).astype(int)
        inside, total, seen = (at >= 0) & (at < SIZE[0]), 0.0, set()
        for sign in (1, -1):
            mine = inside & (p == sign)
            ages: dict[tuple[int, int], list[float]] = {}
            for spot, time in zip(zip(at[mine], y[mine], strict=True), t[mine], strict=True):
                ages.setdefault(spot, []).append((time - t.min()) / (t.max() - t.min()))
            total += sum(np.mean(v) ** 2 for v in ages.values())
            seen |= set(ages)
        return total / len(seen)

    np.testing.assert_allclose(float(rsat(x, y, t, p, weight, flow)),
                               squares(7.0) / squares(0.0), rtol=1e-3)


def test_times_of_any_origin_with_weights_of_any_kind() -> None:
    x, y, t, p, weight = (np.pad(column, (0, 9)) for column in edge())
    t = np.where(weight > 0, t.astype(float) + 1.7e9, 0.0)
    wanted = metrics.fwl(*edge(), constant(9.0))
    for given in (weight, jnp.asarray(weight)):
        found = metrics.fwl(x, y, t, p, given, constant(9.0))
        np.testing.assert_allclose(found, wanted, rtol=1e-3)
    lists = [column.tolist() for column in (x, y, t, p, weight)]
    np.testing.assert_allclose(metrics.fwl(*lists, constant(9.0)), wanted, rtol=1e-3)


def test_padding_weighs_nothing() -> None:
    padded = [np.pad(column, (0, 500), constant_values=99.0) for column in edge()]
    padded[4][-500:] = 0
    for how in (FwlConvention(), FwlConvention(reference="first")):
        np.testing.assert_allclose(fwl(*padded, constant(9.0), convention=how),
                                   fwl(*edge(), constant(9.0), convention=how), rtol=1e-6)
    np.testing.assert_allclose(
        rsat(*padded, constant(9.0)), rsat(*edge(), constant(9.0)), rtol=1e-5)


@pytest.mark.parametrize("score", [metrics.fwl, metrics.rsat, metrics.warped_image])
def test_events_and_flow_that_do_not_fit_are_refused(score: Callable) -> None:
    x, y, t, p, weight = edge(n=50)
    flow = constant(3.0)
    for columns, of in (((x, y, t, p, weight), jnp.moveaxis(flow, 0, -1)),
                        ((x, y, t, p, weight), flow[0]), ((x[:-1], y, t, p, weight), flow),
                        ((x, y, t, p[:1], weight), flow), ((x, y, t[None], p, weight), flow)):
        with pytest.raises(EvflowDataError, match="EV002"):
            score(*columns, of)
    as_lists = score(*(column.tolist() for column in (x, y, t, p, weight)), flow.tolist())
    np.testing.assert_allclose(as_lists, score(x, y, t, p, weight, flow), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("score", [metrics.fwl, metrics.warped_image])
def test_a_convention_is_no_word(score: Callable) -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*'round'"):
        score(*edge(n=50), constant(3.0), "round")


def test_votes_are_kept_inside_and_lost_outside() -> None:
    rng = np.random.default_rng(1)
    x, y = (jnp.asarray(rng.uniform(0, n - 1, 300), jnp.float32) for n in SIZE)
    weight = jnp.asarray(rng.random(300), jnp.float32)
    np.testing.assert_allclose(splat(x, y, weight, SIZE[::-1]).sum(), weight.sum(), rtol=1e-5)
    outside = splat(jnp.array([-1.5, 40.0, -0.25]), jnp.array([3.0, 3.0, 3.0]), jnp.ones(3),
                    SIZE[::-1])
    assert float(outside.sum()) == 0.75
    assert float(outside[3, 0]) == 0.75


def test_flow_metrics_batch_and_differentiate() -> None:
    flows = np.stack([constant(u) for u in (0.0, 6.0, 12.0)])
    many = jax.jit(jax.vmap(lambda flow: metrics.fwl(*edge(), flow)))(flows)
    np.testing.assert_allclose(
        many, [fwl(*edge(), constant(u)) for u in (0.0, 6.0, 12.0)], rtol=1e-5)
    rise = jax.jit(jax.grad(lambda u: metrics.fwl(*edge(), constant(1.0) * u)))(11.0)
    assert float(rise) > 0


def test_no_events_tell_nothing() -> None:
    none = [column[:0] for column in edge()]
    assert np.isnan(fwl(*none, constant(3.0)))
    assert np.isnan(fwl(*none, constant(3.0), convention=FwlConvention(reference="first")))
    assert not np.isfinite(rsat(*none, constant(3.0)))


ROTATIONS = {"boxes": 1.56, "dynamic": 2.06}


@pytest.mark.parametrize("name", ROTATIONS)
def test_fwl_of_rotations_by_the_flow_of_their_gyroscope(
    name: str, data_file: Callable[[str], Path]
) -> None:
    """DAVIS240, 30 000 events: undistorted (the flow is on that grid), warped to the first
    event by the flow over the slice, counted bilinearly."""
    folder = data_file(f"data/recordings/ijrr_{name}_rotation")
    with np.load(folder / "events.npz") as e, np.load(folder / "extra.npz") as extra:
        fx, fy, cx, cy, *distortion = extra["calib_fx_fy_cx_cy_k1_k2_p1_p2_k3"]
        flow = jnp.asarray(extra["flow_xy_px_per_slice"])
        t, p, xy = e["t"], e["p"], np.stack([e["x"], e["y"]], -1).astype(np.float32)
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    new, _ = cv2.getOptimalNewCameraMatrix(k, np.array(distortion), (240, 180), 0)
    xy = cv2.undistortPoints(xy[:, None], k, np.array(distortion), P=new)[:, 0]
    time = ((t - t[0]) / (t[-1] - t[0])).astype(np.float32)
    events = (xy[:, 0], xy[:, 1], time, p.astype(np.float32), np.ones(len(t), np.float32))
    how = FwlConvention(reference="first")
    right, wrong, half = (float(fwl(*events, s * flow, convention=how)) for s in (1.0, -1.0, 0.5))
    np.testing.assert_allclose(right, ROTATIONS[name], atol=0.01)
    assert wrong < 1 < half < right
    assert float(rsat(*events, flow)) < 1 < float(rsat(*events, -flow))


def test_endpoint_errors_by_hand() -> None:
    truth = np.zeros((2, 2, 3), np.float32)
    flow = truth.copy()
    flow[:, 0, 0], flow[0, 0, 1], truth[:, 1, 2] = (3.0, 4.0), 1.0, np.nan
    mask = np.array([[1, 1, 1], [1, 0, 0]], bool)
    error, outliers = aee(flow, truth, mask)
    np.testing.assert_allclose([error, outliers], [1.5, 25.0])
    for other in (mask.astype(float), 2 * mask.astype(int)):
        np.testing.assert_allclose(metrics.aee(flow, truth, other), [1.5, 25.0])
    _, outliers = aee(flow, truth, mask, outlier_px=6.0)
    assert float(outliers) == 0
    error, _ = metrics.aee(flow[None, ..., :2], truth[None, ..., :2])
    np.testing.assert_allclose(error, [1.5])
    assert bool(jnp.isnan(metrics.aee(flow, truth, mask & False)[0]))
    gradient = jax.jit(jax.grad(lambda f: metrics.aee(f, truth, mask)[0]))(np.zeros((2, 2, 3)))
    assert bool(jnp.isfinite(gradient).all())


def recorded(seed: int = 0) -> Events:
    x, y, t, p, _ = edge(seed=seed)
    x, y, t = (column.astype(np.int64) for column in (x, y, 50_000 * t))
    return Events(x, y, t, p > 0, SIZE)


def test_scores_say_how_they_were_made() -> None:
    edges = np.array([0, 25_000, 50_000, 75_000])  # the last window is silent
    flow = np.broadcast_to(np.asarray(constant(6.0)), (3, 2, *SIZE[::-1]))
    scores = metrics.score_flow(recorded(), edges, flow, truth=flow * 1.0)
    assert json.loads(json.dumps(scores)) == scores
    assert scores["convention"] == FwlConvention().as_dict()
    assert (scores["windows"], scores["window_ms"]) == (2, 25.0)
    assert scores["events_per_window"] == len(recorded()) / 2
    assert scores["aee"] == scores["outlier_percent"] == 0.0
    assert scores["fwl"] == scores["fwl_truth"] > 1.2
    valid = np.zeros((3, *SIZE[::-1]), bool)
    nowhere = metrics.score_flow(recorded(), edges, flow, truth=flow * 2.0, valid=valid)
    assert nowhere["aee"] is None
    off = metrics.score_flow(recorded(), edges, flow, truth=flow * 2.0, valid=~valid)
    np.testing.assert_allclose([off["aee"], off["outlier_percent"]], [6.0, 100.0], rtol=1e-5)


def test_windows_without_events_have_no_score() -> None:
    flow = np.zeros((1, 2, *SIZE[::-1]), np.float32)
    silence = metrics.score_flow(recorded(), np.array([60_000, 70_000]), flow, truth=flow)
    assert silence["windows"] == 0
    for name in ("window_ms", "events_per_window", "fwl", "rsat", "aee", "outlier_percent",
                 "fwl_truth"):
        assert silence[name] is None
    assert "aee" not in metrics.score_flow(recorded(), np.array([60_000, 70_000]), flow)


@pytest.mark.parametrize(("call", "code"), [
    (lambda e, f: metrics.score_flow(e, np.array([0, 1]), f), "EV002"),
    (lambda e, f: metrics.score_flow(e, np.array([0, 5, 5]), f), "EV004"),
    (lambda e, f: metrics.score_flow(e, np.array([0, 5, 9]), f, truth=f[:1]), "EV002"),
    (lambda e, f: metrics.score_flow(e, np.array([0, 5, 9]), f, valid=f > 0), "EV002"),
    (lambda e, f: metrics.endpoint_error(f, f[..., :-1]), "EV002"),
    (lambda e, f: metrics.endpoint_error(f, f[[0, 0, 0]]), "EV002"),
    (lambda e, f: metrics.endpoint_error(f[0, 0], f[0, 0]), "EV002"),
    (lambda e, f: FwlConvention(splat="cubic"), "EV020"),
    (lambda e, f: FwlConvention(blur=-1.0), "EV020"),
    (lambda e, f: FwlConvention(blur="x"), "EV020"),
])
def test_what_cannot_be_scored_is_refused(call, code: str) -> None:
    with pytest.raises(EvflowDataError, match=code):
        call(recorded(), np.zeros((2, 2, *SIZE[::-1]), np.float32))


def test_flow_that_is_not_finite_is_no_good_flow() -> None:
    truth = jnp.zeros((2, 4, 4))
    error, beyond = metrics.aee(truth * jnp.nan, truth)
    assert np.isnan(error)
    assert beyond == 100.0
    events = Events(np.array([1, 2]), np.array([1, 2]), np.array([0, 5]), np.array([True, False]),
                    (4, 4))
    with pytest.raises(EvflowDataError, match="EV007"):
        metrics.score_flow(events, np.array([0, 10]), np.full((1, 2, 4, 4), np.nan))


def test_half_precision_is_scored_in_single() -> None:
    rng = np.random.default_rng(0)
    flow, truth = rng.normal(size=(2, 2, 260, 346)).astype(np.float16)
    single = [a.astype(np.float32) for a in (flow, truth)]
    np.testing.assert_array_equal(aee(flow, truth), aee(*single))
    x, y, t = (rng.integers(0, n, 500).astype(np.float16) for n in (346, 260, 500))
    ones = np.ones(500, np.float16)
    columns = [a.astype(np.float32) for a in (x, y, t, ones, ones)]
    for score in (fwl, rsat):
        assert float(score(x, y, t, ones, ones, flow)) == float(score(*columns, single[0]))


def test_an_even_image_has_no_fwl() -> None:
    y, x = (a.ravel() for a in np.mgrid[:16, :16])
    events = (x, y, np.arange(256), np.ones(256), np.ones(256))
    assert np.isnan(fwl(*events, np.full((2, 16, 16), 0.01)))


def test_unknown_truth_is_not_scored() -> None:
    flow, truth = jnp.full((2, 4, 4), 5.0), jnp.zeros((2, 4, 4)).at[:, :2].set(jnp.nan)
    error, beyond = metrics.aee(flow, truth)
    assert (float(error), float(beyond)) == (pytest.approx(np.sqrt(50)), 100.0)
    with pytest.raises(EvflowDataError, match="EV002"):
        metrics.aee(flow, truth, jnp.ones((1, 4), bool))
    with pytest.raises(EvflowDataError, match="EV002"):
        metrics.aee(jnp.moveaxis(flow, 0, -1), jnp.moveaxis(truth, 0, -1))


def test_the_ceiling_is_of_events_whose_flow_is_known() -> None:
    """The same flow, as an estimate and as a truth that is known on the right alone."""
    x, y, t, p, _ = edge()
    inside = (x >= 0) & (x < 31)
    events = Events(x[inside].astype(int), y[inside].astype(int),
                    (1000 * t[inside]).astype(np.int64), p[inside] > 0, SIZE)
    flow = np.asarray(constant(12.0))[None]
    part = flow.copy()
    part[:, :, :, :10] = np.nan
    right = events.x >= 10
    known = Events(*(a[right] for a in (events.x, events.y, events.t, events.p)), SIZE)
    edges = np.array([0, 1001])
    found = metrics.score_flow(events, edges, flow, truth=part)
    assert found["fwl_truth"] == pytest.approx(metrics.score_flow(known, edges, flow)["fwl"])
    assert found["aee"] == 0.0

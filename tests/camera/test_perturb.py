"""Hot, dead and measured pixels: shares, rates, and what the simulator makes of them."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.recordings import mutations

from evflow.camera import PARAMETERS, Camera
from evflow.camera.perturb import (
    AXIS_HZ,
    DEAD_THETA,
    NoiseHistogram,
    read_noise_histogram,
    with_faults,
    with_noise_histogram,
)
from evflow.errors import EvflowDataError
from evflow.simulator import simulate

pytestmark = pytest.mark.usefixtures("optimised")

KEY = jax.random.key(11)
SHAPE = (200, 250)
PIXELS = 50_000
REAL = "data/recordings/iebcs_noise_hist/noise_cumhist.npz"
DARK = ("pos_0.1lux", "neg_0.1lux")


def rows(pixels: int = 400) -> np.ndarray:
    """Cumulative histograms (N, 72) of pixels whose rates spread over three decades; the first
    tenth is silent."""
    rng = np.random.default_rng(3)
    spread = 10.0 ** rng.uniform(-1, 2, pixels)[:, None]
    intervals = rng.exponential(1.0, (pixels, 40)) / spread
    counts = np.stack([np.histogram(1 / row, AXIS_HZ)[0] for row in intervals])
    counts[: pixels // 10] = 0
    return np.concatenate([counts.cumsum(1), np.zeros((pixels, 1))], 1)


def bytes_of(camera: Camera) -> bytes:
    return b"".join(np.asarray(getattr(camera, name)).tobytes() for name in PARAMETERS)


def saved(path: Path, array: Any) -> Path:
    np.save(path, array)
    return path


def refused(path: Path, **options: Any) -> str:
    with pytest.raises(EvflowDataError) as raised:
        read_noise_histogram(path, **options)
    return raised.value.code


def test_shares_and_rates_of_faulty_pixels() -> None:
    """Binomial shares to 4 sd; the log rates of hot pixels are uniform in hot_hz, and ON says
    nothing about OFF (4 sd)."""
    made = with_faults(KEY, Camera.constant(SHAPE, 0.2, 0.3, 0.5, 0.1), 0.02, (5.0, 100.0), 0.01)
    maps = {name: np.asarray(getattr(made, name)).ravel() for name in PARAMETERS}
    dead = maps["theta_on"] == DEAD_THETA
    hot = maps["eta_on"] >= 5.0
    for found, share in ((hot, 0.02), (dead, 0.01)):
        assert abs(found.mean() - share) < 4 * np.sqrt(share * (1 - share) / PIXELS)
    assert not (hot & dead).any()
    np.testing.assert_array_equal(maps["theta_off"] == DEAD_THETA, dead)
    assert not maps["eta_on"][dead].any()
    assert not maps["eta_off"][dead].any()
    healthy = ~(hot | dead)
    for name, value in zip(PARAMETERS, (0.2, 0.3, 0.5, 0.1), strict=True):
        assert set(maps[name][healthy]) == {np.float32(value)}
    place = [np.log(maps[n][hot] / 5.0) / np.log(20.0) for n in ("eta_on", "eta_off")]
    n = hot.sum()
    for u in place:
        assert u.min() >= -1e-6
        assert u.max() <= 1 + 1e-6
        counts = np.histogram(u, 10, (-1e-5, 1 + 1e-5))[0]
        assert ((counts - n / 10) ** 2 / (n / 10)).sum() < 9 + 4 * np.sqrt(18)
    assert abs(np.corrcoef(place)[0, 1]) < 4 / np.sqrt(n)


def test_no_fault_changes_nothing_and_one_key_gives_one_camera() -> None:
    camera = Camera.constant((20, 30), 0.2, 0.3, 0.5, 0.1)
    assert bytes_of(with_faults(KEY, camera, 0.0, dead=0.0)) == bytes_of(camera)
    first = with_faults(KEY, camera, 0.1, dead=0.1)
    assert bytes_of(first) == bytes_of(with_faults(KEY, camera, 0.1, dead=0.1))
    assert bytes_of(first) == bytes_of(jax.jit(
        lambda k, c: with_faults(k, c, 0.1, dead=0.1))(KEY, camera))
    other = with_faults(jax.random.key(12), camera, 0.1, dead=0.1)
    assert bytes_of(first) != bytes_of(other)
    assert all(np.asarray(m).dtype == np.float32 for m in jax.tree.leaves(first))
    histogram = NoiseHistogram(np.diff(rows()[:, :-1], axis=1, prepend=0.0))
    again = [bytes_of(with_noise_histogram(KEY, camera, histogram, histogram)) for _ in range(2)]
    assert again[0] == again[1]


@pytest.mark.parametrize("options", [
    {"hot": -0.1}, {"hot": 0.6, "dead": 0.6}, {"dead": float("nan")}, {"hot_hz": (0.0, 5.0)},
    {"hot_hz": (9.0, 5.0)}, {"hot_hz": (5.0, float("inf"))}, {"hot": "a"}, {"hot_hz": 5.0},
    {"hot_hz": ("a", "b")}, {"hot_hz": (1.0, 2.0, 3.0)}])
def test_impossible_faults_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        with_faults(KEY, Camera.constant((4, 4)), **options)


def test_dead_pixels_are_silent_and_hot_ones_fire_at_their_rate() -> None:
    """A flashing scene: healthy pixels fire at each flash, dead ones never, hot ones besides at
    the rates drawn (2 % of some 60,000 events, 4 sd)."""
    camera = with_faults(KEY, Camera.constant((64, 64)), 0.1, (5.0, 100.0), 0.1)
    frames = np.where(np.arange(501) % 2, 220.0, 40.0)[:, None, None]
    events, noise = simulate(KEY, np.broadcast_to(frames, (501, 64, 64)).astype(np.float32),
                             10_000 * np.arange(501), camera, labels=True)
    counts = events.count_map()
    dead = np.asarray(camera.theta_on) == DEAD_THETA
    assert not counts[:, dead].any()
    assert counts[:, ~dead].min() > 1000
    for polarity, eta in ((True, camera.eta_on), (False, camera.eta_off)):
        expected = float(np.asarray(eta).sum()) * 5.0
        assert expected > 40_000
        assert (noise & (events.p == polarity)).sum() == pytest.approx(expected, rel=0.02)


def test_rate_of_a_pixel_is_its_intervals_over_their_sum() -> None:
    """Intervals of one frequency f come back as f to within the bin; none at all as 0; the rate
    of 40 exponential intervals within 4 sd of 1/sqrt(40) plus the bins' width."""
    for f in (0.0015, 0.25, 9.5, 6.5e4):
        cumulative = np.append(np.cumsum(np.histogram([f] * 7, AXIS_HZ)[0]), 0)[None]
        rate = NoiseHistogram(np.diff(cumulative[:, :-1], axis=1, prepend=0.0)).rates()[0]
        low = AXIS_HZ[np.searchsorted(AXIS_HZ, f) - 1]
        assert low <= rate <= 2 * low
    assert not NoiseHistogram(np.zeros((3, 71))).rates().any()
    rng = np.random.default_rng(5)
    intervals = rng.exponential(1 / 30.0, (2000, 40))
    counts = np.stack([np.histogram(1 / row, AXIS_HZ)[0] for row in intervals]).astype(float)
    exact = 40 / intervals.sum(1)
    np.testing.assert_allclose(NoiseHistogram(counts).rates() / exact, 1.0, atol=0.2)
    assert np.median(NoiseHistogram(counts).rates() / exact) == pytest.approx(1.0, abs=0.02)


def test_both_layouts_are_read(tmp_path: Path) -> None:
    flat = rows()
    total = np.concatenate([flat[:, :-1], flat[:, -2:-1]], 1)
    counts = read_noise_histogram(saved(tmp_path / "flat.npy", flat)).counts
    assert counts.shape == (400, 71)
    np.testing.assert_array_equal(counts.sum(1), flat[:, -2])
    for name, array in (("square.npy", flat.reshape(20, 20, 72)), ("total.npy", total),
                        ("small.npy", flat.astype(np.uint16))):
        same = read_noise_histogram(saved(tmp_path / name, array)).counts
        np.testing.assert_array_equal(same, counts)
    np.savez(tmp_path / "one.npz", a=flat, freq_bins_hz=AXIS_HZ)
    np.testing.assert_array_equal(read_noise_histogram(tmp_path / "one.npz").counts, counts)
    np.savez(tmp_path / "two.npz", a=flat, b=0 * flat)
    assert not read_noise_histogram(tmp_path / "two.npz", "b").counts.any()


def test_damaged_files_are_refused_by_code(tmp_path: Path) -> None:
    good = rows()
    falling, nan, spare = good.copy(), good.copy(), good.copy()
    falling[50, 40], nan[3, 3], spare[60, 71] = -1.0, np.nan, 1e6
    cases = {"EV009": (falling, spare, np.diff(good, axis=1, prepend=0.0)),
             "EV007": (nan,), "EV003": (good.astype("U8"), good > 0), "EV001": (good[:0],),
             "EV002": (good[:, :-1], good[0], good[None, None])}
    for code, arrays in cases.items():
        for array in arrays:
            assert refused(saved(tmp_path / "bad.npy", array)) == code
    assert refused(tmp_path / "absent.npy") == "EV016"
    assert refused(tmp_path) == "EV016"
    (tmp_path / "text.npy").write_text("not an array")
    assert refused(tmp_path / "text.npy") == "EV009"
    saved(tmp_path / "pickle.npy", np.array([{}], object))
    assert refused(tmp_path / "pickle.npy") == "EV009"
    np.savez(tmp_path / "two.npz", a=good, b=good)
    assert refused(tmp_path / "two.npz") == "EV020"
    assert refused(tmp_path / "two.npz", name="c") == "EV020"
    np.savez(tmp_path / "axis.npz", a=good, hz=2 * AXIS_HZ)
    assert refused(tmp_path / "axis.npz") == "EV008"


@pytest.mark.parametrize("kind", ["npy", "npz"])
@pytest.mark.filterwarnings("ignore")
def test_any_damage_is_refused_or_harmless(tmp_path: Path, kind: str) -> None:
    buffer = io.BytesIO()
    if kind == "npy":
        np.save(buffer, rows(100).astype(np.uint16))
    else:
        np.savez_compressed(buffer, a=rows(100), freq_bins_hz=AXIS_HZ)
    path, outcomes = tmp_path / f"a.{kind}", set()
    for data in mutations(buffer.getvalue(), 90):
        path.write_bytes(data)
        try:
            assert np.isfinite(read_noise_histogram(path).rates()).all()
            outcomes.add("read")
        except EvflowDataError as error:
            outcomes.add(error.code)
    assert "EV009" in outcomes


def agree(drawn: np.ndarray, rates: np.ndarray) -> None:
    """Every drawn rate is a measured one, and each tenth of the measured pixels (the silent ones
    as one band) is drawn as often as it should be, to 4 sd."""
    assert np.isin(drawn, rates.astype(np.float32)).all()
    edges = np.unique(np.quantile(rates, np.linspace(0, 1, 11)))
    edges = np.concatenate([[-1.0, 0.0], edges[edges > 0][:-1], [np.inf]])
    share = np.histogram(-rates.astype(np.float32), -edges[::-1])[0] / len(rates)
    counts = np.histogram(-drawn, -edges[::-1])[0]
    np.testing.assert_array_less(
        np.abs(counts - len(drawn) * share), 4 * np.sqrt(len(drawn) * share * (1 - share)) + 1e-6)


def test_drawn_rates_follow_the_file_and_polarities_stay_together(tmp_path: Path) -> None:
    on = read_noise_histogram(saved(tmp_path / "a.npy", rows()))
    camera = with_noise_histogram(KEY, Camera.constant(SHAPE, 0.2), on, on)
    agree(np.asarray(camera.eta_on).ravel(), on.rates())
    np.testing.assert_array_equal(camera.eta_on, camera.eta_off)
    assert (np.asarray(camera.theta_on) == np.float32(0.2)).all()
    fewer = NoiseHistogram(on.counts[:300])
    apart = with_noise_histogram(KEY, Camera.constant(SHAPE, 0.2), on, fewer)
    agree(np.asarray(apart.eta_off).ravel(), fewer.rates())
    both = np.corrcoef(np.asarray(apart.eta_on).ravel(), np.asarray(apart.eta_off).ravel())
    assert abs(both[0, 1]) < 4 / np.sqrt(PIXELS)


def bands(camera: Camera, seconds: float, dt_us: int) -> None:
    """On a still scene each quarter of the pixels by rate, and each polarity, fires at the rate
    drawn: 2 % where 40,000 events make that four standard deviations."""
    frames = round(seconds * 1e6 / dt_us) + 1
    video = np.broadcast_to(np.float32(100.0), (frames, *camera.shape))
    counts = simulate(KEY, video, dt_us * np.arange(frames), camera).count_map()
    for fired, eta in zip(counts, (camera.eta_on, camera.eta_off), strict=True):
        eta = np.asarray(eta, np.float64)
        assert not fired[eta == 0].any()
        active = eta[eta > 0]
        edges = np.quantile(active, [0.25, 0.5, 0.75])
        where = np.digitize(eta, edges)
        for band in range(4):
            inside = (where == band) & (eta > 0)
            expected = eta[inside].sum() * seconds
            assert expected > 40_000
            assert fired[inside].sum() == pytest.approx(expected, rel=0.02)


def test_simulated_noise_has_the_rates_drawn(tmp_path: Path) -> None:
    on = read_noise_histogram(saved(tmp_path / "a.npy", rows()))
    camera = with_noise_histogram(KEY, Camera.constant((64, 64), 0.2), on, on)
    bands(camera, 200.0, 250_000)


def test_real_histograms(data_file: Callable[[str], Path]) -> None:
    """The files of IEBCS: about 10 Hz in the dark, ON and OFF together; ON alone in the light."""
    on, off = (read_noise_histogram(data_file(REAL), name) for name in DARK)
    assert on.counts.shape == (2500, 71)
    assert np.median(on.rates()) == pytest.approx(5.93, abs=0.01)
    assert np.corrcoef(on.rates(), off.rates())[0, 1] == pytest.approx(0.949, abs=0.001)
    camera = with_noise_histogram(KEY, Camera.constant((64, 64), 0.2), on, off)
    agree(np.asarray(camera.eta_on).ravel(), on.rates())
    agree(np.asarray(camera.eta_off).ravel(), off.rates())
    assert np.corrcoef(camera.eta_on.ravel(), camera.eta_off.ravel())[0, 1] > 0.9
    bands(camera, 40.0, 100_000)
    light = read_noise_histogram(data_file(REAL), "neg_3klux")
    assert not light.rates().any()


def test_measured_noise_keeps_the_dtype_in_x64() -> None:
    with jax.enable_x64(True):
        camera = Camera(*(jnp.full((4, 5), v, jnp.float64) for v in (0.2, 0.2, 0.0, 0.0)))
        histogram = NoiseHistogram(np.ones((3, 71)))
        for made in (with_faults(KEY, camera), with_noise_histogram(
                KEY, camera, histogram, histogram)):
            assert {m.dtype for m in jax.tree.leaves(made)} == {jnp.dtype("float64")}


@pytest.mark.parametrize("kind", [">f4", ">f8", "list"])
def test_maps_may_be_lists_or_bytes_of_another_order(kind: str) -> None:
    camera = Camera.sample(KEY, (4, 5))
    maps = [np.asarray(m) for m in jax.tree.leaves(camera)]
    other = Camera(*(m.tolist() if kind == "list" else m.astype(kind) for m in maps))
    noise, video = NoiseHistogram(np.ones((3, 71))), np.full((2, 4, 5), [[[50]], [[200]]], np.uint8)
    for change in (lambda c: with_faults(KEY, c, 0.1), lambda c: c.drawn(KEY, c),
                   lambda c: with_noise_histogram(KEY, c, noise, noise)):
        assert bytes_of(change(other)) == bytes_of(change(camera))
    one, two = (simulate(KEY, video, [0, 1000], c) for c in (camera, other))
    np.testing.assert_array_equal(one.t, two.t)


@pytest.mark.parametrize("call", [
    lambda camera, noise: with_faults(0, camera), lambda camera, noise: with_faults(KEY, None),
    lambda camera, noise: with_noise_histogram(0, camera, noise, noise),
    lambda camera, noise: with_noise_histogram(KEY, camera, noise, "dark.npz")])
def test_what_is_no_key_camera_or_histogram_is_refused(call: Callable) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        call(Camera.constant((4, 5)), NoiseHistogram(np.ones((3, 71))))


@pytest.mark.parametrize(("said", "make"), [
    ("EV002.*theta_on has shape", lambda c: Camera.constant((4, 5), np.ones(3))),
    ("EV020.*key is 0", lambda c: c.drawn(0, c)),
    ("EV020.*std is of type int", lambda c: c.drawn(jax.random.key(0), 3)),
    ("EV020.*foo hold objects", lambda c: c.save("a.npz", foo=object()))])
def test_what_is_no_argument_is_refused(said: str, make: Any) -> None:
    with pytest.raises(EvflowDataError, match=said):
        make(Camera.constant((4, 5)))

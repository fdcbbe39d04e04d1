"""Camera, SensorModel and the prior: what is refused, what survives a file, what is drawn."""

from __future__ import annotations

import dataclasses
import os
import pickle
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.videos import code_of

from evflow.camera import (
    PARAMETERS,
    THETA_MIN,
    Camera,
    CameraPrior,
    Summary,
    noise_of_threshold,
    sample_nominal,
    sample_pixels,
)
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError

SHAPE = (4, 6)


@pytest.mark.parametrize("prior", [CameraPrior(), CameraPrior(noise="independent", eta_spread=0.3)])
def test_a_key_draws_the_same_camera_in_double_precision(prior: CameraPrior) -> None:
    def drawn() -> tuple[Camera, Camera]:
        camera = Camera.sample(jax.random.key(3), SHAPE, prior)
        return camera, camera.drawn(jax.random.key(4), camera)

    single = drawn()
    with jax.enable_x64(True):
        double = drawn()
    for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        assert b.dtype == jnp.float32
        np.testing.assert_array_equal(a, b)
    with pytest.raises(EvflowDataError, match=r"EV015.*\(4, 6\)"):
        single[0].drawn(jax.random.key(0), Camera.constant((2, 4, 6)))


def altered(name: str, value: Any, at: tuple[int, ...] | None = (1, 2)) -> Camera:
    """A valid camera but for one value, or one whole map where `at` is None."""
    camera = Camera.constant(SHAPE, eta_on=0.1, eta_off=0.1)
    changed = value if at is None else getattr(camera, name).at[at].set(value)
    return dataclasses.replace(camera, **{name: changed})


def same(a: Camera, b: Camera) -> bool:
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in PARAMETERS)


@pytest.mark.parametrize("shape", [(0, 0), (0, 4), (3, 0)])
def test_maps_without_pixels_are_no_camera(tmp_path: Path, shape: tuple[int, int]) -> None:
    path = tmp_path / "camera.npz"
    np.savez(path, **{name: np.ones(shape, np.float32) for name in PARAMETERS})
    with pytest.raises(EvflowDataError, match=r"EV002.*no pixel"):
        Camera.load(path)


def test_constant_cameras() -> None:
    camera = Camera.constant((3, *SHAPE), 0.3, 0.15, 1.0, 0.5)
    assert camera.shape == (3, *SHAPE)
    for name, value in zip(PARAMETERS, (0.3, 0.15, 1.0, 0.5), strict=True):
        array = getattr(camera, name)
        assert array.dtype == jnp.float32
        np.testing.assert_allclose(array, value, rtol=1e-6)
    assert float(Camera.constant(SHAPE).eta_on.max()) == 0.0


@pytest.mark.parametrize(("made", "code", "said"), [
    (lambda: Camera.constant((4.5, 3)), "EV002", "shape is (4.5, 3)"),
    (lambda: Camera.constant((-1, 3)), "EV002", "whole numbers"),
    (lambda: Camera.constant(5), "EV002", "shape is 5"),
    (lambda: Camera.constant((4, 5), theta_off="a"), "EV014", "theta_off='a'"),
    (lambda: Camera.constant((4, 5), eta_on=None), "EV014", "eta_on=None"),
    (lambda: Camera.sample(0, (4, 5)), "EV020", "key is 0"),
    (lambda: Camera.sample(jax.random.key(0), (4,)), "EV002", "shape is (4,)"),
    (lambda: Camera.sample(jax.random.key(0), (4, 5), "x"), "EV020", "expected CameraPrior"),
    (lambda: Camera.sample(jax.random.split(jax.random.key(0)), (4, 5)), "EV020", "keys[0]")])
def test_what_is_no_argument_is_named(made: Any, code: str, said: str) -> None:
    with pytest.raises(EvflowDataError, match=f"{code}.*{re.escape(said)}"):
        made()


def test_keys_and_thresholds_may_be_traced() -> None:
    for key in (jax.random.key(0), jax.random.PRNGKey(0)):
        assert jax.jit(lambda k: Camera.sample(k, (4, 5)))(key).shape == (4, 5)
    keys = jax.random.split(jax.random.key(0), 3)
    assert jax.vmap(lambda k: Camera.sample(k, (4, 5)))(keys).theta_on.shape == (3, 4, 5)
    assert jax.jit(lambda t: Camera.constant((np.int64(4), 5), t))(0.3).shape == (4, 5)


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf, -np.inf])
def test_impossible_values_are_ev014_with_their_place(name: str, value: float) -> None:
    with pytest.raises(EvflowDataError, match=rf"EV014.*{name} is .* at index \(1, 2\) \(1 such"):
        altered(name, value).validate()


def test_thresholds_must_be_positive_but_silence_is_legal() -> None:
    assert code_of(lambda: altered("theta_on", 0.0).validate()) == "EV014"
    assert code_of(lambda: Camera.constant(SHAPE, theta_off=0.0)) == "EV014"
    assert code_of(lambda: altered("eta_on", 0.0).validate()) == ""


@pytest.mark.parametrize("value", ["a", None, 0.1j])
def test_maps_that_hold_no_real_numbers_are_ev014(value: Any) -> None:
    with pytest.raises(EvflowDataError, match=r"EV014.*eta_on has dtype"):
        altered("eta_on", np.full(SHAPE, value), None).validate()


def test_shapes_are_checked() -> None:
    assert code_of(lambda: altered("eta_off", jnp.zeros((4, 5)), None).validate()) == "EV015"
    assert code_of(lambda: Camera.constant((4,))) == "EV002"
    assert code_of(lambda: Camera(*[np.float32(0.2)] * 4).validate()) == "EV002"


def test_cameras_are_pytrees_and_traced_ones_are_not_checked() -> None:
    camera = Camera.sample(jax.random.key(0), (2, *SHAPE))
    doubled = jax.jit(lambda c: jax.tree.map(lambda m: 2 * m, c.validate()))(camera)
    np.testing.assert_allclose(doubled.theta_on, 2 * camera.theta_on)
    assert jax.vmap(lambda c: c.theta_on.sum())(camera).shape == (2,)
    assert [leaf.shape for leaf in jax.tree.leaves(camera)] == [(2, *SHAPE)] * 4
    with pytest.raises(dataclasses.FrozenInstanceError):
        camera.theta_on = camera.theta_off  # type: ignore[misc]


def test_file_round_trip_keeps_every_bit_and_the_extras(tmp_path: Path) -> None:
    camera = Camera.sample(jax.random.key(1), (2, *SHAPE))
    valid = np.arange(24).reshape(SHAPE) % 3 > 0
    path = camera.save(tmp_path / "sub" / "camera.npz", valid=valid)
    assert path == tmp_path / "sub" / "camera.npz"
    assert same(Camera.load(path), camera)
    with np.load(path) as data:
        np.testing.assert_array_equal(data["valid"], valid)
        assert "natural log" in str(data["meta"])


def test_numpy_and_float64_maps_are_saved_as_float32(tmp_path: Path) -> None:
    path = Camera(*(np.full(SHAPE, 0.25) for _ in PARAMETERS)).save(tmp_path / "c.npz")
    assert Camera.load(path).theta_off.dtype == jnp.float32
    assert same(Camera.load(path), Camera.constant(SHAPE, 0.25, 0.25, 0.25, 0.25))


def test_saving_never_overwrites_unasked_nor_writes_nonsense(tmp_path: Path) -> None:
    path = Camera.constant(SHAPE).save(tmp_path / "c.npz")
    other = Camera.constant(SHAPE, 0.4)
    assert code_of(lambda: other.save(path)) == "EV013"
    assert same(Camera.load(path), Camera.constant(SHAPE))
    other.save(path, overwrite=True)
    assert same(Camera.load(path), other)
    assert code_of(lambda: altered("eta_on", -1.0).save(tmp_path / "bad.npz")) == "EV014"
    assert code_of(lambda: other.save(tmp_path / "bad.npz", theta_on=np.ones(3))) == "EV020"
    assert os.listdir(tmp_path) == ["c.npz"]


def test_missing_files_and_strangers(tmp_path: Path) -> None:
    assert code_of(lambda: Camera.load(tmp_path / "none.npz")) == "EV016"
    assert code_of(lambda: Camera.load(tmp_path)) == "EV016"
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    assert code_of(lambda: Camera.load(tmp_path / "other.npz")) == "EV008"
    np.save(tmp_path / "array.npy", np.zeros(3))
    assert code_of(lambda: Camera.load(tmp_path / "array.npy")) == "EV008"
    np.savez(tmp_path / "text.npz", **{n: np.full(SHAPE, "a") for n in PARAMETERS})
    assert code_of(lambda: Camera.load(tmp_path / "text.npz")) == "EV009"
    np.savez(tmp_path / "zero.npz", **{n: np.zeros(SHAPE) for n in PARAMETERS})
    assert code_of(lambda: Camera.load(tmp_path / "zero.npz")) == "EV014"


class Intruder:
    """Unpickling it leaves a trace on the disk."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return Path.touch, (self.trace,)


def test_pickles_are_refused_unopened(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    maps = {n: np.array([Intruder(trace)], object) for n in PARAMETERS}
    np.savez(tmp_path / "objects.npz", **maps)
    (tmp_path / "plain.npz").write_bytes(pickle.dumps(Intruder(trace)))
    for name, code in (("objects.npz", "EV008"), ("plain.npz", "EV009")):
        assert code_of(lambda name=name: Camera.load(tmp_path / name)) == code
    assert not trace.exists()


def outcome(path: Path, camera: Camera) -> str:
    """The code of the refusal; "" where the file was read, and then it must be `camera`."""
    loaded: list[Camera] = []
    code = code_of(lambda: loaded.append(Camera.load(path)))
    assert code or same(loaded[0], camera)
    return code


def test_damaged_files_are_refused_or_harmless(tmp_path: Path) -> None:
    """Cut anywhere or with one bit turned, a file gives the same maps or a coded error."""
    camera = Camera.sample(jax.random.key(2), (2, 3))
    source = camera.save(tmp_path / "c.npz").read_bytes()
    path, refused = tmp_path / "damaged.npz", 0
    cuts = [source[:at] for at in range(0, len(source), 41)]
    turned = [source[:at] + bytes([source[at] ^ 1 << at % 8]) + source[at + 1 :]
              for at in range(0, len(source), 5)]
    for data in cuts + turned:
        path.write_bytes(data)
        code = outcome(path, camera)
        assert code in ("", "EV008", "EV009")
        refused += code != ""
    assert refused > len(cuts) + len(turned) // 4


@pytest.mark.parametrize(("option", "value"), [
    ("kind", "dvs"), ("timestamps", "slots"), ("log_map", "log"), ("cutoff_hz", -1.0),
    ("refractory_s", -1e-3), ("leak_hz", float("nan")), ("leak_jitter", -0.1),
    ("leak_fpn_decades", float("inf")), ("shot_hz", -5.0)])
def test_sensor_model_refuses_bad_options(option: str, value: Any) -> None:
    with pytest.raises(EvflowDataError, match=f"EV020.*{option}=") as raised:
        SensorModel(**{option: value})
    assert raised.value.fix


def test_sensor_model_is_hashable_and_compares_by_value() -> None:
    assert hash(SensorModel(leak_hz=1.0)) == hash(SensorModel(leak_hz=1.0))
    assert SensorModel(leak_hz=1.0) != SensorModel()


def test_noise_follows_the_threshold_by_equation_12() -> None:
    theta = jnp.array([0.01, 0.0556, 0.08, 0.1, 0.2, 0.3, 0.5, 2.0])
    expected = [1.0, 1.0, 1.0, 1.0, 4 / 13, 4 / 22, 0.1, 0.1]
    np.testing.assert_allclose(noise_of_threshold(theta), expected, rtol=1e-5)
    dense = np.asarray(noise_of_threshold(jnp.linspace(0.001, 1.0, 2000)))
    assert (np.diff(dense) <= 0).all()
    assert (dense.min(), dense.max()) == (pytest.approx(0.1), pytest.approx(1.0))
    assert np.isfinite(jax.vmap(jax.grad(noise_of_threshold))(theta)).all()


def test_same_key_same_bytes_other_key_other_camera() -> None:
    prior = CameraPrior(noise="mixed", eta_spread=0.3)
    first, again, other = (Camera.sample(jax.random.key(k), (2, *SHAPE), prior) for k in (5, 5, 6))
    assert same(first, again)
    for name in PARAMETERS:
        assert not np.array_equal(getattr(first, name), getattr(other, name))
    assert code_of(first.validate) == ""


def test_nominal_values_are_uniform_and_on_and_off_are_independent() -> None:
    """20,000 cameras: a mean of U(.1, .5) has sd .0008, a correlation sd .007; bounds at 4 sd."""
    prior = CameraPrior(mismatch=(0.02, 0.15))
    nominal = sample_nominal(jax.random.key(3), (20_000,), prior)
    for low, high, names in ((0.1, 0.5, ("theta_on", "theta_off")),
                             (0.02, 0.15, ("sigma_on", "sigma_off"))):
        for name in names:
            values = np.asarray(getattr(nominal, name))
            assert low <= values.min() < low + 1e-3
            assert high - 1e-3 < values.max() <= high
            spread = high - low
            assert values.mean() == pytest.approx(0.5 * (low + high), abs=0.0083 * spread)
            assert values.std() == pytest.approx(spread / np.sqrt(12), abs=0.006 * spread)
    for a, b in (("theta_on", "theta_off"), ("sigma_on", "sigma_off"), ("theta_on", "sigma_on")):
        assert abs(np.corrcoef(getattr(nominal, a), getattr(nominal, b))[0, 1]) < 0.028
    for side in ("on", "off"):
        tied = noise_of_threshold(getattr(nominal, f"theta_{side}"))
        gain = getattr(nominal, f"eta_{side}") / tied
        assert 0.25 - 1e-6 <= gain.min() < 0.26
        assert 0.99 < gain.max() <= 1.0 + 1e-6


def test_free_noise_is_log_uniform_and_mixed_is_either() -> None:
    draw = {noise: sample_nominal(jax.random.key(4), (20_000,), CameraPrior(noise=noise))
            for noise in ("eq12", "independent", "mixed", "none")}
    free = np.log(np.asarray(draw["independent"].eta_on))
    assert free.min() >= np.log(0.02) - 1e-5
    assert free.max() <= 1e-5
    assert free.mean() == pytest.approx(0.5 * np.log(0.02), abs=0.0083 * np.log(50))
    tied = np.asarray(draw["mixed"].eta_on == draw["eq12"].eta_on)
    assert tied.mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(20_000))
    np.testing.assert_array_equal(np.where(tied, draw["eq12"].eta_on, draw["independent"].eta_on),
                                  draw["mixed"].eta_on)
    assert not np.asarray(draw["none"].eta_on).any()


@pytest.mark.parametrize("sigma", [0.03, 0.15])
def test_pixels_spread_around_the_nominal_value(sigma: float) -> None:
    """90,000 pixels: sd of the median is 1.25 sigma/300, of sigma .0024 sigma; bounds at 4 sd."""
    prior = CameraPrior(theta=(0.3, 0.3), mismatch=(sigma, sigma), eta_spread=0.5)
    k_nominal, k_pixels = jax.random.split(jax.random.key(6))
    nominal = sample_nominal(k_nominal, (), prior)
    camera = sample_pixels(k_pixels, nominal, (300, 300), 0.5)
    on, off = np.asarray(camera.theta_on), np.asarray(camera.theta_off)
    for theta in (on, off):
        assert np.median(theta) == pytest.approx(0.3, abs=4 * 1.25 * sigma / 300)
        assert theta.min() >= np.float32(THETA_MIN)
        quartiles = np.percentile(theta, [25, 75])  # untouched by the clamp
        assert np.diff(quartiles) / 1.34898 == pytest.approx(sigma, rel=0.02)
    assert abs(np.corrcoef(on.ravel(), off.ravel())[0, 1]) < 4 / 300
    log_eta = np.log(np.asarray(camera.eta_on))
    assert log_eta.std() == pytest.approx(0.5, rel=4 * 0.0024)
    assert np.median(log_eta) == pytest.approx(float(jnp.log(nominal.eta_on)), abs=0.0085)
    clamped = float(np.mean(on == np.float32(THETA_MIN)))
    expected = {0.03: 0.0, 0.15: 0.0266}[sigma]  # P(N(.3, .15) < .01)
    assert clamped == pytest.approx(expected, abs=4 * np.sqrt(expected / 90_000))


def test_leading_axes_are_independent_cameras() -> None:
    camera = Camera.sample(jax.random.key(7), (2, *SHAPE), CameraPrior(mismatch=(0.01, 0.01)))
    assert camera.shape == (2, *SHAPE)
    for theta in (camera.theta_on, camera.theta_off):
        medians = np.median(theta, axis=(-2, -1))
        assert abs(medians[0] - medians[1]) > 0.02  # 10 sd of what mismatch alone could do
        assert not np.allclose(theta[0] - medians[0], theta[1] - medians[1], atol=1e-3)
    eta = np.asarray(camera.eta_on)
    np.testing.assert_array_equal(eta, np.broadcast_to(eta[..., :1, :1], eta.shape))


@pytest.mark.parametrize("bad", [
    {"noise": "x"}, {"theta": (0.0, 0.5)}, {"theta": (0.5, 0.1)}, {"mismatch": (-0.1, 0.1)},
    {"eta": (0.0, 1.0)}, {"theta": 0.2}, {"eta_spread": -1.0}, {"theta": ("a", "b")},
    {"eta_spread": "a"}, {"eta_spread": None}])
def test_bad_priors_are_named(bad: dict) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        CameraPrior(**bad)


def test_a_drawn_camera_is_as_uneven_as_estimates_and_errors_together() -> None:
    mean = Camera.constant((200, 200), 0.2, 0.3, 0.1, 0.1)
    std = Camera.constant((200, 200), 0.03, 0.04, 0.02, 1e-6)
    drawn = mean.drawn(jax.random.key(0), std)
    assert abs(float(drawn.theta_on.std()) - 0.03) < 1e-3
    assert abs(float(drawn.theta_off.mean()) - 0.3) < 1e-3
    np.testing.assert_allclose(drawn.eta_off, 0.1, atol=1e-5)
    wide = mean.drawn(jax.random.key(1), Camera.constant((200, 200), 5.0, 5.0, 5.0, 5.0))
    assert float(wide.validate().theta_on.min()) == pytest.approx(0.01)
    assert float(wide.eta_on.min()) == 0.0


def test_an_error_that_all_pixels_share_moves_the_camera_as_a_whole() -> None:
    """A median of thresholds known to a factor alone, with errors of .02 of each pixel's own."""
    shape, shared = (2, 50, 60), {"theta_on": 1.0, "theta_off": 0.5, "eta_on": 0.3}
    mean = Camera.constant(shape, 0.2, 0.2, 0.1, 0.1)
    std = Camera.constant(shape, np.hypot(0.2, 0.02), np.hypot(0.1, 0.02), 0.03, 0.02)
    cameras = [mean.drawn(jax.random.key(i), std, shared) for i in range(40)]
    for name, own in (("theta_on", 0.1), ("theta_off", 0.1), ("eta_on", 0.0)):
        maps = np.array([getattr(camera, name) for camera in cameras])
        middle = np.median(maps, (-2, -1))  # (40, 2)
        np.testing.assert_allclose(maps.std((-2, -1)) / middle, own, rtol=0.06, atol=1e-3)
        logs = np.log(middle / float(getattr(mean, name)[0, 0, 0]))
        assert logs.std() == pytest.approx(shared[name], rel=4 / np.sqrt(2 * 80))
        assert abs(logs.mean()) < 4 * shared[name] / np.sqrt(80)
        assert abs(np.corrcoef(logs.T)[0, 1]) < 4 / np.sqrt(40)
    alone = mean.drawn(jax.random.key(0), std)
    np.testing.assert_array_equal(cameras[0].eta_off, alone.eta_off)
    draws = jax.random.normal(jax.random.key(0), (4, *shape))
    np.testing.assert_array_equal(
        alone.theta_on, jnp.maximum(mean.theta_on + std.theta_on * draws[0], THETA_MIN))


def test_standard_deviations_come_with_an_estimate(tmp_path: Path) -> None:
    camera = Camera.constant((4, 5), 0.2, 0.3)
    plain, estimate, broken = (tmp_path / f"{n}.npz" for n in ("plain", "estimate", "broken"))
    camera.save(plain)
    assert Camera.load_with_std(plain)[1] is None
    errors = {f"{name}_std": np.full((4, 5), 0.01, np.float32) for name in PARAMETERS}
    camera.save(estimate, **errors)
    std = Camera.load_with_std(estimate)[1]
    assert std is not None
    np.testing.assert_allclose(std.eta_off, 0.01)
    camera.save(broken, **errors | {"theta_on_std": np.full((4, 5), -1.0)})
    with pytest.raises(EvflowDataError, match="EV009"):
        Camera.load_with_std(broken)


def test_it_is_shown_in_one_line() -> None:
    assert repr(Camera.constant((4, 5), 0.25)) == (
        "Camera(4x5, medians: theta_on 0.25, theta_off 0.2, eta_on 0, eta_off 0)")
    shown = []
    jax.jit(lambda c: shown.append(repr(c)) or c.theta_on)(Camera.constant((4, 5)))
    assert repr(jax.eval_shape(lambda: Camera.constant((4, 5)))) == "Camera(4x5)"
    assert shown == ["Camera(4x5)"]
    one = Summary(*map(jnp.float32, (0.25, 0.2, 0.1, 0.1, 0.03, 0.03)))
    assert repr(one).startswith("Summary(theta_on=0.25, theta_off=0.2, eta_on=0.1, ")
    several = jax.tree.map(lambda a: jnp.full(3, a), one)
    jax.jit(lambda s: shown.append(repr(s)) or s.theta_on)(several)
    assert [repr(several), shown[-1]] == ["Summary(3)"] * 2

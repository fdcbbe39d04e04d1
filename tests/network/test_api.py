"""The public network API: exactness, shapes, transformations, errors."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.compilation import precise
from helpers.networks import seen, small_params

from evflow import simulate_counts, simulate_voxels, squash, unsquash
from evflow.camera import PARAMETERS, Camera, Summary
from evflow.camera.sensors import SensorModel
from evflow.errors import EvflowDataError
from evflow.network import api, inference
from evflow.network.config import MODELS
from evflow.network.coordinates import camera_std, squash_summary, unsquash_summary
from evflow.network.posterior import evidence, posterior
from evflow.network.weights import load_weights


@pytest.fixture(scope="module")
def shipped() -> dict[str, Any]:
    return load_weights()


@pytest.fixture(scope="module")
def code() -> api.Code:
    voxels, dL, _ = seen()
    return api.encode(small_params(), voxels, dL.sum(-1))


def test_inverse_undoes_forward(code: api.Code) -> None:
    voxels, _, _ = seen()
    y, z, _ = api.forward(small_params(), voxels, code)
    np.testing.assert_allclose(api.inverse(small_params(), y, z, code), voxels, atol=1e-4)


def test_inverse_undoes_forward_on_trained_weights(shipped: dict[str, Any]) -> None:
    voxels, dL, camera = seen((24, 32))
    for code in (api.encode(shipped, voxels, dL.sum(-1)),
                 api.code_from_video(shipped, dL, camera)):
        y, z, _ = api.forward(shipped, voxels, code)
        back = api.inverse(shipped, y, z, code)
        assert float(jnp.abs(back - voxels).max()) <= 1e-3
        assert float((jnp.abs(back - voxels) / (1 + voxels)).max()) <= 1e-4


def test_inverse_undoes_forward_in_double_precision(shipped: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    voxels, dlogI = rng.poisson(0.3, (4, 5, 32)).astype(float), rng.normal(0, 0.3, (4, 5))
    dL = rng.normal(0, 0.1, (4, 5, 16))
    forward, inverse = (jax.jit(f, compiler_options=precise()) for f in (api.forward, api.inverse))
    with jax.enable_x64(True):
        for code in (api.encode(shipped, voxels, dlogI),
                     api.encode(shipped, voxels.astype(np.float32), dlogI.astype(np.float32)),
                     api.code_from_video(shipped, dL, Camera.constant((4, 5)))):
            y, z, _ = forward(shipped, voxels, code)
            again = inverse(shipped, y, z, code)
            assert {a.dtype for a in (y, z, again)} == {jnp.dtype("float64")}
            np.testing.assert_allclose(again, voxels, rtol=0, atol=1e-9)


def test_log_det_is_that_of_the_jacobian(shipped: dict[str, Any]) -> None:
    voxels, dL, camera = seen()
    for params in (shipped, small_params()):
        code = api.code_from_video(params, dL, camera)
        one = jax.tree.map(lambda a: a[:1, :1] if a.ndim >= 2 else a, code)

        def joined(x: Any, params: Any = params, one: Any = one) -> Any:
            y, z, _ = api.forward(params, x.reshape(1, 1, 32), one)
            return jnp.concatenate([y, z], -1).reshape(32)

        jacobian = jax.jacobian(joined)(voxels[0, 0])
        _, _, log_det = api.forward(params, voxels[:1, :1], one)
        expected = np.linalg.slogdet(np.asarray(jacobian, np.float64))[1]
        assert float(log_det[0, 0]) == pytest.approx(expected, abs=1e-4)


def test_estimate_agrees_with_forward(shipped: dict[str, Any]) -> None:
    voxels, dL, _ = seen()
    code = api.encode(shipped, voxels, dL.sum(-1))
    y, _, _ = api.forward(shipped, voxels, code)
    answer, std = api.estimate_y(shipped, voxels, dL.sum(-1))
    np.testing.assert_allclose(answer, y, rtol=1e-3, atol=1e-3)
    camera = api.estimate(shipped, voxels, dL.sum(-1))
    y6 = unsquash_summary(code.summary)[None, None]
    expected, _ = posterior(evidence(y, std), y6, jnp.zeros_like(y6))
    for name in PARAMETERS:
        np.testing.assert_allclose(getattr(camera, name), getattr(expected, name), rtol=1e-3)


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_half_precision_is_taken_within_jit_and_without(dtype: Any) -> None:
    voxels, dL, _ = seen()
    given = voxels.astype(dtype), dL.sum(-1).astype(dtype)
    eager = api.estimate(small_params(), *given, intensity=jnp.asarray(4.0, dtype))
    jitted = jax.jit(lambda v, d: api.estimate(
        small_params(), v, d, intensity=jnp.asarray(4.0, dtype)))(*given)
    np.testing.assert_allclose(eager.theta_on, jitted.theta_on, rtol=1e-4)
    assert eager.theta_on.dtype == jnp.float32


def test_bytes_of_another_order_are_numbers_all_the_same() -> None:
    voxels, dL, _ = seen()
    given = np.asarray(voxels), np.asarray(dL.sum(-1))
    native, swapped = (api.estimate(small_params(), *(a.astype(order) for a in given))
                       for order in ("<f4", ">f4"))
    jax.tree.map(np.testing.assert_array_equal, native, swapped)
    hidden = np.ma.masked_array(given[1], np.arange(given[1].size).reshape(given[1].shape) == 3)
    with pytest.raises(EvflowDataError, match=r"EV003.*masked"):
        api.estimate(small_params(), given[0], hidden)


@pytest.mark.parametrize("kind", [">f4", "list"])
def test_maps_may_be_lists_or_bytes_of_another_order(kind: str) -> None:
    _, dL, camera = seen()
    maps = [np.asarray(m) for m in jax.tree.leaves(camera)]
    other = Camera(*(m.tolist() if kind == "list" else m.astype(kind) for m in maps))
    for of in (unsquash, lambda c: api.code_from_video(small_params(), dL, c).summary):
        jax.tree.map(np.testing.assert_array_equal, of(other), of(camera))


def test_whole_numbers_pass_where_they_can_be_right() -> None:
    voxels, dL, _ = seen()
    whole, still = np.rint(voxels), np.zeros(dL.shape[:2])
    one, two = (api.estimate(small_params(), whole.astype(counts), still.astype(change))
                for counts, change in (("uint8", "int16"), ("float16", "float32")))
    jax.tree.map(np.testing.assert_array_equal, one, two)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # sums of half precision overflow
        api.estimate(small_params(), np.full(voxels.shape, 2000, np.float16), still)


def test_nothing_rests_on_implicit_dtypes() -> None:
    voxels, dL, camera = seen()
    slow = SensorModel(cutoff_hz=50.0)
    noisy = dataclasses.replace(camera, eta_on=camera.eta_on + 1.0)
    with jax.numpy_dtype_promotion("strict"):
        api.estimate(small_params(), voxels, dL.sum(-1))
        code = api.code_from_video(small_params(), dL, camera, sensor=slow, intensity=4.0)
        api.generate(small_params(), jax.random.key(1), camera, code)
        simulate_voxels(jax.random.key(0), jnp.full((3, *camera.shape), 4.0), noisy,
                        frame_dt_s=1e-3)
        simulate_counts(jax.random.key(0), jnp.full((3, *camera.shape), 4.0), noisy,
                        frame_dt_s=1e-3, model=SensorModel(timestamps="v2e", refractory_s=1e-4))


def test_estimate_on_leading_axes_is_each_alone() -> None:
    voxels, dL, _ = seen()
    dlogI = dL.sum(-1)
    batch = jnp.stack([voxels, voxels[::-1]])[None], jnp.stack([dlogI, dlogI[::-1]])[None]
    both = api.estimate(small_params(), *batch)
    assert both.theta_on.shape == (1, 2, *dlogI.shape)
    alone = api.estimate(small_params(), voxels[::-1], dlogI[::-1])
    mapped = jax.vmap(lambda v, d: api.estimate(small_params(), v, d))(batch[0][0], batch[1][0])
    for name in PARAMETERS:
        np.testing.assert_allclose(getattr(both, name)[0, 1], getattr(alone, name), rtol=2e-5)
        np.testing.assert_allclose(getattr(mapped, name)[1], getattr(alone, name), rtol=2e-5)


def test_estimate_takes_per_sequence_conditions() -> None:
    voxels, dL, _ = seen()
    dlogI = dL.sum(-1)
    window = jnp.array([0.02, 0.08])
    both = api.estimate(small_params(), jnp.stack([voxels] * 2), jnp.stack([dlogI] * 2),
                          window_s=window, intensity=jnp.array([3.0, 5.0]))
    one = api.estimate(small_params(), voxels, dlogI, window_s=0.08,
                         intensity=jnp.full(dlogI.shape, 5.0))
    np.testing.assert_allclose(both.theta_on[1], one.theta_on, rtol=2e-5)
    assert not np.allclose(both.theta_on[0], both.theta_on[1])


def test_estimate_passes_through_jit_and_grad() -> None:
    voxels, dL, _ = seen()
    dlogI = dL.sum(-1)
    jitted = jax.jit(api.estimate)(small_params(), voxels, dlogI)
    np.testing.assert_allclose(jitted.eta_on, api.estimate(small_params(), voxels, dlogI).eta_on,
                               rtol=2e-5)
    grads = jax.grad(lambda d: api.estimate(small_params(), voxels, d).theta_on.mean())(dlogI)
    assert np.isfinite(grads).all()
    assert float(jnp.abs(grads).max()) > 0


def test_estimate_compiles_once_per_shape() -> None:
    voxels, dL, _ = seen()
    dlogI = dL.sum(-1)
    api.estimate(small_params(), voxels, dlogI)
    before = inference._share._cache_size()
    for scale in (1.0, 2.0):
        api.estimate(small_params(), scale * voxels, scale * dlogI, window_s=0.03 * scale)
    assert inference._share._cache_size() == before


def test_stats_of_tiles_add_up_to_the_whole() -> None:
    voxels, dL, _ = seen()
    dlogI = dL.sum(-1)
    whole = api.summarize(small_params(), voxels, dlogI)
    parts = [api.summarize(small_params(), voxels[rows], dlogI[rows])
             for rows in (slice(0, 5), slice(5, None))]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4),
                 parts[0] + parts[1], whole)
    a, b = (api.finish(small_params(), s)[0] for s in (whole, sum(parts)))
    jax.tree.map(lambda u, v: np.testing.assert_allclose(u, v, rtol=1e-4), a, b)


def test_more_windows_shrink_the_std() -> None:
    voxels, dL, _ = seen()
    stats = api.summarize(small_params(), voxels, dL.sum(-1))
    many = jax.tree.map(lambda a: 100.0 * a, stats)
    one_std, many_std = (api.finish(small_params(), s)[1] for s in (stats, many))
    assert float(many_std.theta_on) < float(one_std.theta_on)
    assert float(many_std.eta_off) < float(one_std.eta_off)


def test_generate_replaces_the_summary() -> None:
    voxels, dL, camera = seen()
    code = api.code_from_video(small_params(), dL, camera)
    other = Camera.constant(camera.shape, 0.5, 0.4, 0.1, 0.1)
    key = jax.random.key(5)
    made = api.generate(small_params(), key, other, code)
    assert made.shape == voxels.shape
    z = jax.random.normal(key, (*camera.shape, 28))
    swapped = dataclasses.replace(code, summary=Summary(
        *(jnp.float32(v) for v in (0.5, 0.4, 0.1, 0.1, 0.0, 0.0))))
    np.testing.assert_allclose(
        made, api.inverse(small_params(), unsquash(other), z, swapped), atol=1e-5)


def test_log_prob_is_finite_and_per_pixel(shipped: dict[str, Any]) -> None:
    voxels, dL, camera = seen()
    score = api.log_prob(shipped, voxels, api.code_from_video(shipped, dL, camera))
    assert score.shape == camera.shape
    assert np.isfinite(score).all()


def test_negative_noise_is_nan_where_nothing_can_raise() -> None:
    rates = jnp.array([-0.1, 0.0, 0.5])
    y = jax.jit(lambda eta: unsquash(Camera(0.2 + 0 * eta, 0.2 + 0 * eta, eta, eta)))(rates)
    np.testing.assert_array_equal(np.isnan(y[:, 2:]).any(1), [True, False, False])


def test_squash_and_unsquash_are_inverse() -> None:
    y = jax.random.normal(jax.random.key(0), (5, 6, 4))
    np.testing.assert_allclose(unsquash(squash(y)), y, atol=1e-5)
    np.testing.assert_allclose(unsquash(squash(y[0, 0])), y[0, 0], atol=1e-5)  # of one pixel
    y6 = 0.5 * jax.random.normal(jax.random.key(1), (7, 6))
    np.testing.assert_allclose(unsquash_summary(squash_summary(y6)), y6, atol=1e-5)
    p = Camera.constant((2, 2), 0.3, 0.2, 0.5, 0.0)
    back = squash(unsquash(p, "tanh"), "tanh")
    np.testing.assert_allclose(back.theta_on, 0.3, rtol=1e-5)


@pytest.mark.parametrize("output", ["log", "tanh"])
def test_std_of_the_camera_follows_the_slope_of_its_coordinates(output: Any) -> None:
    y, std = jax.random.normal(jax.random.key(0), (5, 6, 4)), jnp.full((5, 6, 4), 0.1)
    _, slope = jax.jvp(lambda y: squash(y, output), (y,), (std,))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7),
                 camera_std(y, std, output), slope)


def summary(value: Any) -> Summary:
    return Summary(*[jnp.asarray(value, jnp.float32)] * 6)


def cropped(params: Any, voxels: Any, dlogI: Any, **altered: Any) -> api.Code:
    return dataclasses.replace(api.encode(params, voxels, dlogI), **altered)


def without_summary(params: Any) -> Any:
    return {name: {k: v for k, v in net.items() if k != "summary"} for name, net in params.items()}


@pytest.mark.parametrize(("code", "call"), [
    ("EV002", lambda p, v, d: api.estimate(p, v[..., :31], d)),
    ("EV002", lambda p, v, d: api.estimate(p, v, d[:-1])),
    ("EV002", lambda p, v, d: api.estimate(p, v[0], d[0])),
    ("EV007", lambda p, v, d: api.estimate(p, v.at[0, 0, 0].set(jnp.nan), d)),
    ("EV007", lambda p, v, d: api.estimate(p, v, d.at[0, 0].set(jnp.inf))),
    ("EV001", lambda p, v, d: api.estimate(p, v[:0, None], d[:0, None])),
    ("EV003", lambda p, v, d: api.estimate(p, v - 1.0, d)),
    ("EV003", lambda p, v, d: api.estimate(p, v * 0 - 0.1, d)),
    ("EV020", lambda p, v, d: api.estimate(p, v, d, window_s=0.0)),
    ("EV018", lambda p, v, d: api.estimate({"other": {}}, v, d)),
    ("EV018", lambda p, v, d: api.estimate({"default": {}}, v, d)),
    ("EV018", lambda p, v, d: api.estimate(jax.tree.map(lambda a: jnp.stack([a, a]), p), v, d)),
    ("EV018", lambda p, v, d: api.finish(without_summary(p), api.summarize(p, v, d))),
    ("EV020", lambda p, v, d: api.finish(p, sum(api.summarize(p, v, d) for _ in ()))),
    ("EV002", lambda p, v, d: api.estimate(p, v, d, window_s=np.full(3, 0.05))),
    ("EV002", lambda p, v, d: api.estimate(p, v, d, intensity=d.T[:2] * 0)),
    ("EV002", lambda p, v, d: api.estimate(p, v, d, intensity=np.full(d.shape[1], 3.0))),
    ("EV002", lambda p, v, d: api.estimate(p, v, d, intensity=np.full((d.shape[0], 1), 3.0))),
    ("EV003", lambda p, v, d: api.estimate(p, v, d, intensity=np.ma.masked_less(
        np.full(d.shape, 3.0) + np.eye(*d.shape), 3.5))),
    ("EV003", lambda p, v, d: api.estimate(p, v, d, intensity=np.full(d.shape, 128.0))),
    ("EV007", lambda p, v, d: api.estimate(p, v, d, intensity=np.full(d.shape, np.inf))),
    ("EV002", lambda p, v, d: api.forward(p, v[:-1], api.encode(p, v, d))),
    ("EV002", lambda p, v, d: api.log_prob(p, v[..., :30], api.encode(p, v, d))),
    ("EV002", lambda p, v, d: api.inverse(p, v[..., :4], v[..., :4], api.encode(p, v, d))),
    ("EV015", lambda p, v, d: api.generate(
        p, jax.random.key(0), Camera.constant((2, *d.shape)), api.encode(p, v, d))),
    ("EV002", lambda p, v, d: api.code_from_video(p, d, Camera.constant(d.shape))),
    ("EV003", lambda p, v, d: api.estimate(p, v.astype(complex), d)),
    ("EV003", lambda p, v, d: api.estimate(p, v, d, window_s="a")),
    ("EV003", lambda p, v, d: api.estimate(p, v, d, window_s=None)),
    ("EV020", lambda p, v, d: api.estimate(p, v, d, window_s=50_000)),
    ("EV003", lambda p, v, d: api.estimate(p, v, d + 100.0)),
    ("EV003", lambda p, v, d: api.estimate(p, v, jnp.sign(d).astype(jnp.int32))),
    ("EV003", lambda p, v, d: api.estimate(p, v, np.full(d.shape, -128, np.int8))),
    ("EV003", lambda p, v, d: api.estimate(p, v, d, intensity=-3.0)),
    ("EV003", lambda p, v, d: api.encode(p, v, d, summary=Camera.constant(d.shape))),
    ("EV002", lambda p, v, d: api.encode(p, v, d, summary=summary(np.ones(3)))),
    ("EV014", lambda p, v, d: api.encode(p, v, d, summary=summary(-0.1))),
    ("EV014", lambda p, v, d: api.encode(p, v, d, summary=summary(np.nan))),
    ("EV007", lambda p, v, d: api.forward(p, v * np.nan, api.encode(p, v, d))),
    ("EV007", lambda p, v, d: api.inverse(
        p, v[..., :4] * np.nan, v[..., :28], api.encode(p, v, d))),
    ("EV014", lambda p, v, d: api.generate(
        p, jax.random.key(0), Camera(*[d * 0 - 0.1] * 4), api.encode(p, v, d))),
    ("EV020", lambda p, v, d: api.generate(p, 0, Camera.constant(d.shape), api.encode(p, v, d))),
    ("EV020", lambda p, v, d: api.generate(p, jax.random.key(0), None, api.encode(p, v, d))),
    ("EV020", lambda p, v, d: api.generate(p, jax.random.key(0), Camera.constant(d.shape), None)),
    ("EV020", lambda p, v, d: api.forward(p, v, None)),
    ("EV020", lambda p, v, d: api.inverse(p, v[..., :4], v[..., :28], None)),
    ("EV018", lambda p, v, d: api.forward(p, v, cropped(p, v, d, changes=v[..., :16]))),
    ("EV018", lambda p, v, d: api.log_prob(p, v, cropped(p, v, d, changes=v[..., :16]))),
    ("EV018", lambda p, v, d: api.generate(
        p, jax.random.key(0), Camera.constant(d.shape), cropped(p, v, d, changes=v[..., :16]))),
    ("EV002", lambda p, v, d: api.forward(p, v, cropped(p, v, d, changes=v[:-1]))),
    ("EV014", lambda p, v, d: unsquash(Camera(*[d * 0 - 0.1] * 4))),
    ("EV020", lambda p, v, d: unsquash(v[..., :4])),
    ("EV020", lambda p, v, d: unsquash(Camera.constant(d.shape), "unknown")),  # type: ignore[arg-type]
    ("EV020", lambda p, v, d: squash(v[..., :4], None)),  # type: ignore[arg-type]
    ("EV002", lambda p, v, d: squash(v[..., :3])),
    ("EV007", lambda p, v, d: squash(v[..., :4] * np.nan)),
])
def test_bad_input_is_named(code: str, call: Any) -> None:
    voxels, dL, _ = seen()
    with pytest.raises(EvflowDataError) as caught:
        call(small_params(), voxels, dL.sum(-1))
    assert caught.value.code == code


def test_architecture_is_read_from_the_weights(shipped: dict[str, Any]) -> None:
    assert api.config_of(shipped) == MODELS["default"]
    assert api.config_of(small_params()).flow.steps == 2

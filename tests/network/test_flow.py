"""The flow: an exact bijection with an exact log-det, however its params were trained."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.errors import EvflowDataError
from evflow.network import flow
from evflow.network.flow import FlowConfig, actnorm, asinh, shuffle
from evflow.network.flow.config import Array, Params

DEFAULT = FlowConfig()
N = 512  # pixels; one size throughout saves compilations
SMALL = FlowConfig(channels=8, levels=2, steps=3, hidden=16, condition=5)
ONE_LEVEL = dataclasses.replace(SMALL, levels=1)
BARE = dataclasses.replace(SMALL, injector=False, asinh=False)  # as the paper has it
VARIANTS = {"whole": SMALL, "noinjector": dataclasses.replace(SMALL, injector=False),
            "noasinh": dataclasses.replace(SMALL, asinh=False), "bare": BARE}
variants = pytest.mark.parametrize("config", VARIANTS.values(), ids=VARIANTS)

data_init = jax.jit(flow.data_init, static_argnums=3)
forward = jax.jit(flow.forward, static_argnums=3)
inverse = jax.jit(flow.inverse, static_argnums=4)
fold = jax.jit(flow.fold, static_argnums=1)
forward_columns = jax.jit(flow.forward_columns, static_argnums=3)
forward_folded = jax.jit(flow.forward_folded, static_argnames=("config", "chunk"))


@pytest.fixture(autouse=True)
def _strict() -> Iterator[None]:
    with jax.numpy_rank_promotion("raise"):
        yield


def counts(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Zero-inflated, non-negative, with a tail to about 15: like voxels."""
    rng = np.random.default_rng(seed)
    return (rng.poisson(0.4, shape) * rng.gamma(4.0, 0.5, shape)).astype(np.float32)


def condition(shape: tuple[int, ...], seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@functools.cache
def new_params(config: FlowConfig) -> Params:
    x, u = counts((N, config.channels)), condition((N, config.condition))
    return data_init(flow.init(jax.random.key(0), config), x, u, config)


def move(params: Params, *, base: float = 0.0) -> Params:
    """Params as far from init as training takes them: raw ~ N(0, 1), last layers at gain .3,
    every bias by .1; optionally log-scales spread by `base`."""
    rng = np.random.default_rng(2)

    def one(path: tuple, leaf: Array) -> Array:
        room, name = path[1].key, path[-1].key
        noise = rng.standard_normal(leaf.shape).astype(np.float32)
        if name == "raw":
            return jnp.asarray(noise)
        if (room, name) in (("coupling", "w_3"), ("injector", "w_2")):
            return jnp.asarray(0.3 * noise / leaf.shape[-2] ** 0.5)
        gain = base if name == "base" else 0.1 if name[0] == "b" else 0.0
        return jnp.asarray(np.asarray(leaf) + np.float32(gain) * noise)

    return jax.tree_util.tree_map_with_path(one, params)


@functools.cache
def trained_params(config: FlowConfig) -> Params:
    """As trained from data; the small configs spread their actnorms at random instead, which
    spares a compilation each."""
    if config.channels == 32:
        return move(new_params(config))
    return move(flow.init(jax.random.key(0), config), base=0.3)


def to_x64(tree: Params) -> Params:
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), tree)


@pytest.mark.parametrize(("make", "config"), [
    (new_params, DEFAULT), (trained_params, DEFAULT), (trained_params, ONE_LEVEL),
], ids=["new", "trained", "one level"])
def test_inverse_undoes_forward(make, config):
    params, width = make(config), config.level_channels[-1]
    x, u = counts((N, config.channels), 3), condition((N, config.condition), 4)
    y, z, log_det = forward(params, x, u, config)
    again, log_det_inverse = inverse(params, y, z, u, config)
    assert (y.shape, z.shape) == ((N, width), (N, config.channels - width))
    np.testing.assert_allclose(again, x, rtol=0, atol=1e-4)
    np.testing.assert_allclose(log_det + log_det_inverse, 0.0, atol=1e-4)
    # The other order too: any y, z is the image of some voxels.
    target = condition(y.shape, 5), condition(z.shape, 6)
    y, z, _ = forward(params, inverse(params, *target, u, config)[0], u, config)
    np.testing.assert_allclose(y, target[0], rtol=0, atol=1e-4)
    np.testing.assert_allclose(z, target[1], rtol=0, atol=1e-4)


@pytest.mark.parametrize("config", [DEFAULT, BARE], ids=["default", "bare"])
def test_inverse_undoes_forward_in_double_precision(config):
    params = trained_params(config)
    x, u = counts((N, config.channels)), condition((N, config.condition))
    with jax.enable_x64(True):
        params, x, u = to_x64(params), to_x64(x), to_x64(u)
        y, z, log_det = forward(params, x, u, config)
        again, log_det_inverse = inverse(params, y, z, u, config)
        assert {a.dtype for a in (y, z, log_det, again, log_det_inverse)} == {jnp.dtype("float64")}
        np.testing.assert_allclose(again, x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(log_det + log_det_inverse, 0.0, atol=1e-9)


@variants
def test_log_det_is_that_of_the_jacobian(config):
    params, x, u = trained_params(config), counts((6, 8)), condition((6, 5))
    with jax.enable_x64(True):
        params, x, u = to_x64(params), to_x64(x), to_x64(u)

        def one(x: Array, u: Array) -> tuple[Array, Array]:
            def whole(x: Array) -> tuple[Array, Array]:
                y, z, log_det = flow.forward(params, x, u, config)
                return jnp.concatenate([y, z]), log_det
            return jax.jacfwd(whole, has_aux=True)(x)

        jacobian, log_det = jax.jit(jax.vmap(one))(x, u)
        expected = np.linalg.slogdet(jacobian)[1]
        np.testing.assert_allclose(log_det, expected, rtol=0, atol=1e-10)
        assert np.abs(expected).min() > 1e-3  # a log-det of 0 would be right by accident
        varies = config.injector or config.asinh
        assert np.ptp(log_det) > 0.01 if varies else np.ptp(log_det) == 0.0


def test_asinh_is_exact_from_tiny_to_huge():
    x = jnp.asarray([[-1e6, -3.0, -1e-4, 0.0, 1e-30, 1e-4, 1.0, 200.0, 1e15]], jnp.float32)
    h, log_det = asinh.forward(x)
    again, log_det_inverse = asinh.inverse(h)
    np.testing.assert_allclose(again, x, rtol=1e-5)
    exact = -0.5 * np.log1p(np.asarray(x[0], np.float64) ** 2)
    np.testing.assert_allclose(log_det, exact, rtol=1e-6, atol=2e-7)
    np.testing.assert_array_equal(log_det + log_det_inverse, 0.0)
    assert np.isfinite(jax.grad(lambda x: asinh.forward(x)[1].sum())(x)).all()


def test_data_init_whitens():
    x, u, params = counts((N, 32)), condition((N, 40)), new_params(DEFAULT)
    first = jax.tree.map(lambda leaf: leaf[0], params["level_0"]["actnorm"])
    h = actnorm.forward(jnp.exp(first["base"]), first["bias"], asinh.forward(x.T)[0])
    np.testing.assert_allclose(h.mean(axis=1), 0.0, atol=1e-5)
    np.testing.assert_allclose(h.std(axis=1), 1.0, atol=1e-5)
    y, z, _ = forward(params, x, u, DEFAULT)  # couplings start at zero: still white at the end
    for out in (y, z):
        np.testing.assert_allclose(out.mean(axis=0), 0.0, atol=1e-4)
        np.testing.assert_allclose(out.std(axis=0), 1.0, atol=1e-4)


def test_data_init_follows_the_couplings_before_it():
    x, u = counts((N, 8)), condition((N, 5))
    params = data_init(trained_params(SMALL), x, u, SMALL)
    assert float(jnp.abs(params["level_1"]["actnorm"]["base"]).max()) > 0.01
    assert float(jnp.abs(new_params(SMALL)["level_1"]["actnorm"]["base"]).max()) < 1e-5
    assert not params["level_0"]["actnorm"]["raw"].any()
    y, _, _ = forward(params, x, u, SMALL)  # the passive half of a last step is as normalised
    np.testing.assert_allclose(y[:, :2].std(axis=0), 1.0, atol=1e-4)


def test_silent_channels_are_magnified_once():
    silent, u = counts((N, 32)) * (np.arange(32) % 3 > 0), condition((N, 40))
    params = data_init(flow.init(jax.random.key(0), DEFAULT), silent, u, DEFAULT)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
    # An event on a channel that never had one: 1/MIN_STD = 20 times its asinh, not 20^16.
    x = np.concatenate([np.ones_like(silent[:1]), silent[1:]])
    y, z, _ = forward(params, x, u, DEFAULT)
    assert float(jnp.maximum(jnp.abs(y).max(), jnp.abs(z).max())) < 1.01 * 20 * np.arcsinh(1.0)
    np.testing.assert_allclose(inverse(params, y, z, u, DEFAULT)[0], x, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("config", "chunk"), [
    (DEFAULT, 100), (SMALL, None), (BARE, 128),
], ids=["default", "chunk by platform", "bare"])
def test_folded_is_the_same_function(config, chunk):
    params = trained_params(config)
    x, u = counts((16, 32, config.channels)), condition((16, 32, config.condition))
    y, z, _ = forward(params, x, u, config)
    got_y, got_z = forward_folded(fold(params, config), x, u, config=config, chunk=chunk)
    assert (got_y.shape, got_z.shape) == (y.shape, z.shape)
    size = max(1.0, float(jnp.abs(y).max()), float(jnp.abs(z).max()))
    np.testing.assert_allclose(got_y, y, rtol=0, atol=5e-6 * size)
    np.testing.assert_allclose(got_z, z, rtol=0, atol=5e-6 * size)


@pytest.mark.parametrize("config", [SMALL, BARE], ids=["whole", "bare"])
@pytest.mark.parametrize("at", [0, 2, 3])
def test_what_all_pixels_share_of_a_condition_can_be_settled(config, at):
    folded = fold(trained_params(config), config)
    values, x, own = condition((2,), 3), counts((N, 8)), condition((N, 3))
    u = np.concatenate([own[:, :at], np.tile(values[None], (N, 1)), own[:, at:]], axis=1)
    expected = forward_columns(folded, x.T, u.T, config)
    got = forward_columns(flow.settle(folded, values, at), x.T, own.T, config)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=2e-5), got, expected)


def test_jit_changes_nothing():
    params, x, u = trained_params(ONE_LEVEL), counts((N, 8)), condition((N, 5))
    expected = forward(params, x, u, ONE_LEVEL)
    with jax.disable_jit():
        got = flow.forward(params, x, u, ONE_LEVEL)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), got, expected)


def test_vmap_and_batch_agree():
    params = trained_params(SMALL)
    x, u = counts((3, 4, 8)), condition((3, 4, 5))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    run = functools.partial(flow.forward, params, config=SMALL)
    expected = forward(params, x, u, SMALL)
    jax.tree.map(close, jax.jit(jax.vmap(jax.vmap(run)))(x, u), expected)
    jax.tree.map(close, forward(params, x[1, 2], u[1, 2], SMALL), tuple(a[1, 2] for a in expected))
    assert [a.shape for a in forward(params, x[:0], u[:0], SMALL)] == [(0, 4, 4), (0, 4, 4), (0, 4)]


def scalar_loss(params: Params, x: Array, u: Array, config: FlowConfig) -> Array:
    y, z, log_det = flow.forward(params, x, u, config)
    shaped = jnp.sum(y * condition(y.shape, 7)) + jnp.sum(z * condition(z.shape, 8))
    return shaped + jnp.sum(log_det) + 0.5 * jnp.sum(y**2) + 0.5 * jnp.sum(z**2)


def scalar_loss_inverse(params: Params, x: Array, u: Array, config: FlowConfig) -> Array:
    width = config.level_channels[-1]
    again, log_det = flow.inverse(params, x[:, :width], x[:, width:], u, config)
    return jnp.sum(again * condition(again.shape, 7)) + jnp.sum(log_det)


@pytest.mark.parametrize("loss", [scalar_loss, scalar_loss_inverse], ids=["forward", "inverse"])
def test_every_parameter_learns_but_the_buffer(loss):
    config = SMALL
    x, u = condition((64, 8), 9), condition((64, 5))
    gradient = jax.jit(jax.grad(loss), static_argnums=3)
    grads = gradient(trained_params(config), x, u, config)
    for path, grad in jax.tree_util.tree_leaves_with_path(grads):
        where = jax.tree_util.keystr(path)
        assert np.isfinite(grad).all(), where
        if path[-1].key == "base":
            assert not grad.any(), where
        elif path[1].key == "injector":
            assert grad.any(), where
        else:  # every one of the stacked steps
            assert all(step.any() for step in grad), where


def test_new_flow_only_reorders():
    x, u = counts((N, 8)), condition((N, 5))
    y, z, log_det = forward(flow.init(jax.random.key(3), SMALL), x, u, SMALL)
    h, expected = asinh.forward(x.T)
    np.testing.assert_allclose(np.sort(jnp.concatenate([y, z], axis=1)), np.sort(h.T), rtol=1e-6)
    np.testing.assert_allclose(log_det, expected, rtol=1e-6, atol=1e-6)


def test_init_draws_every_step_apart():
    one, two = (flow.init(jax.random.key(seed), SMALL) for seed in (0, 1))
    w = one["level_0"]["coupling"]["w_2"]
    assert w.shape == (3, 16, 16)
    assert not np.array_equal(w[0], w[1])
    assert not np.array_equal(w, two["level_0"]["coupling"]["w_2"])
    np.testing.assert_allclose(w.std(), (2 / 16) ** 0.5, rtol=0.1)
    assert {leaf.dtype for leaf in jax.tree.leaves(one)} == {jnp.dtype("float32")}


def test_orders_are_permutations_fixed_for_good():
    orders = shuffle.orders(DEFAULT)
    assert [o.shape for o in orders] == [(16, 32), (16, 16), (16, 8), (16, 4)]
    for order in orders:
        np.testing.assert_array_equal(np.sort(order), np.tile(np.arange(order.shape[1]), (16, 1)))
        distinct = len(np.unique(order, axis=0))
        assert distinct == 16 or order.shape[1] == 4
        assert distinct > 8  # of 24 for four channels
    # Literal on purpose: trained weights are useless under other orders.
    assert orders[3][1].tolist() == [3, 1, 2, 0]
    assert orders[0][0].tolist() == [
        11, 3, 20, 13, 2, 21, 15, 1, 18, 25, 31, 19, 17, 8, 6, 24, 0, 23, 29, 22, 28, 30, 7, 14, 4,
        10, 12, 16, 5, 9, 27, 26]


def test_orders_mix_every_channel():
    """Within each level every channel is read by and moved by some coupling."""
    for order in shuffle.orders(DEFAULT):
        channels = np.arange(order.shape[1])
        read, moved = set(), set()
        for row in order:
            channels = channels[row]
            read |= set(channels[: len(row) // 2])
            moved |= set(channels[len(row) // 2 :])
        assert read == moved == set(range(order.shape[1]))


@pytest.mark.parametrize("bad", [
    {"channels": 30}, {"channels": 0}, {"levels": 6}, {"levels": 0}, {"steps": 0}, {"hidden": -1},
    {"condition": 0},
], ids=str)
def test_config_refuses(bad):
    with pytest.raises(EvflowDataError, match="EV020") as error:
        FlowConfig(**bad)
    assert next(iter(bad)) in str(error.value)

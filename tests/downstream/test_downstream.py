"""The event networks as pure functions, and the event tensors that they take."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.published_networks import HEIGHT, WIDTH, case_input
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.downstream import (
    E2VID,
    EVFlowNet,
    FireNet,
    Network,
    event_tensor,
    normalise,
    prepared,
    reconstruct,
    run,
    signed,
)
from evflow.downstream.tensor import reconstructions, windows_between
from evflow.errors import EvflowDataError
from evflow.types import Events
from evflow.voxel import voxelize

TINY = [E2VID(base=4, encoders=1, blocks=1), FireNet(base=4), EVFlowNet(base=4, scales=4),
        E2VID(base=4, encoders=1, blocks=0, skip="concat", norm="batch", decoder="transposed",
              output="sigmoid")]
tiny = pytest.mark.parametrize("network", TINY, ids=str)

apply = jax.jit(lambda network, *args: network.apply(*args), static_argnums=0)
run_jit = jax.jit(run, static_argnames=("network", "train"))


@tiny
def test_networks_are_pure_functions_on_any_batch(network: Network) -> None:
    params = network.init(jax.random.key(0), (HEIGHT, WIDTH))
    if isinstance(network, EVFlowNet):
        # Random flow of 256 px, which each scale feeds to the next, makes rounding thousandfold.
        params = jax.tree.map(lambda p: 0.25 * p, params)
    x = jnp.asarray(case_input())[:3]
    image, state = apply(network, params, x)  # three scenes at once, no state
    again, _ = apply(network, params, x)
    np.testing.assert_array_equal(image, again)
    lead = (3, 2) if isinstance(network, EVFlowNet) else (3,)
    assert image.shape == (*lead, HEIGHT, WIDTH)
    assert image.dtype == jnp.float32
    assert jax.tree.map(jnp.shape, state) == jax.tree.map(
        jnp.shape, network.start((3, HEIGHT, WIDTH)))
    one, _ = apply(network, params, x[1])
    np.testing.assert_allclose(one, image[1], atol=2e-6)
    with pytest.raises(EvflowDataError, match="EV002"):
        network.apply(params, x[..., :3])


@tiny
def test_scanned_unrolled_and_stepped_sequences_agree(network: Network) -> None:
    params = network.init(jax.random.key(0), (16, 16))
    x = jnp.asarray(case_input())[:4, :16, :16]
    scanned, end = run_jit(network, params, x)
    unrolled, _ = run_jit(network, params, x, train=True)
    np.testing.assert_allclose(scanned, unrolled, atol=1e-5)
    first, state = run_jit(network, params, x[:2])
    second, rest = run_jit(network, params, x[2:], state)
    np.testing.assert_allclose(jnp.concatenate([first, second]), scanned, atol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), rest, end)


@tiny
def test_sequences_and_states_that_do_not_fit_are_refused(network: Network) -> None:
    params = network.init(jax.random.key(0), (16, 16))
    x = jnp.asarray(case_input())[:, :16, :16]
    for train in (False, True):
        images, state = run(network, params, x[:0, None], train=train)  # of no window, no image
        assert len(images) == 0
        jax.tree.map(np.testing.assert_array_equal, state, network.start((1, 16, 16)))
    with pytest.raises(EvflowDataError, match="EV002"):
        run(network, params, x[0])
    if not isinstance(network, EVFlowNet):
        with pytest.raises(EvflowDataError, match="begin another size"):
            network.apply(params, x[0, :8], network.start((16, 16)))
        with pytest.raises(EvflowDataError, match="begin another size"):
            run(network, params, x[:, None], network.start((16, 16)))


def test_double_precision_follows_the_input() -> None:
    network = TINY[0]
    with jax.enable_x64(True):
        params = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64),
                              network.init(jax.random.key(0), (16, 16)))
        image, state = apply(network, params, jnp.asarray(case_input()[0], jnp.float64))
    assert image.dtype == jnp.float64
    assert {leaf.dtype for leaf in jax.tree.leaves(state)} == {jnp.dtype("float64")}


def test_statistics_of_batch_norm_get_no_gradient() -> None:
    network = TINY[-1]
    params = network.init(jax.random.key(0), (8, 8))
    x = jnp.asarray(case_input())[0, :8, :8]
    grads = jax.jit(jax.grad(lambda p: jnp.sum(network.apply(p, x)[0] ** 2)))(params)
    sizes = {path[-1].key: float(jnp.abs(g).sum())
             for path, g in jax.tree_util.tree_leaves_with_path(grads["decoder_0"])}
    assert sizes["mean"] == sizes["var"] == 0
    assert sizes["scale"] > 0


@pytest.mark.parametrize(("encoders", "scales"), [(3, 1), (4, 1), (4, 4)])
def test_a_fresh_flow_network_hears_its_events(encoders: int, scales: int) -> None:
    """Kernels by He, so that ReLUs leave the variance as it is, and a flow that starts near 0."""
    network = EVFlowNet(base=8, encoders=encoders, scales=scales)
    assert network.stride == 2**encoders
    params = network.init(jax.random.key(0), (16, 16))
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if path[-1].key == "kernel":
            gain = float(leaf.std()) * np.sqrt(np.prod(leaf.shape[:-1]))
            predicts = path[0].key.startswith("prediction")
            near = 0.1 / (1 if scales == 1 else 256) if predicts else np.sqrt(2.0)
            assert gain == pytest.approx(near, rel=0.4)
    x = jax.random.normal(jax.random.key(1), (2, 48, 40, 5))
    flow = np.asarray(apply(network, params, x)[0])
    assert flow.shape == (2, 2, 48, 40)
    assert 0 < flow.std() < 0.5


def test_the_four_scales_of_flow() -> None:
    network = EVFlowNet(base=4, scales=4)
    params = network.init(jax.random.key(0), (32, 48))
    pyramid = jax.jit(network.pyramid)
    flows = pyramid(params, jnp.ones((2, 32, 48, 5)))
    assert [f.shape for f in flows] == [(2, 2, 32 >> i, 48 >> i) for i in (3, 2, 1, 0)]
    flow, state = apply(network, params, jnp.ones((2, 32, 48, 5)))
    np.testing.assert_allclose(flow, flows[-1], atol=1e-5)
    assert state == ()
    # Each scale hears of the coarser one: a change of the first prediction reaches the last.
    params["prediction_0"]["conv"]["bias"] = params["prediction_0"]["conv"]["bias"] + 0.1
    other = pyramid(params, jnp.ones((2, 32, 48, 5)))
    assert float(jnp.abs(other[-1] - flows[-1]).max()) > 1e-3


@pytest.mark.parametrize("options", [
    {"decoder": "nearest"}, {"norm": "group"}, {"skip": "none"}, {"output": "relu"},
    {"encoders": 0}, {"base": 0}, {"base": "x"}, {"bins": 2.5}, {"padding": "wrap"}])
def test_unknown_options_are_refused(options) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        E2VID(**options)


def some_events(n: int = 400, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    return Events(rng.integers(0, 12, n), rng.integers(0, 8, n), np.sort(rng.integers(0, 9000, n)),
                  rng.integers(0, 2, n).astype(bool), (12, 8))


@given(n=st.integers(1, 60), bins=st.integers(2, 7), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_event_tensors_spread_each_event_over_two_bins(n: int, bins: int, seed: int) -> None:
    events = some_events(n, seed)
    grid = np.zeros((8, 12, bins))
    span = max(int(events.t[-1] - events.t[0]), 1)
    for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True):
        at = (bins - 1) * (int(t) - int(events.t[0])) / span
        grid[y, x] += (1 if p else -1) * np.maximum(0, 1 - np.abs(np.arange(bins) - at))
    np.testing.assert_allclose(event_tensor(events, bins), grid, atol=1e-5)


def test_split_tensors_count_each_polarity_apart() -> None:
    events = some_events()
    split = event_tensor(events, 10, split=True)
    np.testing.assert_allclose(split[..., :5] - split[..., 5:], event_tensor(events), atol=1e-5)
    assert split.min() >= 0
    np.testing.assert_allclose(split[..., 5:].sum((0, 1, 2)), (~events.p).sum(), rtol=1e-5)
    assert not event_tensor(events.slice(20_000, 30_000), 10, split=True).any()


@pytest.mark.parametrize(("bins", "split"), [(0, False), (5.0, False), (1, True), (5, True)])
def test_bins_that_cannot_be_are_refused(bins, split: bool) -> None:
    for events in (some_events(), some_events().slice(0, 0)):
        with pytest.raises(EvflowDataError, match="EV020"):
            event_tensor(events, bins, split)


def test_tensors_of_any_dtype_are_taken() -> None:
    network = FireNet(base=2)
    params = network.init(jax.random.key(0), (8, 12))
    tensor = np.rint(3 * event_tensor(some_events()))
    expected, _ = network.apply(params, tensor)
    for dtype in (np.float64, np.float16, np.int8, np.int64):
        np.testing.assert_array_equal(network.apply(params, tensor.astype(dtype))[0], expected)
        assert run(network, params, tensor[None].astype(dtype))[0].dtype == np.float32


def test_silence_is_a_tensor_of_zeros() -> None:
    silent = some_events().slice(20_000, 30_000)
    assert not event_tensor(silent).any()
    assert not np.asarray(normalise(jnp.asarray(event_tensor(silent)))).any()


def test_signed_voxels_are_on_minus_off() -> None:
    events = some_events()
    both = voxelize(events, 0, 10_000, 5)
    ours = np.asarray(signed(jnp.asarray(both)))
    assert ours.shape == (8, 12, 5)
    np.testing.assert_allclose(ours.sum(), 2.0 * events.p.sum() - len(events), atol=1e-3)


def test_normalised_tensors_have_mean_0_and_deviation_1_where_not_0() -> None:
    tensor = jnp.asarray(np.stack([event_tensor(some_events(seed=i)) * (i + 1) for i in (0, 1)]))
    out = np.asarray(normalise(tensor))
    for one, was in zip(out, np.asarray(tensor), strict=True):
        some = was != 0
        np.testing.assert_allclose([one[some].mean(), one[some].std()], [0, 1], atol=1e-5)
        assert not one[~some].any()


def test_normalised_tensors_have_gradients_without_events_and_of_one() -> None:
    lone = np.zeros((3, 8, 12, 5), np.float32)
    lone[1, 2, 3, 4] = 1.0
    lone[2] = event_tensor(some_events())
    gradient = jax.grad(lambda tensor: (normalise(tensor) ** 3).sum())(jnp.asarray(lone))
    assert bool(jnp.isfinite(gradient).all())
    assert bool(gradient[2].any())


def test_each_frame_sees_the_events_since_the_one_before() -> None:
    times = np.array([0, 5, 5, 10, 20])
    windows = windows_between(times, np.array([5, 7, 15]))
    assert [times[w].tolist() for w in windows] == [[0, 5, 5], [], [10]]


def test_reconstruct_is_apply_window_by_window() -> None:
    events, network = some_events(), FireNet(base=4)
    params = network.init(jax.random.key(0), (8, 12))
    images = reconstruct(network, params, events, np.array([3000, 6000, 9000]), normalised=True)
    tensors = [normalise(jnp.asarray(event_tensor(events.slice(a, b))))
               for a, b in ((0, 3001), (3001, 6001), (6001, 9001))]
    expected, _ = run_jit(network, params, jnp.stack(tensors))
    np.testing.assert_allclose(images, expected, atol=1e-5)
    for times, code in (([], "EV001"), ([5, 3], "EV004"), ([0.5, 1.0], "EV003")):
        with pytest.raises(EvflowDataError, match=code):
            reconstruct(network, params, events, np.array(times))
    with pytest.raises(EvflowDataError, match="EV004"):
        reconstruct(network, params, events, np.array([5, 3], np.uint64))


def test_a_window_without_events_may_repeat_the_image() -> None:
    events, network = some_events(), FireNet(base=4)
    params = network.init(jax.random.key(0), (8, 12))
    times = np.array([3000, 3000, 3000, 6000])  # the second and the third hold nothing
    given = np.stack(list(reconstructions(network, params, events, times, hold=True)))
    np.testing.assert_array_equal(given[1:3], given[:1].repeat(2, 0))
    np.testing.assert_array_equal(given[[0, 3]], reconstruct(
        network, params, events, times[[0, 3]]))
    assert not np.array_equal(reconstruct(network, params, events, times)[1], given[0])
    first = np.array([-1, 3000])  # nothing to repeat yet
    np.testing.assert_array_equal(
        np.stack(list(reconstructions(network, params, events, first, hold=True))),
        reconstruct(network, params, events, first))




def test_split_tensors_are_scaled_as_s2r_scales_them() -> None:
    """The 95th percentile of all entries becomes 1; where most are 0, nothing is changed."""
    few, many = some_events(15), some_events(4000)
    np.testing.assert_array_equal(prepared(few, 10, split=True), event_tensor(few, 10, split=True))
    raw, made = event_tensor(many, 10, split=True), prepared(many, 10, split=True)
    rank = np.sort(raw, axis=None)[round(0.95 * (raw.size - 1))]
    np.testing.assert_allclose(made, np.minimum(raw, rank) / rank, rtol=1e-6)
    assert (made.max(), raw.max() > 1) == (1.0, True)
    np.testing.assert_array_equal(prepared(many, 5), event_tensor(many, 5))
    assert not prepared(many.slice(20_000, 30_000), 10, split=True).any()

"""Each equation against a calculation by hand."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.compilation import often

from evflow.training import losses
from evflow.training.config import LossConfig
from evflow.training.objective import total_loss

event_loss = jax.jit(losses.event_loss, static_argnames="config")


def test_condition_loss_is_least_at_the_target() -> None:
    target = jnp.float32(0.02)
    logits = jnp.linspace(-8.0, 0.0, 4001)
    best = logits[jnp.argmin(losses.condition_loss(logits, target))]
    assert float(jax.nn.sigmoid(best)) == pytest.approx(0.02, rel=0.02)
    # Eq. 6 by hand: |0.5 - 0.2|^2 * ln 2 at logit 0, whatever the target's entropy split.
    assert float(losses.condition_loss(jnp.zeros(()), jnp.float32(0.2))) == pytest.approx(
        0.3**2 * np.log(2.0), rel=1e-5)


def test_parameter_loss_by_hand() -> None:
    a, b = jnp.array([0.3, 0.2, 0.0, 0.1]), jnp.array([0.1, 0.2, 0.0, 0.1])
    assert float(losses.parameter_loss(a, b)) == pytest.approx(np.sqrt(0.04 + 1e-6), rel=1e-5)
    assert float(losses.parameter_loss(a, a)) == pytest.approx(1e-3, rel=1e-4)
    assert float(losses.parameter_loss(a, b, 0.5)) == pytest.approx(np.sqrt(0.01 + 1e-6), rel=1e-5)


def test_confidence_weights_have_mean_one() -> None:
    voxels = jnp.abs(jax.random.normal(jax.random.key(0), (5, 3, 3, 32)))
    weights = losses.confidence_weight(voxels)
    assert float(weights.mean()) == pytest.approx(1.0, rel=1e-5)
    assert int(jnp.argmax(weights)) == int(jnp.argmax(voxels.sum((1, 2, 3))))


def test_flow_losses_are_negatives() -> None:
    assert float(losses.flow_loss(jnp.float32(1.0), jnp.float32(2.0), jnp.float32(4.0))) == -7.0
    assert float(losses.inverse_flow_loss(jnp.float32(3.0))) == -3.0


def test_event_loss_sees_edges_and_noise() -> None:
    voxels = np.abs(np.random.default_rng(0).standard_normal((8, 8, 32), np.float32))
    exact = np.arcsinh(voxels)
    moving, still = np.full((8, 8), np.float32(0.5)), np.zeros((8, 8), np.float32)
    config, small = LossConfig(patches=(4, 8), edge=0.1), LossConfig(patches=(4,), edge=0.1)
    for dL in (moving, still):
        assert float(event_loss(exact, voxels, dL, voxels, config)) < 3e-3
        assert float(event_loss(exact + 0.5, voxels, dL, voxels, config)) > 0.02
    # In a still patch only the number of events counts: shuffled in time costs nothing.
    shuffled = np.arcsinh(np.concatenate([voxels[..., 15::-1], voxels[..., :15:-1]], -1))
    assert float(event_loss(shuffled, voxels, still, voxels, small)) < 1e-5
    assert float(event_loss(shuffled, voxels, moving, voxels, small)) > 0.1


def test_in_still_patches_as_many_events_as_expected_are_wanted() -> None:
    """Though the count that is made scatters by the latents' noise."""
    rng, shape = np.random.default_rng(0), (4000, 4, 4, 2)
    true = rng.poisson(0.16, shape).astype(np.float32)
    noise = 0.6 * rng.standard_normal(shape, np.float32)  # 2.4 of a patch's 2.6 events
    expected, still = np.full(shape, np.float32(0.16)), np.zeros(shape[:-1], np.float32)
    config = LossConfig(patches=(4,), edge=0.1)

    def loss(scale: jax.Array) -> jax.Array:
        made = jnp.arcsinh(scale * expected + noise)
        return losses.event_loss(made, true, still, expected, config).mean()

    slopes = jax.jit(jax.vmap(jax.grad(loss)))(jnp.linspace(0.8, 1.2, 41))
    assert float(np.linspace(0.8, 1.2, 41)[np.argmin(np.abs(slopes))]) == pytest.approx(1, abs=0.03)


def test_elu_lets_counts_below_none_cost_little() -> None:
    """sigma_3 of Eq. 9: above 0 the counts themselves are compared, below no more than -1."""
    voxels, moving = np.full((4, 4, 32), np.float32(3)), np.full((4, 4), np.float32(0.5))

    def loss(made: float, true: np.ndarray = voxels) -> float:
        generated = np.arcsinh(np.full(true.shape, np.float32(made)))
        return float(event_loss(
            generated, true, moving, true, LossConfig(patches=(4,), edge=0.1, elu=True)))

    assert loss(3.0) == pytest.approx(1e-3, rel=1e-3)
    assert loss(5.0) == pytest.approx(2.0, rel=1e-3)
    assert loss(-50.0, 0.0 * voxels) == pytest.approx(1.0, rel=1e-3)


def test_a_gradient_of_the_image_is_an_edge() -> None:
    ramp = jnp.broadcast_to(0.2 * jnp.arange(8.0), (8, 8))
    image = jnp.concatenate([ramp, jnp.full((8, 8), 1.4)], 1)
    steep = losses.gradient(image)
    assert steep.shape == image.shape
    assert float(steep[4, 3]) == pytest.approx(0.2, rel=1e-4)
    weight = losses.edge_weight(steep, 4, 0.2)
    assert weight.shape == (8,)
    np.testing.assert_allclose(weight[jnp.array([0, 3])], [1.0, 0.0], atol=1e-4)


def test_event_loss_survives_wild_flows() -> None:
    voxels = jnp.zeros((4, 4, 32))
    grad = jax.jit(jax.grad(lambda g: losses.event_loss(
        g, voxels, voxels[..., 0], voxels, LossConfig(patches=(4,)))))
    assert np.isfinite(grad(jnp.full((4, 4, 32), 200.0))).all()


@partial(jax.jit, compiler_options=often())
def dispersion_slopes(tried: jax.Array, true: jax.Array) -> jax.Array:
    return jax.lax.map(jax.grad(
        lambda made: losses.dispersion(made, true, jax.nn.relu(made) + 0.1).mean()), tried)


@pytest.mark.parametrize("mean", [0.05, 0.7, 20.0])
def test_dispersion_is_least_at_the_mean(mean: float) -> None:
    """Rare events have median 0, and weights that know the truth would favour fewer."""
    true = np.random.default_rng(0).poisson(mean, 200_000).astype(np.float32)
    tried = np.linspace(0.5 * mean, 1.5 * mean, 201, dtype=np.float32)
    best = tried[np.argmin(np.abs(dispersion_slopes(tried, true)))]
    assert float(best) == pytest.approx(mean, rel=0.03)


def test_rate_loss_wants_expected_events_in_every_bin() -> None:
    voxels = np.random.default_rng(1).poisson(0.3, (2000, 4, 4, 32)).astype(np.float32)

    @jax.jit
    def loss(made: jax.Array) -> jax.Array:
        return losses.rate_loss(jnp.broadcast_to(jnp.arcsinh(made), voxels.shape), voxels,
                                jnp.full(voxels.shape, 0.4), (4,)).mean()

    even = np.full((32,), np.float32(0.3))
    uneven = np.where(np.arange(32) < 16, 0.5 * even, 1.5 * even)
    assert float(loss(even)) < float(loss(0.7 * even))
    assert float(loss(even)) < float(loss(1.3 * even))
    # The right total at the wrong times is worse.
    assert float(loss(even)) < float(loss(uneven))
    assert np.isfinite(jax.grad(loss)(np.full((32,), np.float32(1e4)))).all()


@pytest.mark.parametrize(("loss", "weight"), [
    (2.3e3, 1e-3), (-47.0, 0.1), (9.99, 1.0), (0.01, 1.0), (10.0, 0.1)])
def test_adaptive_weight(loss: float, weight: float) -> None:
    assert float(losses.adaptive_weight(jnp.float32(loss))) == pytest.approx(weight, rel=1e-5)


def test_adaptive_weight_has_no_gradient() -> None:
    scaled = jax.grad(lambda x: losses.adaptive_weight(x) * x)(jnp.float32(50.0))
    assert float(scaled) == pytest.approx(0.1)


@pytest.mark.parametrize("adaptive", [True, False])
def test_the_total_is_the_weighted_sum_of_all_parts(adaptive: bool) -> None:
    """Eq. 11, and the gradient of each part in it is its weight."""
    names = ("condition", "change_l1", "parameter", "flow", "event", "inverse_flow", "summary",
             "spread")
    weights = {name: 0.5 + i for i, name in enumerate(names)}
    values = dict(zip(names, (0.3, 2.0, 47.0, -310.0, 2300.0, -5.0, 0.7, 12.0), strict=True))
    scales = dict(zip(names, (1.0, 1.0, 0.1, 0.01, 1e-3, 1.0, 1.0, 0.1), strict=True))
    config = LossConfig(**weights, adaptive=adaptive)
    total, grads = jax.value_and_grad(total_loss)(
        {name: jnp.float32(value) for name, value in values.items()}, config)
    factors = {n: weights[n] * (scales[n] if adaptive else 1.0) for n in names}
    assert float(total) == pytest.approx(sum(factors[n] * values[n] for n in names), rel=1e-5)
    assert {n: float(g) for n, g in grads.items()} == pytest.approx(factors, rel=1e-5)


def test_summary_loss_pulls_the_std_to_the_error() -> None:
    y, target = jnp.full((6,), 0.3), jnp.zeros((6,))
    stds = jnp.linspace(0.05, 1.0, 400)
    values = jax.vmap(lambda s: losses.summary_loss(y, jnp.full((6,), s), target).mean())(stds)
    assert float(stds[jnp.argmin(values)]) == pytest.approx(0.3, abs=0.01)

"""The convolution of the event networks is XLA's, whatever way its kernel gradient takes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from evflow.downstream import convolution
from evflow.downstream.convolution import convolve, for_flax

# (..., H, W, C), k, F: one strip and several, rows and images that do not fill the last block,
# no batch and two of them, more pixels than a block in one row, one pixel, a product of fewer
# pixels; and no neighbours.
SHAPES = [((2, 5, 7, 8), 3, 4), ((3, 23, 29, 8), 3, 6), ((7, 9, 9, 9), 5, 3), ((19, 13, 8), 5, 8),
          ((2, 3, 8, 11, 8), 3, 5), ((1, 3, 300, 8), 3, 2), ((150, 1, 1, 8), 3, 31),
          ((2, 7, 20, 64), 3, 31), ((2, 5, 7, 8), 1, 4)]


def plain(x: jax.Array, kernel: jax.Array) -> jax.Array:
    pad = (kernel.shape[0] // 2,) * 2
    y = lax.conv_general_dilated(x.reshape(-1, *x.shape[-3:]), kernel, (1, 1), (pad, pad),
                                 dimension_numbers=("NHWC", "HWIO", "NHWC"))
    return y.reshape(*x.shape[:-1], kernel.shape[-1])


def draw(shape: tuple[int, ...], size: int, features: int) -> tuple[jax.Array, ...]:
    rng = np.random.default_rng(0)
    shapes = (shape, (size, size, shape[-1], features), (*shape[:-1], features))
    return tuple(jnp.asarray(rng.standard_normal(s)) for s in shapes)


@pytest.mark.parametrize(("shape", "size", "features"), SHAPES)
def test_value_and_gradients_are_those_of_xla(
    shape: tuple[int, ...], size: int, features: int
) -> None:
    with jax.enable_x64(True):
        x, kernel, cotangent = draw(shape, size, features)
        assert x.dtype == jnp.float64
        assert convolution._products_pay(x.reshape(-1, *shape[-3:]), kernel)
        ours, ours_back = jax.vjp(convolve, x, kernel)
        theirs, theirs_back = jax.vjp(plain, x, kernel)
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
        for a, b in zip(jax.jit(ours_back)(cotangent), theirs_back(cotangent), strict=True):
            assert a.dtype == jnp.float64
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


def test_a_large_image_of_many_features_takes_products_too() -> None:
    x, kernel, cotangent = draw((2, 96, 96, 8), 3, convolution.FEW)
    assert convolution._products_pay(x, kernel)
    assert not convolution._products_pay(x[:, :48], kernel)
    ours, theirs = (jax.jit(jax.vjp(f, x, kernel)[1])(cotangent) for f in (convolve, plain))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-3)  # sums of 18 432


def test_gradients_run_in_a_loop_under_vmap_and_twice() -> None:
    with jax.enable_x64(True):
        x, kernel, _ = draw((2, 6, 6, 8), 3, 8)

        def energy(kernel: jax.Array, x: jax.Array, f: object) -> jax.Array:
            step = jax.checkpoint(lambda h, _: (jnp.tanh(f(h, kernel)), None))  # type: ignore
            return jnp.sum(lax.scan(step, x, length=3)[0] ** 2)

        def bent(kernel: jax.Array, x: jax.Array, f: object) -> jax.Array:
            return jnp.sum(jax.grad(energy)(kernel, x, f) ** 2)

        for function in (energy, bent):
            many = jax.vmap(jax.grad(function), (None, 0, None))
            ours, theirs = (jax.jit(many, static_argnums=2)(kernel, jnp.stack([x, -x]), f)
                            for f in (convolve, plain))
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


def test_on_other_devices_the_gradient_is_a_convolution() -> None:
    x, kernel, cotangent = draw((2, 8, 8, 8), 3, 8)
    lowered = {platform: jax.export.export(
        jax.jit(lambda *a: jax.vjp(convolve, *a[:2])[1](a[2])), platforms=[platform],
    )(x, kernel, cotangent).mlir_module() for platform in ("cpu", "cuda")}
    assert lowered["cuda"].count("stablehlo.convolution") == 2
    assert "stablehlo.dot_general" not in lowered["cuda"]
    assert lowered["cpu"].count("stablehlo.convolution") == 1
    assert "stablehlo.dot_general" in lowered["cpu"]


def test_flax_may_pass_what_it_passes() -> None:
    x, kernel, _ = draw((1, 4, 4, 8), 3, 2)
    np.testing.assert_array_equal(
        for_flax(x, kernel, (1, 1), ((1, 1), (1, 1)), precision=None), plain(x, kernel))

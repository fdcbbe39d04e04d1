"""The fast pass over pixels is encode and forward, in any chunks and shares."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.networks import random_params, seen, small_params

from evflow.camera import Summary
from evflow.errors import EvflowDataError
from evflow.network import api, inference
from evflow.network.config import MODELS
from evflow.process import chunks

close = {"rtol": 0, "atol": 2e-5}


def estimated(**given: Any) -> tuple[Any, Any]:
    voxels, dL, _ = seen()
    return api.estimate_y(small_params(), voxels, dL.sum(-1), **given)


def test_chunks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = estimated()
    sizes: list[int] = []

    def in_chunks(f: Any, rows: Any, size: int, plain: Any = chunks.in_chunks) -> Any:
        sizes.append(size)
        return plain(f, rows, size)

    monkeypatch.setattr(chunks, "in_chunks", in_chunks)
    for name in ("SMALL", "LARGE", "HUGE"):
        monkeypatch.setattr(chunks, name, 32)
    inference._share.clear_cache()  # the sizes are not among the arguments
    for a, b in zip(whole, estimated(), strict=True):
        np.testing.assert_allclose(a, b, **close)
    assert set(sizes) == {32}
    inference._share.clear_cache()


@pytest.mark.slow
def test_shares_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    voxels, dL, _ = seen()
    images = jnp.stack([voxels, voxels[::-1]])
    dlogI = jnp.stack([dL.sum(-1), dL.sum(-1)[::-1]])
    intensity = 4.0 + 0.1 * dlogI
    for given in ({}, {"intensity": intensity}):
        whole = api.estimate_y(small_params(), images, dlogI, **given)
        with monkeypatch.context() as m:
            m.setattr(chunks, "executions", lambda *_: 7)  # of 120 pixels: 18 each, the last early
            shared = api.estimate_y(small_params(), images, dlogI, **given)
        for a, b in zip(whole, shared, strict=True):
            np.testing.assert_allclose(a, b, **close)


def test_shares_are_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "executions", lambda *_: 3)
    estimated()
    before = inference._share._cache_size()
    estimated(window_s=0.03)
    assert inference._share._cache_size() == before


def test_context_of_all_pixels_is_that_of_each() -> None:
    known = estimated(intensity=jnp.nan)  # unknown, but given pixel by pixel
    for a, b in zip(estimated(), known, strict=True):
        np.testing.assert_allclose(a, b, **close)


@pytest.mark.parametrize("name", ["default", "paper"])
def test_it_is_encode_and_forward(name: str) -> None:
    voxels, dL, _ = seen()
    params = small_params()
    if name == "paper":
        paper = MODELS["paper"]
        small = dataclasses.replace(paper.flow, steps=2, hidden=16)
        params = random_params(dataclasses.replace(paper, flow=small), "paper")
    known = Summary(*(jnp.float32(v) for v in (0.2, 0.25, 0.1, 0.1, 0.03, 0.03)))
    given = {"summary": known, "intensity": 3.0 + dL[..., 0]}
    code = api.encode(params, voxels, dL.sum(-1), **given)
    y, _, _ = api.forward(params, voxels, code)
    got, std = api.estimate_y(params, voxels, dL.sum(-1), **given)
    assert bool(jnp.isnan(std).all()) is (name == "paper")  # which was trained to tell none
    np.testing.assert_allclose(got, y, rtol=1e-4, atol=1e-4 * float(jnp.abs(y).max()))
    if name == "paper":  # there is nothing around which y could be expected
        with pytest.raises(EvflowDataError, match="EV018"):
            api.log_prob(params, voxels, code)


def kept_bytes(pixels: int) -> int:
    """What the gradient over the parameters keeps of the way there, without computing it."""
    known = Summary(*(jnp.float32(v) for v in (0.2, 0.25, 0.1, 0.1, 0.03, 0.03)))
    voxels, dlogI = (jax.ShapeDtypeStruct((pixels, 8, *c), jnp.float32) for c in ((32,), ()))

    def way_back(params: Any, voxels: Any, dlogI: Any) -> Any:
        def loss(params: Any) -> Any:
            return api.estimate(params, voxels, dlogI, summary=known).theta_on.sum()

        return jax.vjp(loss, params)[1]

    kept = jax.eval_shape(way_back, small_params(), voxels, dlogI)
    return sum(math.prod(a.shape) * a.dtype.itemsize for a in jax.tree.leaves(kept))


def test_a_gradient_keeps_what_goes_in_alone() -> None:
    """Activations, 50 kB of every pixel of this small network, would fill the memory: a chunk's
    are computed again."""
    inputs = 4 * (32 + 1)  # voxels, dlogI
    assert kept_bytes(4000) < 4000 * 8 * 3 * inputs  # chunks of either size have their own

"""Chunks and shares are only another way to the same result."""

from __future__ import annotations

import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evflow.process import chunks


def double(rows: Any) -> Any:
    return {"sum": rows[0].sum(-1, keepdims=True) + rows[1], "twice": 2 * rows[0]}


@settings(max_examples=15, deadline=None)
@given(n=st.integers(1, 70), size=st.sampled_from([16, 32, 48]))
def test_chunks_are_the_whole(n: int, size: int) -> None:
    rows = (jnp.arange(3.0 * n).reshape(n, 3), jnp.ones((n, 1)))
    jax.tree.map(np.testing.assert_array_equal,
                 chunks.in_chunks(double, rows, size), double(rows))


@pytest.mark.parametrize("alone", [True, False])
def test_platform_changes_nothing(alone: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SMALL", "LARGE", "HUGE"):
        monkeypatch.setattr(chunks, name, 16)
    rows = (jnp.arange(150.0).reshape(50, 3), jnp.ones((50, 1)))
    jax.tree.map(np.testing.assert_array_equal,
                 chunks.by_platform(double, rows, alone=alone), double(rows))


def test_shares_are_joined_without_what_the_last_repeats() -> None:
    whole = jnp.arange(2 * 10 * 3.0).reshape(2, 10, 3)
    shares = [whole[:, 0:4], whole[:, 4:8], whole[:, 6:10]]
    np.testing.assert_array_equal(chunks.joined(shares, 10), whole)
    np.testing.assert_array_equal(chunks.joined([whole], 10), whole)


def test_calls_have_a_thread_each_and_keep_their_order() -> None:
    meet = threading.Barrier(2, timeout=20)  # passed only by two threads at once
    names = []

    def call(i: int) -> Any:
        if i:
            meet.wait()
        names.append(threading.current_thread().name)
        return jnp.full((1,), i)

    results = chunks.at_once([lambda i=i: call(i) for i in range(3)])
    assert [int(r[0]) for r in results] == [0, 1, 2]
    assert len(set(names)) == 3


def test_errors_and_precision_pass_through_threads() -> None:
    def broken() -> Any:
        raise ValueError("share 1")

    with pytest.raises(ValueError, match="share 1"):
        chunks.at_once([lambda: jnp.zeros(1), broken])
    with jax.enable_x64(True):
        results = chunks.at_once([lambda: jnp.zeros(1, "float64")] * 2)
    assert [r.dtype for r in results] == [np.float64] * 2


def test_only_what_a_cpu_holds_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "cores_per_device", lambda: 4)
    a = jnp.zeros(3)
    on_cpu = jax.default_backend() == "cpu"
    many = 10 * chunks.SMALL
    assert chunks.executions(many, (a, {"b": a})) == (4 if on_cpu else 1)
    assert chunks.executions(2 * chunks.SMALL, a) == (2 if on_cpu else 1)
    assert chunks.executions(5, a) == 1
    traced = []
    jax.jit(lambda x: traced.append(chunks.executions(many, (a, x))))(a)
    assert traced == [1]

"""The PyTorch peer trains the same event networks: its loss, gradient and step are ours."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np
import optax
import pytest

from benchmarks import bench_networks
from evflow.downstream import FireNet, Network
from evflow.downstream.e2vid import E2VID_SMALL

SHAPE = (3, 2, 16)


def named(tree: Any) -> dict[str, np.ndarray]:
    return {"/".join(str(key.key) for key in path): np.asarray(leaf)
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


@pytest.mark.parametrize("network", [FireNet(), E2VID_SMALL], ids=["firenet", "e2vid"])
def test_torch_peer_takes_the_same_step(network: Network) -> None:
    torch = pytest.importorskip("torch")
    from benchmarks.peer_torch_networks import Trainer

    params, (voxels, images) = bench_networks.start(network), bench_networks.data(SHAPE)
    value, gradient = jax.jit(jax.value_and_grad(partial(bench_networks.loss, network)))(
        params, voxels, images)
    tx = optax.adam(bench_networks.RATE)
    updates, _ = tx.update(gradient, tx.init(params))
    after = named(optax.apply_updates(params, updates))
    for layout in (torch.channels_last, torch.contiguous_format):
        peer = Trainer(network, params, voxels, images, rate=bench_networks.RATE, layout=layout)
        assert peer.step().item() == pytest.approx(float(value), rel=1e-6)
        assert peer.weights.keys() == named(gradient).keys()
        for name, ours in named(gradient).items():
            theirs, moved = peer.weights[name].grad.numpy(), peer.weights[name].detach().numpy()
            if theirs.ndim == 4:
                theirs, moved = (a.transpose(2, 3, 1, 0) for a in (theirs, moved))
            np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6 * np.abs(theirs).max())
            # Adam's first step is +-rate, but where a gradient is hardly more than rounding.
            sure = np.abs(theirs) > 1e-6
            np.testing.assert_allclose(after[name][sure], moved[sure], atol=2e-7, err_msg=name)

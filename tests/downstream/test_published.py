"""Published weights in our networks: PyTorch's numbers, by names and shapes alone."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.published_networks import (
    CASES,
    case_input,
    case_state,
    e2vid,
    evflownet,
    firenet,
    write_legacy,
    write_zip,
)

from evflow import save_weights
from evflow.downstream import (
    E2VID,
    E2VID_LIGHTWEIGHT,
    E2VID_PLUS,
    E2VID_SMALL,
    EVFlowNet,
    FireNet,
    event_tensor,
    load_network,
    load_published,
    reconstruct,
    run,
)
from evflow.downstream.published import join, recognise, to_params
from evflow.downstream.published_names import published
from evflow.errors import EvflowDataError
from evflow.network.weights import load_weights
from evflow.types import Events

DATA = Path(__file__).parents[1] / "data"
run_jit = jax.jit(run, static_argnames=("network", "train"))


@functools.cache
def outputs(name: str) -> np.ndarray:
    """(T, H, W) or (T, 2, H, W) of our network with the weights of a case."""
    state = case_state(name)
    network = recognise(state)
    images, _ = run_jit(network, to_params(network, state), jnp.asarray(case_input()))
    return np.asarray(images)


@pytest.mark.parametrize("name", CASES)
def test_outputs_are_those_of_pytorch(name: str) -> None:
    ours = outputs(name)
    with np.load(DATA / "downstream.npz") as stored:
        assert np.std(stored[name]) > 0.02  # weights that let something through
        np.testing.assert_allclose(ours, stored[name], rtol=0, atol=1e-5)
    if importlib.util.find_spec("torch") is not None:
        from helpers import torch_reference
        np.testing.assert_allclose(ours, torch_reference.case_output(name), rtol=0, atol=1e-5)


def test_recurrence_matters() -> None:
    """The parity would not see a state that is lost, were the images the same without."""
    for name in ("e2vid_plus", "firenet_plus"):
        state = case_state(name)
        network, x = recognise(state), jnp.asarray(case_input())
        params = to_params(network, state)
        alone, _ = jax.jit(network.apply)(params, x[-1])
        assert float(jnp.abs(alone - outputs(name)[-1]).max()) > 1e-2


def test_structures_are_recognised() -> None:
    assert recognise(case_state("e2vid_plus")) == dataclasses.replace(E2VID_PLUS, base=4)
    assert recognise(case_state("e2vid_lightweight")) == dataclasses.replace(
        E2VID_LIGHTWEIGHT, base=4)
    assert recognise(case_state("e2vid_concat")) == E2VID(
        base=4, encoders=2, blocks=1, skip="concat")
    assert recognise(case_state("firenet_plus")) == recognise(
        case_state("firenet_2020")) == FireNet()
    assert recognise(case_state("evflownet")) == EVFlowNet(base=4)


@pytest.mark.parametrize(("network", "shapes", "count"), [
    (E2VID_PLUS, e2vid(), 10_710_401), (E2VID_LIGHTWEIGHT, e2vid(batch=True, transposed=True),
                                        10_712_098),
    (FireNet(), firenet(), 37_777), (EVFlowNet(), evflownet(), 14_125_346),
], ids=["E2VID+", "E2VID", "FireNet", "EV-FlowNet"])
def test_full_sizes_are_the_published_ones(network, shapes, count) -> None:
    params = jax.eval_shape(lambda: network.init(jax.random.key(0), (16, 16)))
    leaves = jax.tree_util.tree_leaves_with_path(params)
    assert sum(np.prod(leaf.shape) for path, leaf in leaves
               if path[-1].key not in ("mean", "var")) == count
    filled = to_params(network, {name: np.zeros(shape, np.float32)
                                 for name, shape in shapes.items()})
    assert jax.tree.map(jnp.shape, filled) == jax.tree.map(lambda leaf: leaf.shape, params)
    assert sum(np.prod(shape) for name, shape in shapes.items()
               if not name.endswith(("mean", "var", "tracked"))) == count


def test_small_network_is_small() -> None:
    params = jax.eval_shape(lambda: E2VID_SMALL.init(jax.random.key(0), (48, 48)))
    assert 0.13e6 < sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(params)) < 0.16e6


@pytest.mark.parametrize("write", [write_legacy, write_zip])
def test_published_files_load_and_are_kept_as_weights(write, tmp_path: Path) -> None:
    state = case_state("firenet_plus")
    path = tmp_path / "model.pth"
    write(path, {"arch": "FireNet", "state_dict": state})
    network, params = load_published(path)
    expected = to_params(FireNet(), state)
    assert network == FireNet()
    jax.tree.map(np.testing.assert_array_equal, params, expected)
    save_weights(tmp_path / "firenet.safetensors", params, {"network": str(network)})
    again = load_weights(tmp_path / "firenet.safetensors")
    jax.tree.map(np.testing.assert_array_equal, again, expected)


def test_settings_of_the_original_e2vid_make_it_sigmoid(tmp_path: Path) -> None:
    path = tmp_path / "e2vid.pth.tar"
    write_legacy(path, {"model": {"num_bins": 5}, "state_dict": case_state("e2vid_plus")})
    network, _ = load_published(path)
    assert (network.output, network.padding) == ("sigmoid", "reflect")
    write_legacy(path, {"model": {"final_activation": ""}, "state_dict": case_state("e2vid_plus")})
    network, _ = load_published(path)
    assert (network.output, network.padding) == ("linear", "reflect")


@pytest.mark.parametrize(("name", "settings", "expected"), [
    ("firenet_2020", {}, True), ("firenet_plus", {}, False), ("e2vid_lightweight", {}, True),
    ("e2vid_plus", {}, False), ("e2vid_plus", {"model": {"norm": "none"}}, True),
    ("evflownet", {}, False)])
def test_networks_get_tensors_as_in_their_training(
    name: str, settings: dict, expected: bool, tmp_path: Path
) -> None:
    write_legacy(tmp_path / "mine.ckpt", {**settings, "state_dict": case_state(name)})
    trained = load_network(tmp_path / "mine.ckpt")  # by its content, whatever its name
    assert trained.how == {"normalised": expected}


def test_ten_bins_are_five_of_each_polarity(tmp_path: Path) -> None:
    state = case_state("firenet_plus")
    state["head.conv2d.weight"] = np.tile(state["head.conv2d.weight"], (1, 2, 1, 1))
    write_legacy(tmp_path / "update.pth", {"state_dict": state})
    trained = load_network(tmp_path / "update.pth")
    assert trained.how == {"normalised": False, "split": True}
    times = np.array([3000, 9000])
    events = Events([1, 2], [1, 2], [1000, 2000], [True, False], (9, 8))
    image = reconstruct(trained.network, trained.params, events, times, **trained.how)[0]
    tensor = event_tensor(events, 10, split=True)
    np.testing.assert_allclose(
        image, trained.network.apply(trained.params, tensor)[0], atol=1e-6)


def test_weights_that_diverged_are_refused(tmp_path: Path) -> None:
    for value in (np.nan, 1e300):
        state = {k: v.astype(np.float64) for k, v in case_state("firenet_plus").items()}
        state["pred.conv2d.bias"][0] = value
        with pytest.raises(EvflowDataError, match=r"EV007.*prediction/conv/bias"):
            to_params(FireNet(), state)


def test_what_stands_beside_a_network_is_named() -> None:
    state = {**case_state("e2vid_plus"), "extra.weight": np.zeros(3, np.float32)}
    if not any(name.startswith("unetrecurrent.") for name in state):
        state = {k if k == "extra.weight" else f"unetrecurrent.{k}": v for k, v in state.items()}
    with pytest.raises(EvflowDataError, match=r"EV018.*extra\.weight"):
        to_params(recognise(state), state)


@pytest.mark.parametrize("name", CASES)
def test_all_weights_have_a_published_name(name: str) -> None:
    state = case_state(name)
    network = recognise(state)
    leaves = jax.tree_util.tree_leaves_with_path(to_params(network, state))
    known = " ".join(state)
    for path in (join(keys) for keys, _ in leaves):
        assert any(theirs in known for theirs in published(network, path).split(" or ")), path


@pytest.mark.parametrize(("change", "says"), [
    (lambda s: s.pop("head.conv2d.bias"),
     r"lack head/conv/bias \(head\.conv2d\.bias or head\.conv\.conv2d\.bias\)"),
    (lambda s: s.pop("G2.out_gate.weight"), r"lack gru_1/out/kernel \(G2\.out_gate\.weight or "),
    (lambda s: s.update({"head.conv2d.bias": np.zeros(3, np.float32)}),
     r"head/conv/bias \(head\.conv2d\.bias of \(3,\)"),
    (lambda s: s.update({"extra.weight": np.zeros(3, np.float32)}), "extra.weight"),
    (lambda s: s.update({"G1.reset_gate.running_mean": np.zeros(16, np.float32)}), "no such layer"),
    (lambda s: s.update({"head.conv2d.weight": np.zeros(3, np.float32)}), "kernel"),
    (lambda s: s.clear() or s.update(other=np.zeros(2)), "no known network"),
], ids=["missing", "gate", "shape", "name", "layer", "axes", "foreign"])
def test_weights_that_do_not_fit_are_refused(change, says: str) -> None:
    state = case_state("firenet_plus")
    change(state)
    with pytest.raises(EvflowDataError, match=says) as e:
        to_params(recognise(state), state)
    assert e.value.code == "EV018"

"""Weights on disk: lossless, self-describing, refused when damaged; what ships fits."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from helpers.networks import small_params
from safetensors.numpy import save

from evflow.errors import EvflowDataError
from evflow.network import weights
from evflow.network.architecture import config_of
from evflow.network.config import MODELS
from evflow.network.weights import (
    load_weights,
    model_card,
    save_weights,
    trained_steps,
    weights_path,
)


def test_round_trip(tmp_path: Path) -> None:
    path = save_weights(tmp_path / "w.safetensors", small_params(), {"steps": 7})
    jax.tree.map(np.testing.assert_array_equal, load_weights(path), small_params())
    assert model_card(path) == {"steps": 7}
    assert trained_steps(model_card(path)) == {"all": 7}


def test_same_params_same_bytes(tmp_path: Path) -> None:
    a, b = (save_weights(tmp_path / f"{n}.safetensors", small_params(), {"b": 1, "a": 2})
            for n in "ab")
    assert a.read_bytes() == b.read_bytes()


def test_refusals(tmp_path: Path) -> None:
    path = save_weights(tmp_path / "w.safetensors", small_params(), {})
    with pytest.raises(EvflowDataError, match="EV013"):
        save_weights(path, small_params(), {})
    with pytest.raises(EvflowDataError, match=r"EV016.*default"):
        load_weights("nonsense")
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(EvflowDataError, match="EV009"):
        load_weights(path)


def test_numbers_that_are_not_those_that_were_saved(tmp_path: Path) -> None:
    path = save_weights(tmp_path / "w.safetensors", small_params(), {"steps": 7})
    data = bytearray(path.read_bytes())
    start = 8 + int.from_bytes(data[:8], "little")
    for place in (start, start + 4000, len(data) - 1):
        changed = bytearray(data)
        changed[place] ^= 1  # the last bit of a fraction
        path.write_bytes(changed)
        with pytest.raises(EvflowDataError, match=r"EV009.*SHA-256") as caught:
            load_weights(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite(tmp_path: Path, value: float) -> None:
    bad = {"a": {"b": np.array([1.0, value], np.float32)}}
    with pytest.raises(EvflowDataError, match=r"EV007.*a/b"):
        save_weights(tmp_path / "w.safetensors", bad, {})
    assert not [*tmp_path.iterdir()]
    path = tmp_path / "other.safetensors"
    path.write_bytes(save({"a/b": bad["a"]["b"]}))
    with pytest.raises(EvflowDataError, match=r"EV007.*a/b"):
        load_weights(path)


def test_what_is_released_is_what_is_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that is replaced on purpose needs its line in SHA256SUMS."""
    sums = (weights.FOLDER / weights.SUMS).read_text().split()
    files = sorted(weights.FOLDER.glob("*.safetensors"))
    assert sums[1::2] == [path.name for path in files]
    assert sums[::2] == [weights.sha256(path) for path in files]
    path = save_weights(tmp_path / "a.safetensors", small_params(), {})
    (tmp_path / weights.SUMS).write_text(f"{weights.sha256(path)}  a.safetensors\n")
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    assert load_weights("a")
    save_weights(path, {"a": np.ones(3)}, {}, overwrite=True)
    with pytest.raises(EvflowDataError, match=r"EV009.*released"):
        load_weights("a")


def test_names_and_cards_by_which_weights_can_be_read_again(tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*\.safetensors"):
        save_weights(tmp_path / "weights", {"a": np.zeros(3)}, {})
    for params in ([np.zeros(3)], None, {}, {"a": [np.zeros(3)]}, {"a": "b"}):
        with pytest.raises(EvflowDataError, match=r"EV020.*nested dicts"):
            save_weights(tmp_path / "a.safetensors", params, {})  # type: ignore[arg-type]
    for unwritable in ([1], None, {"seed": np.arange(3)}):
        with pytest.raises(EvflowDataError, match=r"EV020.*card"):
            save_weights(tmp_path / "a.safetensors", {"a": np.zeros(3)}, unwritable)  # type: ignore[arg-type]
    path = tmp_path / "a.safetensors"
    for card in ("[1]", "3", "null"):
        path.write_bytes(save({"a": np.zeros(3, np.float32)}, metadata={"card": card}))
        with pytest.raises(EvflowDataError, match=r"EV009.*not an object"):
            model_card(path)


def test_the_papers_weights_are_whole_and_tell_no_error() -> None:
    params, card = load_weights("paper"), model_card("paper")
    assert weights_path("paper").stat().st_size <= 6e6
    config = config_of(params)
    assert not config.pool
    assert config == MODELS["paper"]
    assert set(params["paper"]) == {"encoder", "flow"}  # nothing that was never trained
    assert card["preset"] == "paper"
    assert card["steps"] > 1000
    assert {"config", "seed", "training_figures", "versions", "source"} <= set(card)
    assert np.isfinite(list(card["training_figures"].values())).all()


def test_shipped_weights_are_small_finite_and_explained() -> None:
    assert weights_path().stat().st_size <= 6e6
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(load_weights()))
    card = model_card()
    for part in ("pixels", "summary"):
        assert card[part]["steps"] > 100
        assert {"config", "seed", "preset", "training_figures", "versions"} <= set(card[part])
    assert card["fusion"]["recordings"] > 100
    steps = trained_steps(card)
    assert {"pixels", "summary"} <= set(steps)
    assert all(count > 0 for count in steps.values())


def test_a_run_and_other_files_are_told_from_weights(tmp_path: Path) -> None:
    (tmp_path / "weights.safetensors").write_bytes(b"")
    (tmp_path / "model.pth").write_bytes(b"")
    for path, code, said in ((tmp_path, "EV016", "weights.safetensors."),
                             (tmp_path / "model.pth", "EV008", "not a .safetensors"),
                             ("model", "EV016", "Released names")):
        with pytest.raises(EvflowDataError) as raised:
            weights_path(path)
        assert (raised.value.code, said in str(raised.value)) == (code, True)

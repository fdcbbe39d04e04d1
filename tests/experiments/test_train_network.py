"""Training of event networks by command: presets, the loop, resuming, what is written."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import jax
import numpy as np
import pytest

from evflow.downstream import load_network
from evflow.downstream.presets import KINDS, TRAININGS, training
from evflow.downstream.train import make_step, optimiser
from evflow.errors import EvflowDataError
from evflow.network.weights import model_card
from experiments import ablate, train_eventgan
from experiments import train_network as command
from experiments.shared.network_runs import Run, start_params

MOST_BYTES = 2_000_000  # of released weights


def test_numbers_that_leave_nothing_to_do_are_refused_at_once(tmp_path: Path) -> None:
    for wrong in ({"batches": 0}, {"batches": -1}, {"save_every": 0}):
        with pytest.raises(EvflowDataError, match=r"EV020.*Give 1 or more"):
            command.main(command.Options(out=tmp_path / "run", **wrong))
    for wrong in ({"scenes": 0}, {"steps": 0}):
        with pytest.raises(EvflowDataError, match=r"EV020.*Give 1 or more"):
            train_eventgan.main(train_eventgan.Options(out=tmp_path / "run", **wrong))
    for wrong in ({"batches": 0}, {"steps": 0}):
        with pytest.raises(EvflowDataError, match=r"EV020.*Give 1 or more"):
            ablate.main(ablate.Options("steps", out=tmp_path / "run", **wrong))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("kind", "preset"), TRAININGS)
def test_presets_fit_together(kind: str, preset: str) -> None:
    network, learning = training(kind, preset)
    make_step(network, learning, optimiser(learning))
    crop = learning.data.crop
    assert type(network) is KINDS[kind]
    assert crop % network.stride == 0 or preset == "debug"
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), (crop, crop)))
    size = sum(4 * math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    assert size < MOST_BYTES or preset not in ("small", "debug")
    most = 0.5 if (kind, preset) == ("evflownet", "small") else 1.0
    assert (learning.data.pause, learning.data.prior.theta) == (0.05, (0.05, most))


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*evflownet"):
        training("unet")


def test_a_preset_may_ask_for_normalised_tensors() -> None:
    for network, normalised in (("evflownet", True), ("e2vid", False)):
        run = command.configuration(command.Options(out=Path(), network=network))
        assert run.learning.normalised is normalised
    asked = command.Options(out=Path(), normalised=True)
    assert command.configuration(asked).learning.normalised


def test_a_run_goes_on_from_weights_of_its_own_network() -> None:
    asked = command.Options(out=Path(), network="e2vid", start="e2vid-small")
    begun = start_params(asked.start, command.configuration(asked))
    jax.tree.map(np.testing.assert_array_equal, begun, load_network("e2vid-small").params)
    assert start_params(None, command.configuration(command.Options(out=Path()))) is None
    for other in ({"network": "firenet"}, {"normalised": True}):
        config = command.configuration(dataclasses.replace(asked, **other))
        with pytest.raises(EvflowDataError, match=r"EV018 .*e2vid-small"):
            start_params(asked.start, config)


def test_files_of_a_run_are_known_by_what_they_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "camera.npz"
    path.write_bytes(b"one")

    def run(**files: object) -> Run:
        return command.configuration(command.Options(out=Path(), **files))

    for name, kind in (("camera", Path), ("start", str), ("lpips", str)):
        first, same = run(**{name: kind(path)}), run(**{name: kind("camera.npz")})
        assert first == same != run()
        path.write_bytes(path.read_bytes() + b"another")
        assert run(**{name: kind(path)}) != first
        with pytest.raises(EvflowDataError, match="EV016"):
            run(**{name: kind("absent.npz")})
    original = {"network": "evflownet", "preset": "original"}
    for recording in (path, tmp_path):  # a file, a folder
        assert run(recordings=(recording,), **original) == run(
            recordings=(recording.relative_to(tmp_path),), **original)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["firenet", "evflownet"])
def test_the_command_trains_resumes_and_measures(tmp_path: Path, kind: str) -> None:
    straight = command.Options(out=tmp_path / "a", network=kind, preset="debug", batches=1)
    result = command.main(straight)
    assert np.isfinite([v for v in result.values() if isinstance(v, float)]).all()
    halves = dataclasses.replace(straight, out=tmp_path / "b")
    for resume, seconds in (("never", 0.0), ("must", math.inf)):
        command.main(dataclasses.replace(halves, resume=resume, max_seconds=seconds))
    first, second = (load_network(tmp_path / name / f"{kind}.safetensors") for name in "ab")
    jax.tree.map(np.testing.assert_array_equal, first.params, second.params)
    assert first.network == second.network == training(kind, "debug")[0]
    card = model_card(tmp_path / "b" / f"{kind}.safetensors")
    assert card["steps"] == 4
    assert card["held_out"].keys() == result.keys()

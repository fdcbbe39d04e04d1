"""Training of event networks by command: presets, the loop, resuming, what is written."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from evflow.camera import Camera
from evflow.camera.optics import Optics, as_arrays
from evflow.camera.sensors import SensorModel
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
    Camera.constant((16, 16)).save(path)

    def run(**files: object) -> Run:
        return command.configuration(command.Options(out=Path(), **files))

    rng = np.random.default_rng(0)
    for name, kind in (("camera", Path), ("start", str), ("lpips", str)):
        first, same = run(**{name: kind(path)}), run(**{name: kind("camera.npz")})
        assert first == same != run()
        other = Camera.constant((16, 16), theta_on=float(rng.uniform(0.1, 0.9)))
        other.save(path, overwrite=True)
        assert run(**{name: kind(path)}) != first
        with pytest.raises(EvflowDataError, match="EV016"):
            run(**{name: kind("absent.npz")})
    original = {"network": "evflownet", "preset": "original"}
    for recording in (path, tmp_path):  # a file, a folder
        assert run(recordings=(recording,), **original) == run(
            recordings=(recording.relative_to(tmp_path),), **original)


def test_a_measured_camera_brings_its_circuit(tmp_path: Path) -> None:
    measured = SensorModel(cutoff_hz=60.0, cutoff_by_light=False, refractory_s=2e-3, leak_hz=0.2,
                           log_map="log_eps", eta_is_all=True, noise_resets_memory=True)
    path = Camera.constant((48, 48)).save(
        tmp_path / "camera.npz", **as_arrays(measured, {}, Optics(7.0)))
    run = command.configuration(command.Options(out=Path(), camera=path))
    assert run.learning.data.model == measured
    assert run.learning.data.offset_dn == 7.0
    assert command.configuration(command.Options(out=Path())).learning.data.model != measured


def test_results_say_on_how_much_they_were_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = SimpleNamespace(completed=lambda: SimpleNamespace(step=3, params={"generator": {}}))
    for script in (command, train_eventgan):
        for name, result in (("train", ended), ("measure", {"a": 1.0}), ("table", "")):
            monkeypatch.setattr(script, name, lambda *_, result=result: result)
    for script, names in ((train_eventgan, ("make_bank", "picture", "save_weights")),
                          (command, ("init_state", "save_network"))):
        for name in names:
            monkeypatch.setattr(script, name, lambda *_, **__: None)
    monkeypatch.setattr(train_eventgan, "held_out", lambda *_: [])
    monkeypatch.setattr(command, "source", lambda *_: (None, None))
    train_eventgan.main(train_eventgan.Options(out=tmp_path, preset="debug", scenes=7))
    command.main(command.Options(out=tmp_path, preset="debug", batches=9))
    configs = [json.loads((tmp_path / f"{name}.json").read_text())["config"]
               for name in ("eventgan", "e2vid")]
    assert (configs[0]["scenes"], configs[1]["batches"]) == (7, 9)


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

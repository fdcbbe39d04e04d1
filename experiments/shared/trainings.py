"""The paired trainings of `experiments.see_better`, each kept with its scores as it ends.

runs/<condition>/<seed>/weights.safetensors, its card the cameras it saw, and <target>.json: what is
there is not made again. One compiled step serves all seeds, and all conditions whose events are
simulated for them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Camera, Recording, load_weights
from evflow.downstream import EVFlowNet, Network
from evflow.downstream.recorded import RecordedBank, sample_recorded
from evflow.downstream.released import save_network
from evflow.downstream.simulated import SequenceConfig
from evflow.downstream.train import LearningState, init_state, make_step, optimiser
from evflow.errors import EvflowDataError
from evflow.network.weights import model_card
from evflow.process.provenance import provenance
from evflow.process.terminal import bar
from evflow.scenes import TextureBank, make_bank
from experiments.shared import eventgan_sequences, gains, held_out, targets
from experiments.shared.common import saved, slug, write_result
from experiments.shared.conditions import (
    NONE,
    RAW,
    AnyTarget,
    Condition,
    Files,
    Workshop,
    camera_medians,
    conditions,
)
from experiments.shared.same_runs import same_files
from experiments.shared.scored_on import OfClips, Recorded, ScoredOn
from experiments.shared.see_better_settings import Setting

Params = dict[str, Any]
Scores = dict[str, dict[str, dict[str, dict[int, np.ndarray]]]]  # target, label, measure, seed

TEXTURE_SEED = 11


def run_card(condition: Condition, camera: Camera | None, **figures: float) -> dict[str, Any]:
    """The model card of a training; made_from: digest of the files that its camera comes from."""
    return {**provenance(), **figures, "condition": condition.name, "made_from": condition.source,
            "cameras": {} if camera is None else camera_medians(camera)}


class Trainings:
    """Trains and tests; what runs share is made once, on first use."""

    def __init__(
        self, setting: Setting, out: Path, weights: str = "default",
        recordings: dict[str, Path] | None = None,
    ) -> None:
        """recordings: real ones by name, in place of the setting's targets."""
        self.setting, self.out, self.weights = setting, out, weights
        self.targets: list[AnyTarget] = [
            Recorded.read(name, path) for name, path in (recordings or {}).items()
        ] or [targets.target(camera, circuit, setting.shape)
              for camera in setting.cameras for circuit in setting.circuits]
        self._scored_on: dict[str, ScoredOn] = {}
        self._steps: dict[SequenceConfig, Any] = {}
        self._recorded: dict[str, RecordedBank] = {}
        self._starts: dict[tuple[int, Network], LearningState] = {}

    @functools.cached_property
    def bank(self) -> TextureBank:
        """Procedural textures alone: photographs are for the tests."""
        return make_bank(jax.random.key(TEXTURE_SEED), self.setting.textures, photos=False)

    @functools.cached_property
    def held_out_bank(self) -> TextureBank:
        return targets.held_out_bank(self.setting.textures // 2)

    def network(self, condition: Condition) -> Network:
        """The network of a condition."""
        return self._of_recordings if condition.label == RAW else self.setting.network

    @property
    def _of_recordings(self) -> Network:
        """For recordings, which have no true flow, EV-FlowNet's form of several scales, which
        learns from frames."""
        network = self.setting.network
        if isinstance(network, EVFlowNet):
            return dataclasses.replace(network, scales=network.encoders)
        return network

    def recorded(self, target: AnyTarget) -> RecordedBank:
        """The target's own recordings of training scenes."""
        assert isinstance(target, targets.Target)
        if target.name not in self._recorded:
            data = self.setting.learning.data
            made = held_out.gather(targets.clips(
                target, self.bank, data, self.setting.drawn, data.windows, "trained on"))
            self._recorded[target.name] = RecordedBank(
                jnp.swapaxes(made.tensors, 0, 1), jnp.swapaxes(made.borders, 0, 1))
        return self._recorded[target.name]

    @functools.cached_property
    def lpips(self) -> Params | None:
        """Weights of LPIPS, where they are installed."""
        return held_out.installed_lpips()

    def scored_on(self, target: AnyTarget) -> ScoredOn:
        """A target's held-out clips, or the recording itself."""
        if isinstance(target, Recorded):
            return target
        if target.name not in self._scored_on:
            s = self.setting
            self._scored_on[target.name] = OfClips(held_out.gather(targets.clips(
                target, self.held_out_bank, s.learning.data, s.scenes, s.windows)), s.skipped)
        return self._scored_on[target.name]

    def conditions(self, files: Files = NONE) -> list[Condition]:
        s = self.setting
        shop = Workshop(s.shape, s.drawn, self.out / "cameras", self._recording,
                        load_weights(self.weights))
        return conditions(shop, self.targets, s.names, files)

    def _recording(self, target: AnyTarget) -> Recording:
        """What a target's camera is measured by. Of textures alone: the released estimator has
        seen the photographs."""
        if isinstance(target, Recorded):
            return target.recording
        s = self.setting
        bank = targets.held_out_bank(s.textures // 2, photos=False)
        return targets.recording(target, bank, s.learning.data, s.seconds)

    def folder(self, condition: Condition, seed: int) -> Path:
        return self.out / "runs" / slug(condition.name) / str(seed)

    def scored(self, condition: Condition, seed: int, target: AnyTarget) -> Path:
        return self.folder(condition, seed) / f"{slug(target.name)}.json"

    def done(self, condition: Condition, seed: int) -> bool:
        return all(self.scored(condition, seed, t).is_file() for t in condition.targets)

    def complete_all(self, wanted: list[Condition], until: float) -> int:
        """Complete the seeds of each condition, beginning none after `until` (time.monotonic());
        returns how many trainings are missing. Raises EV013, before any training, where a run rests
        on other files."""
        for condition in wanted:
            for seed in range(self.setting.seeds):
                same_files(condition, self.folder(condition, seed))
        missing = 0
        for seed in range(self.setting.seeds):
            for condition in wanted:
                if time.monotonic() > until and not self.done(condition, seed):
                    missing += 1
                else:
                    self.complete(condition, seed)
        return missing

    def complete(self, condition: Condition, seed: int) -> None:
        """Train and test what is missing."""
        if self.done(condition, seed):
            return
        path = self.folder(condition, seed) / "weights.safetensors"
        if not path.is_file():
            self.train(condition, seed, path)
        params = load_weights(path)
        for target in condition.targets:
            began = time.monotonic()
            scores = self.score(self.network(condition), params, target)
            write_result(self.scored(condition, seed, target), {
                "scores": {k: v.tolist() for k, v in scores.items()},
                "seconds": time.monotonic() - began}, {
                    "label": condition.label, "seed": seed, "made_from": condition.source,
                    "scored_on": target.source})
            means = ", ".join(f"{k} {np.nanmean(v):.4f}" for k, v in scores.items())
            print(f"{condition.label}, seed {seed}, {target.name}: {means}", flush=True)

    def train(self, condition: Condition, seed: int, path: Path) -> None:
        """Train from the seed and save; the scenes and batches are those of every condition but
        `raw`, whose recordings end."""
        learning, began = self.setting.learning, time.monotonic()
        steps, camera, network = learning.steps, condition.make(), self.network(condition)
        data = learning.data
        if condition.circuit:
            model, optics = condition.circuit()
            data = dataclasses.replace(data, model=model, offset_dn=optics.offset_dn)
        bank: TextureBank | RecordedBank = self.bank
        cameras: Any = camera
        if condition.generator is not None:
            cameras, step = load_weights(condition.generator), self._generated_step
        elif condition.label == RAW:
            bank, step = self.recorded(condition.targets[0]), self._recorded_step
        else:
            step = self._simulated_step(data)
        lpips = self.lpips if self.setting.perceptual else None
        state, losses = self._start(seed, network), []
        with bar(f"{condition.name}, seed {seed}") as progress:
            for i in range(steps):
                state, metrics = step(state, bank, cameras, lpips)
                losses.append(metrics["loss"])
                if i % 10 == 0:
                    jax.block_until_ready(metrics)
                    progress(i + 1, steps)
        loss = float(jnp.mean(jnp.stack(losses[-max(1, steps // 10):])))
        if not math.isfinite(loss):
            raise EvflowDataError("EV007", f"{condition.name}, seed {seed}: the loss is {loss}.")
        card = run_card(condition, camera, seed=seed, steps=steps, loss=loss,
                        seconds=time.monotonic() - began) | (
                            {} if camera is None else
                            {"circuit": repr(data.model), "offset_dn": data.offset_dn})
        path.parent.mkdir(parents=True, exist_ok=True)
        save_network(path, network, state.params, card,
                     normalised=self.setting.learning.normalised)

    @functools.cached_property
    def _tx(self) -> Any:
        return optimiser(self.setting.learning)

    def _simulated_step(self, data: SequenceConfig) -> Any:
        """The step with such sequences."""
        if data not in self._steps:
            learning = dataclasses.replace(self.setting.learning, data=data)
            self._steps[data] = jax.jit(make_step(self.setting.network, learning, self._tx))
        return self._steps[data]

    @functools.cached_property
    def _generated_step(self) -> Any:
        return jax.jit(make_step(self.setting.network, self.setting.learning, self._tx,
                                 eventgan_sequences.sample))

    @functools.cached_property
    def _recorded_step(self) -> Any:
        return jax.jit(make_step(self._of_recordings, self.setting.learning, self._tx,
                                 sample_recorded))

    def _start(self, seed: int, network: Network) -> LearningState:
        """The common initial state of a seed's conditions that train this network."""
        if (seed, network) not in self._starts:
            learning = dataclasses.replace(self.setting.learning, seed=seed)
            self._starts[seed, network] = init_state(network, learning, self._tx)
        return self._starts[seed, network]

    def score(self, network: Network, params: Params, target: AnyTarget) -> held_out.Scores:
        """Scores of a network on a target."""
        return self.scored_on(target).scores(
            network, params, self.setting.learning.normalised, self.lpips)

    def scores(self, wanted: list[Condition]) -> Scores:
        """Saved scores of clips, by target, condition, measure and seed."""
        found: Scores = {t.name: {} for t in self.targets}
        for condition in wanted:
            for target in condition.targets:
                for seed in range(self.setting.seeds):
                    path = self.scored(condition, seed, target)
                    if path.is_file():
                        row = found[target.name].setdefault(condition.label, {})
                        scores = saved(path, "result")["scores"]
                        for name, values in scores.items():
                            row.setdefault(name, {})[seed] = np.array(values, np.float64)
        return found

    def untrained(self, task: str) -> dict[str, gains.Means]:
        """Means of the baselines without a network, by target."""
        return {t.name: {label: {name: float(np.nanmean(v)) for name, v in scores.items()}
                         for label, scores in self.scored_on(t).without_network(
                             task, self.lpips).items()}
                for t in self.targets}

    def camera_medians(self, wanted: list[Condition]) -> dict[str, dict[str, float]]:
        """Medians of the cameras that each condition was trained for, and of the true ones."""
        found = {f"{t.name}, truth": camera_medians(t.camera) for t in self.targets
                 if isinstance(t, targets.Target)}
        for condition in wanted:
            path = self.folder(condition, 0) / "weights.safetensors"
            if path.is_file() and model_card(path)["cameras"]:
                found[condition.name] = model_card(path)["cameras"]
        return found

    def examples(self, wanted: list[Condition], target: AnyTarget) -> dict[str, np.ndarray]:
        """The last frames of a target's clips, or all of a recording (N, H, W), and images of them
        by the first network of each condition."""
        found: dict[str, np.ndarray] = {}
        for condition in wanted:
            path = self.folder(condition, 0) / "weights.safetensors"
            if target in condition.targets and path.is_file():
                found[condition.label], found["frame"] = self.scored_on(target).images(
                    self.network(condition), load_weights(path), self.setting.learning.normalised)
        return {"frame": found.pop("frame"), **found} if found else found

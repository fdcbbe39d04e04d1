"""The paired trainings of `experiments.see_better`, each kept with its scores as it ends.

runs/<condition>/<seed>/weights.safetensors, its card the cameras it saw, and <target>.json: what is
there is not made again. One compiled step serves all seeds, and all conditions whose events are
simulated for them.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Camera, load_weights
from evflow.downstream import EVFlowNet, Network
from evflow.downstream.recorded import RecordedBank, sample_recorded
from evflow.downstream.released import save_network
from evflow.downstream.train import LearningConfig, LearningState, init_state, make_step, optimiser
from evflow.errors import EvflowDataError
from evflow.network.weights import model_card
from evflow.process.provenance import provenance
from evflow.process.terminal import bar
from evflow.scenes import TextureBank, make_bank
from experiments.shared import eventgan_sequences, gains, held_out, targets
from experiments.shared.common import slug, write_result
from experiments.shared.conditions import (
    NONE,
    RAW,
    Condition,
    Files,
    Workshop,
    camera_medians,
    conditions,
)

Params = dict[str, Any]
Scores = dict[str, dict[str, dict[str, dict[int, np.ndarray]]]]  # target, label, measure, seed

SIMULATED = ("default", "wide", "wide-log", "evflow", "oracle")
TEXTURE_SEED = 11


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is trained and how it is tested. names: of conditions; cameras, circuits: of targets;
    seeds: paired trainings; shape: of the targets' sensors; textures: procedural ones of
    training; drawn: K of `conditions`; seconds: of the recording to estimate from; scenes,
    windows, skipped: clips, their length, and the windows that are not scored; perceptual:
    LPIPS is also what video is trained by, where its weights are."""

    network: Network
    learning: LearningConfig
    names: tuple[str, ...] = SIMULATED
    cameras: tuple[str, ...] = ("high",)
    circuits: tuple[str, ...] = ("noisy",)
    seeds: int = 5
    shape: tuple[int, int] = (64, 64)
    textures: int = 128
    drawn: int = 256
    seconds: float = 2.0
    scenes: int = 48
    windows: int = 20
    skipped: int = 6
    perceptual: bool = False


def run_card(condition: Condition, camera: Camera | None, **figures: float) -> dict[str, Any]:
    """The model card of a training; made_from: digest of the file that its camera comes from."""
    return {**provenance(), **figures, "condition": condition.name, "made_from": condition.source,
            "cameras": {} if camera is None else camera_medians(camera)}


class Trainings:
    """Trains and tests; what runs share is made once, on first use."""

    def __init__(self, setting: Setting, out: Path, weights: str = "default") -> None:
        self.setting, self.out, self.weights = setting, out, weights
        self.targets = [targets.target(camera, circuit, setting.shape)
                        for camera in setting.cameras for circuit in setting.circuits]
        self._clips: dict[str, held_out.Clips] = {}
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

    def recorded(self, target: targets.Target) -> RecordedBank:
        """The target's own recordings of training scenes."""
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

    def clips(self, target: targets.Target) -> held_out.Clips:
        if target.name not in self._clips:
            s = self.setting
            self._clips[target.name] = held_out.gather(targets.clips(
                target, self.held_out_bank, s.learning.data, s.scenes, s.windows))
        return self._clips[target.name]

    def conditions(self, files: Files = NONE) -> list[Condition]:
        s = self.setting
        shop = Workshop(
            s.shape, s.drawn, self.out / "cameras",
            lambda t: targets.recording(t, self.held_out_bank, s.learning.data, s.seconds),
            load_weights(self.weights))
        return conditions(shop, self.targets, s.names, files)

    def folder(self, condition: Condition, seed: int) -> Path:
        return self.out / "runs" / slug(condition.name) / str(seed)

    def scored(self, condition: Condition, seed: int, target: targets.Target) -> Path:
        return self.folder(condition, seed) / f"{slug(target.name)}.json"

    def done(self, condition: Condition, seed: int) -> bool:
        return all(self.scored(condition, seed, t).is_file() for t in condition.targets)

    def complete_all(self, wanted: list[Condition], until: float) -> int:
        """Complete the seeds of each condition, beginning none after `until` (time.monotonic());
        returns how many trainings are missing."""
        missing = 0
        for seed in range(self.setting.seeds):
            for condition in wanted:
                if time.monotonic() > until and not self.done(condition, seed):
                    missing += 1
                else:
                    self.complete(condition, seed)
        return missing

    def complete(self, condition: Condition, seed: int) -> None:
        """Train and test what is missing. Raises EV013 where a run rests on another file."""
        if self.done(condition, seed):
            return
        path = self.folder(condition, seed) / "weights.safetensors"
        if not path.is_file():
            self.train(condition, seed, path)
        if model_card(path).get("made_from") != condition.source:
            raise EvflowDataError(
                "EV013", f"{path.parent} was trained for another {condition.label}.",
                "Give it another name, or choose another --out.")
        params = load_weights(path)
        for target in condition.targets:
            began = time.monotonic()
            scores = self.score(self.network(condition), params, target)
            write_result(self.scored(condition, seed, target), {
                "scores": {k: v.tolist() for k, v in scores.items()},
                "seconds": time.monotonic() - began}, {"label": condition.label, "seed": seed})
            means = ", ".join(f"{k} {np.nanmean(v):.4f}" for k, v in scores.items())
            print(f"{condition.label}, seed {seed}, {target.name}: {means}", flush=True)

    def train(self, condition: Condition, seed: int, path: Path) -> None:
        """Train from the seed and save; the scenes and batches are those of every condition but
        `raw`, whose recordings end."""
        steps, began = self.setting.learning.steps, time.monotonic()
        camera, network = condition.make(), self.network(condition)
        bank: TextureBank | RecordedBank = self.bank
        cameras: Any = camera
        step = self._step
        if condition.generator is not None:
            cameras, step = load_weights(condition.generator), self._generated_step
        elif condition.label == RAW:
            bank, step = self.recorded(condition.targets[0]), self._recorded_step
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
                        seconds=time.monotonic() - began)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_network(path, network, state.params, card,
                     normalised=self.setting.learning.normalised)

    @functools.cached_property
    def _tx(self) -> Any:
        return optimiser(self.setting.learning)

    @functools.cached_property
    def _step(self) -> Any:
        return jax.jit(make_step(self.setting.network, self.setting.learning, self._tx))

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

    def score(self, network: Network, params: Params, target: targets.Target) -> held_out.Scores:
        """Scores of a network on the clips of a target."""
        s, clips = self.setting, self.clips(target)
        made = held_out.outputs(network, params, clips.tensors, s.learning.normalised)
        if isinstance(network, EVFlowNet):
            return held_out.flow_scores(made, clips, s.skipped)
        return held_out.video_scores(made, clips, s.skipped, self.lpips)

    def scores(self, wanted: list[Condition]) -> Scores:
        """Saved scores of clips, by target, condition, measure and seed."""
        found: Scores = {t.name: {} for t in self.targets}
        for condition in wanted:
            for target in condition.targets:
                for seed in range(self.setting.seeds):
                    path = self.scored(condition, seed, target)
                    if path.is_file():
                        row = found[target.name].setdefault(condition.label, {})
                        scores = json.loads(path.read_text())["result"]["scores"]
                        for name, values in scores.items():
                            row.setdefault(name, {})[seed] = np.array(values, np.float64)
        return found

    def untrained(self, task: str) -> dict[str, gains.Means]:
        """Means of the baselines without a network, by target."""
        return {t.name: {label: {name: float(np.nanmean(v)) for name, v in scores.items()}
                         for label, scores in held_out.without_network(
                             task, self.clips(t), self.setting.skipped, self.lpips).items()}
                for t in self.targets}

    def camera_medians(self, wanted: list[Condition]) -> dict[str, dict[str, float]]:
        """Medians of the cameras that each condition was trained for, and of the true ones."""
        found = {f"{t.name}, truth": camera_medians(t.camera) for t in self.targets}
        for condition in wanted:
            path = self.folder(condition, 0) / "weights.safetensors"
            if path.is_file() and model_card(path)["cameras"]:
                found[condition.name] = model_card(path)["cameras"]
        return found

    def examples(
        self, wanted: list[Condition], target: targets.Target
    ) -> dict[str, np.ndarray]:
        """The last frames of a target's clips (N, H, W), and images of them by the first network
        of each condition."""
        clips, s = self.clips(target), self.setting
        found = {"frame": np.asarray(clips.frames[-1])}
        for condition in wanted:
            path = self.folder(condition, 0) / "weights.safetensors"
            if target in condition.targets and path.is_file():
                images = held_out.outputs(
                    self.network(condition), load_weights(path), clips.tensors,
                    s.learning.normalised)
                found[condition.label] = np.asarray(images[-1])
        return found

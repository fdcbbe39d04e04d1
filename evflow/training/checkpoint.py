"""Training checkpoints through orbax: atomic, a few kept, restored bit for bit.

A checkpoint holds the whole TrainState (parameters, average, optimiser, key, step); the
configuration lies beside it as config.json, so a run explains itself. It is written by all
processes of a run together (they share the folder) and restored onto any devices.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from evflow.errors import EvflowDataError
from evflow.files.atomic import atomic_write


class Checkpoints:
    """The checkpoints of one run in `folder`; a context manager that waits for writes. Raises
    EV019 where that is a file."""

    def __init__(self, folder: str | os.PathLike, keep: int = 2) -> None:
        self.folder = Path(folder).absolute()
        if self.folder.exists() and not self.folder.is_dir():
            raise EvflowDataError("EV019", f"{self.folder} is a file, and no folder of a run.",
                                  "Choose another --out.")
        options = ocp.CheckpointManagerOptions(
            max_to_keep=keep, create=True, cleanup_tmp_directories=True)
        self._manager = ocp.CheckpointManager(self.folder / "steps", options=options)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:  # an error may be the death of a process, which a write would wait for
            self._manager.wait_until_finished()
            self._manager.close()

    @property
    def latest(self) -> int | None:
        """The last complete step, or None."""
        return self._manager.latest_step()

    def save(self, step: int, state: Any) -> None:
        """Write `state` as `step`, in the background; an existing step is left as it is."""
        if step not in self._manager.all_steps():
            self._manager.save(step, args=ocp.args.StandardSave(state))

    def restore(self, like: Any) -> Any:
        """The latest state, in the structure (and on the devices) of `like`."""
        if self.latest is None:
            raise EvflowDataError("EV016", f"no checkpoint in {self.folder}.",
                                  "Start the run with --resume auto.")
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        try:
            return self._manager.restore(self.latest, args=ocp.args.StandardRestore(abstract))
        except (ValueError, KeyError) as e:
            raise EvflowDataError(
                "EV018", f"the checkpoint in {self.folder} does not fit this configuration "
                f"({str(e).splitlines()[0]}).", "Resume with the configuration in its config.json.",
            ) from e

    def check_config(self, config: dict[str, Any]) -> None:
        """Raise EV013, naming the fields, where the saved configuration is not `config`; EV016
        where none is saved."""
        path = self.folder / "config.json"
        if not path.exists():
            raise EvflowDataError("EV016", f"no run in {self.folder} (no config.json).",
                                  "Start the run with --resume auto.")
        saved, given = (_flat(c) for c in (json.loads(path.read_text()), _as_json(config)))
        absent = "absent"
        differ = [f"{k}: {saved.get(k, absent)} there, {given.get(k, absent)} here"
                  for k in sorted(saved.keys() | given.keys())
                  if saved.get(k, absent) != given.get(k, absent)]
        if differ:
            raise EvflowDataError(
                "EV013", f"{self.folder} holds a run of another configuration "
                f"({'; '.join(differ[:5])}{' ...' if differ[5:] else ''}).",
                "Go on with the same options, or choose another --out.")

    def write_config(self, config: dict[str, Any]) -> None:
        """Save the configuration beside the steps."""
        path = self.folder / "config.json"
        with atomic_write(path, overwrite=True) as temporary:
            temporary.write_text(json.dumps(_as_json(config), indent=2) + "\n")


def _as_json(config: dict[str, Any]) -> Any:
    """`config` as it is read back: tuples are lists."""
    return json.loads(json.dumps(config, default=str))


def _flat(config: Any, name: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} -> {"a.b": 1}."""
    if not isinstance(config, dict):
        return {name: config}
    return {k: v for key, part in config.items()
            for k, v in _flat(part, f"{name}.{key}" if name else key).items()}

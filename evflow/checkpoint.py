"""Training checkpoints through orbax: atomic, a few kept, restored bit for bit.

A checkpoint holds the whole TrainState (parameters, average, optimiser, key, step); the
configuration lies beside it as config.json, so a run explains itself.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from evflow.errors import EvflowDataError
from evflow.files import atomic_write


class Checkpoints:
    """The checkpoints of one run in `folder`; a context manager that waits for writes."""

    def __init__(self, folder: str | os.PathLike, keep: int = 2) -> None:
        self.folder = Path(folder).absolute()
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=True)
        self._manager = ocp.CheckpointManager(self.folder / "steps", options=options)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
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
                                  "Start the run without --resume.")
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        try:
            return self._manager.restore(self.latest, args=ocp.args.StandardRestore(abstract))
        except (ValueError, KeyError) as e:
            raise EvflowDataError(
                "EV018", f"the checkpoint in {self.folder} does not fit this configuration "
                f"({str(e).splitlines()[0]}).", "Resume with the configuration in its config.json.",
            ) from e

    def write_config(self, config: dict[str, Any]) -> None:
        """Save the configuration beside the steps."""
        path = self.folder / "config.json"
        with atomic_write(path, overwrite=True) as temporary:
            temporary.write_text(json.dumps(config, indent=2, default=str) + "\n")

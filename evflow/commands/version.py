"""`evflow version`: the installed versions."""

from __future__ import annotations

import dataclasses
import json


@dataclasses.dataclass(frozen=True)
class Version:
    """Print the versions of evflow and of its dependencies.

    Example: evflow version
    """

    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        import importlib.metadata

        import evflow

        found = {"evflow": evflow.__version__} | {
            name: importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy")}
        print(json.dumps(found) if self.json else
              "\n".join(f"{name} {version}" for name, version in found.items()))

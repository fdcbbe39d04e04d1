"""`evflow version`: what runs here."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Version:
    """Print the versions of evflow and of what it runs on.

    Example: evflow version
    """

    def run(self) -> None:
        import importlib.metadata

        import evflow

        print(f"evflow {evflow.__version__}")
        for name in ("jax", "jaxlib", "numpy"):
            print(f"{name} {importlib.metadata.version(name)}")

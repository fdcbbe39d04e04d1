"""The pictures of docs/gallery.md: what the commands draw, of a hidden camera that watches a scene.

    python -m experiments.gallery                         # all of them, into docs/pictures/gallery
    python -m experiments.gallery --only sensors bench    # some
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from evflow.errors import EvflowDataError
from evflow.files.folders import need_writable
from experiments.shared.common import run_script
from experiments.shared.gallery_pictures import PICTURES
from experiments.shared.gallery_scenes import Scenes


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw the gallery."""

    out: Path = Path("docs/pictures/gallery")
    seed: int = 3
    only: tuple[str, ...] = ()
    """Names of pictures; all without any."""


def main(options: Options) -> None:
    if unknown := set(options.only) - set(PICTURES):
        raise EvflowDataError("EV020", f"no pictures {sorted(unknown)}.",
                              f"Choose from {', '.join(PICTURES)}.")
    need_writable(options.out)
    options.out.mkdir(parents=True, exist_ok=True)
    scenes = Scenes(options.seed)
    for name, draw in PICTURES.items():
        if not options.only or name in options.only:
            draw(scenes, options.out / name)
            print(f"{name} drawn", flush=True)


if __name__ == "__main__":
    run_script(main, Options, __doc__)

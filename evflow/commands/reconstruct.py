"""`evflow reconstruct`: video from events."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from evflow.commands.options import check_finite, own_first, refuse
from evflow.commands.windows import Windowed, frames_amid, lasting
from evflow.commands.writing import need_absent, refuse_stdout
from evflow.errors import EvflowDataError
from evflow.notes import Note, as_dicts

if TYPE_CHECKING:
    import numpy as np

    from evflow.downstream.video import FrameScores
    from evflow.types import Recording


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Reconstruct(Windowed):
    """Turn events into video, by E2VID or FireNet. If the recording has frames, images are made at
    their times and compared with them.

    Example: evflow reconstruct flight.aedat4 -o flight.mp4
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """File or folder in any known format."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """.mp4, .avi or .gif; or a folder for .png images with timestamps.txt, which --frames of other
    commands reads."""
    weights: str = "e2vid-small"
    """Name of released weights, a .safetensors path, or a published checkpoint (.pth.tar)."""
    protocol: Literal["evreal", "etnet", "global"] = "evreal"
    """How images are scored: which SSIM, and whether values are clipped."""

    def run(self) -> None:
        from evflow.downstream.released import load_network
        from evflow.downstream.tensor import reconstructions
        from evflow.downstream.video import images_of
        from evflow.process.terminal import bar

        check_finite(self)
        self.check_film()
        kind = self._kind()
        need_absent(self.out, self.overwrite, self.recording, self.frames,
                    self.timestamps)
        trained = images_of(load_network(self.weights))
        recording = self.read(self.recording)
        times = self.times(recording)
        seen = times is recording.frame_times
        amid = frames_amid(recording, times) if seen else range(0)
        notes = list(recording.notes)
        if seen and (outside := len(times) - len(amid)):
            notes.append(Note("frames.unused", f"{outside} of {len(times)} frames lie outside the "
                              "events and are not scored"))
        scores = self._scores(len(amid)) if seen else None
        with bar("reconstructing") as progress:
            images = reconstructions(
                trained.network, trained.params, recording.events, times, **trained.how,
                hold=True)
            images = _watched(images, recording, scores, amid, len(times), progress)
            described = (self._folder(images, times) if kind == "" else
                         self._film(images, times, recording))
        result = scores.result() if scores else None
        facts = {"out": str(self.out), "weights": self.weights, "weights_sha256": trained.sha256,
                 "images": len(times),
                 "scores": result, "notes": as_dicts(notes)}
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
        print(json.dumps(facts) if self.json else "\n".join(
            (f"{described} -> {self.out}", *_described(result))))

    def _kind(self) -> str:
        """The extension of a film, "" for a folder; EV020 for anything else."""
        from evflow.report.video import SUFFIXES

        refuse_stdout(self.out)
        kind = self.out.suffix.lower()
        if kind not in ("", *SUFFIXES):
            raise EvflowDataError("EV020", f"{self.out.name} does not end in "
                                  f"{', '.join(SUFFIXES)}, and a folder has no extension.",
                                  "The extension selects the format.")
        refuse(self, {"": ("fps", "scale", "codec"), ".mp4": ()}.get(kind, ("codec",)),
               f"does not apply to a {kind or 'folder of images'}")
        return kind

    def _scores(self, frames: int) -> FrameScores:
        """Scores of `frames` frames by the protocol, with LPIPS if its weights are installed."""
        from evflow.downstream.video import WARM_UP, FrameScores
        from evflow.metrics.image_scores import PROTOCOLS
        from evflow.metrics.perceptual import load_lpips

        try:
            weights = load_lpips()
        except EvflowDataError:
            weights = None
        return FrameScores(PROTOCOLS[self.protocol], weights, min(WARM_UP, frames // 2))

    def _film(self, images: Iterator[np.ndarray], times: np.ndarray, recording: Recording) -> str:
        from evflow.report.video import enlarged, write_video

        pictures = (enlarged(image[..., None].repeat(3, -1), self.scale) for image in images)
        start = min(int(recording.events.t[0]), int(times[0]))
        fps = lasting(len(times), int(times[-1]) - start) if self.fps is None else self.fps
        return write_video(self.out, pictures, len(times), fps=fps, codec=self.codec,
                           overwrite=self.overwrite)

    def _folder(self, images: Iterator[np.ndarray], times: np.ndarray) -> str:
        from evflow.io.images.folder import MADE
        from evflow.report.video import write_images

        return write_images(self.out, images, times, overwrite=self.overwrite,
                            remark=f"images were {MADE} {Path(self.weights).name}")


def _watched(
    images: Iterator[np.ndarray], recording: Recording, scores: FrameScores | None, scored: range,
    count: int, progress: Any,
) -> Iterator[np.ndarray]:
    """The images as they pass; those `scored` of `count` are compared with their frames."""
    for i, image in enumerate(images):
        if scores and i in scored:
            scores.add(image, recording.frame_dn(i))
        yield image
        progress(i + 1, count)


def _described(result: dict[str, Any] | None) -> list[str]:
    """The scores as a line of text."""
    if result is None:
        return []
    numbers = [f"{name} {result[name]:.4f}" for name in ("mse", "ssim", "lpips")
               if result.get(name) is not None]
    return [f"against {result['frames']} frames: {', '.join(numbers)} "
            f"(SSIM {result['protocol']['ssim']}, mean over frames, "
            f"{'clipped' if result['protocol']['clip'] else 'not clipped'}"
            + (f", LPIPS {result['lpips_net']}" if result["lpips_net"] else "")
            + f"; the first {result['warm_up']} left out)"]

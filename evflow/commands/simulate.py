"""`evflow simulate`: simulate the events that a camera would record of a video."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from evflow.commands.footage import Footage
from evflow.commands.options import Compiling, own_first, refuse, value
from evflow.commands.pixels import Pixels
from evflow.commands.writing import Format, named, need_absent
from evflow.errors import EvflowDataError
from evflow.notes import Note, as_dicts

if TYPE_CHECKING:
    from evflow.camera.sensors import SensorModel
    from evflow.io.images.frames import Frames, FrameSource
    from evflow.io.writer import EventWriter


Pair = tuple[np.ndarray, int]  # frame, time in us
PREVIEW_S = 2.0  # minimum duration of a film
STEPS = 3  # threads beside each one: motion, pictures, simulation and writing
SMALL = 1 << 17  # pixels; for larger frames a second OpenCV thread shortens the run by a tenth, for
# smaller ones it only costs up to a sixth of the CPU time
DEPTH = 8  # frames prepared ahead of the simulation, and event blocks waiting to be written


@own_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulate(Pixels, Footage, Compiling):
    """Simulate the events that a camera would record of a video, an image folder or a recording.

    Example: evflow simulate ride.mp4 --camera cam/camera.npz -o synth.h5

    Example: evflow simulate flight.aedat4 --camera cam/camera.npz -o again.h5

    Example: evflow simulate frames/ --timestamps times.txt --colour rggb -o synth.h5
    """

    video: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO")]
    """A video file; a folder of images (png, jpg, tif, bmp, pgm; 8 or 16 bits; hdr, exr: radiance);
    a stack of frames (.npy, .npz); or a recording in any known format, whose frames are used at
    their own times."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Output. Its extension selects the format: .h5 dsec, .zip or .txt e2vid, .npz npz, .aedat4
    aedat4, .aedat aedat2 (jAER), none (a folder) evreal."""
    format: Format = "auto"
    """Format of the output, if its extension leaves a choice (event_utils in .h5)."""
    frames_too: bool = False
    """Write the video's frames with the events: grey, linear in light, at their own times."""
    labels: bool = False
    """Write which events are noise (.h5: events/noise, .npz: noise): those from the camera's η and
    shot noise."""
    preview: Annotated[Path | None, value("FILE")] = None
    """Also make a film of the events (.mp4, .gif), in slow motion if they are short; evflow render
    has more options."""
    interpolate: bool = True
    """Interpolate frames where things move more than --max-motion-px from frame to frame."""
    max_motion_px: Annotated[float, tyro.conf.arg(aliases=["--max-motion"])] = 0.5
    """Maximum motion per step, in pixels; 0 = --no-interpolate."""
    overwrite: bool = False
    """Replace the output if it exists."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        import jax

        from evflow import io
        from evflow.io.images.exposures import noted
        from evflow.process import early
        from evflow.process.memory import keep
        from evflow.process.terminal import bar
        from evflow.process.threads import ahead, behind, beside, prompt
        from evflow.simulator import simulate_stream
        from evflow.simulator.interpolate import unzip

        format = named(self.format, self.out)
        need_absent(self.out, self.overwrite, self.video, self.camera, self.timestamps)
        self._check(io.registry.writer_of(self.out, format))
        source = self.source(self.video)
        if not self._fills:  # the blur is left in
            source.notes[:] = noted(source.notes, 0)
        keep()
        early.settle()
        count = frames = 0

        def shown(done: int, total: int) -> None:
            nonlocal frames
            frames = done
            progress(done, total)

        alone = beside(STEPS if source.size[0] * source.size[1] < SMALL else 0)
        with prompt(), alone, bar("simulating") as progress, ahead(
            self._frames(source, shown), DEPTH
        ) as made:
            camera, sensor = self.pixels(source.size), self.model()
            source.notes.extend(self._blur_notes(source))
            with io.open_writer(
                self.out, source.size, format, overwrite=self.overwrite,
                exposure_us=source.exposure_us,
            ) as writer, behind(DEPTH) as later:
                fits = _fitting(writer, source.notes)
                seen: list[int] = []
                pairs = _clocked(_recorded(
                    made, lambda *pair: later(writer.append_frames, *fits(*pair))), seen)
                for events, noise in simulate_stream(jax.random.key(self.seed), *unzip(pairs),
                                                     camera, model=sensor, labels=True,
                                                     full_scale=255):
                    later(writer.append, events)
                    if self.labels:
                        later(writer.append_labels, noise)
                    count += len(events)
        source.notes.extend((*_coarse(sensor, seen), *_none(count)))
        for note in source.notes:
            print(f"note: {note}", file=sys.stderr)
        facts = {"out": str(self.out), "format": writer.NAME, "events": count, "frames": frames,
                 "sensor": self.sensor, "colour": self.colour, "notes": as_dicts(source.notes)}
        if self.preview and count:
            facts["preview"] = self._filmed(self.preview)
        elif self.preview:
            print(f"note: there are no events, so {self.preview} is not made", file=sys.stderr)
        print(json.dumps(facts) if self.json else "\n".join((
            f"{count:,} events of {frames:,} frames -> {self.out}",
            *([f"{facts['preview']} -> {self.preview}"] if "preview" in facts else []))))

    def _filmed(self, film: Path) -> str:
        """Make a film of the events that were written; returns a description of it."""
        from evflow import io
        from evflow.report.movie import SLOW, Film, write_film

        recording = io.read_recording(self.out)
        slow = min(max(1.0, PREVIEW_S * 1e6 / max(1, recording.events.duration_us)), SLOW[1])
        rate = Film()
        try:
            described = write_film(film, recording, dataclasses.replace(
                rate, slow=slow, window_us=max(1, round(rate.window_us / slow))),
                overwrite=self.overwrite)
        except BaseException:  # and Ctrl-C: the events are whole, and need not be made again
            again = shlex.join(
                ["evflow", "render", str(self.out), "-o", str(film), "--slow", f"{slow:.3g}"])
            print(f"note: {self.out} is complete. The film alone: {again}", file=sys.stderr)
            raise
        return f"{described}, {slow:.3g} times slower than life" if slow > 1 else described

    @property
    def _fills(self) -> bool:
        """Whether frames are put between those of the video; saccades move in small steps."""
        return self.interpolate and self.max_motion_px > 0 and self.saccades is None

    def _blur_notes(self, source: FrameSource) -> list[Note]:
        """What the measured camera's estimate saw of an exposure that nobody tells here."""
        seen_ms = self.exposure_seen_ms(source.recorded)
        if not (seen_ms and self._fills) or source.exposure_us or self.exposure_ms is not None:
            return []
        return [Note("frames.blur", f"frames may be blurred: those that {self.camera} was measured "
                     f"from looked exposed for {seen_ms:.0f} ms. If these are of that recording, "
                     f"--exposure-ms {seen_ms:.0f} takes the blur out")]

    def _check(self, writer: type[EventWriter]) -> None:
        """Raise EV013, EV020 before any long work."""
        if not self.interpolate:
            refuse(self, ("max_motion_px",), "--no-interpolate adds no frames")
        if not self._fills:
            refuse(self, ("exposure_ms",), "blur is taken out where frames are put between others")
        if self.labels and not writer.LABELS:
            refuse(self, ("labels",), f"{writer.NAME} cannot store them; dsec (.h5) and npz can")
        if self.preview is None:
            return
        from evflow.report.movie import Film  # takes as long to load as everything else

        if self.preview.suffix.lower() == ".png":
            raise EvflowDataError("EV020", f"--preview {self.preview}.",
                                  "It is a film: .mp4 or .gif.")
        Film().check_target(self.preview, overwrite=self.overwrite)
        need_absent(self.preview, self.overwrite, self.video, self.camera, self.timestamps)

    def _frames(
        self, source: FrameSource, shown: Callable[[int, int], None]
    ) -> Iterator[tuple[Pair, list[Pair]]]:
        """The frames that the pixels are shown, each with the frames of the video up to it, if
        these are to be written."""
        from evflow.light.colour import as_seen
        from evflow.simulator.interpolate import upsample
        from evflow.simulator.photoreceptor import seen_frames

        limit = self.max_motion_px if self._fills else 0.0
        video, came, shown_us = source.watched(shown), deque[Pair](), deque[int]()
        if self.frames_too:
            video = _kept(video, self.colour, came)
        pairs = as_seen(
            video, self.colour, None if limit == 0 else lambda slow, pixel:
            upsample(slow, max_motion_px=pixel * limit, exposure_us=source.exposure_us,
                     warn=source.notes.append))
        for pair in seen_frames(_timed(pairs, shown_us), self.seen_by(source.recorded)):
            now = shown_us.popleft()
            yield pair, [came.popleft() for _ in range(len(came)) if came[0][1] <= now]


def _timed(pairs: Frames, times: deque[int]) -> Frames:
    """The frames as they pass; their times are appended to `times`."""
    for frame, time in pairs:
        times.append(time)
        yield frame, time


def _clocked(pairs: Frames, seen: list[int]) -> Frames:
    """The frames as they pass; `seen` becomes first time, last time, and their number."""
    for frame, time in pairs:
        seen[:] = [*(seen[:1] or [time]), time, seen[2] + 1 if seen else 1]
        yield frame, time


def _coarse(sensor: SensorModel, seen: list[int]) -> list[Note]:
    """A note if frames are further apart than the time constant of v2e's low-pass, which then has
    no effect."""
    if len(seen) < 3 or seen[2] < 2 or not sensor.cutoff_hz or sensor.photoreceptor is not None:
        return []
    apart_s, slow_s = 1e-6 * (seen[1] - seen[0]) / (seen[2] - 1), 0.5 / np.pi / sensor.cutoff_hz
    return [Note(
        "frames.coarse", f"frames are {1e3 * apart_s:.3g} ms apart on average, but the low-pass of "
        f"{sensor.cutoff_hz:g} Hz takes {1e3 * slow_s:.3g} ms at white: bright pixels follow a "
        "frame at once. A higher frame rate would show it.")] if apart_s > slow_s else []


def _none(count: int) -> list[Note]:
    """A note if there are no events."""
    return [] if count else [Note(
        "events.none", "no pixel sent an event: nothing in the frames changes by a threshold. If "
        "it should, is white what is white in them (--full-scale)?")]


def _kept(video: Frames, colour: str, came: deque[Pair]) -> Frames:
    """The frames as they pass, each appended to `came` as the pixels see it."""
    from evflow.light.colour import as_seen

    for frame, time in video:
        came += as_seen(iter([(frame, time)]), colour)
        yield frame, time


def _fitting(
    writer: EventWriter, notes: list[Note]
) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A function that makes frames (T, H, W) fit the format: rounded if it only has integers, which
    a note says once."""
    floats, whole = np.dtype(np.float32), np.dtype(np.uint8)
    rounds = bool(writer.refuses(floats)) and not writer.refuses(whole)
    note = Note("frames.depth", f"frames were rounded to 8 bits, which is what {writer.NAME} holds")

    def fitting(frames: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not rounds or frames.dtype != floats:
            return frames, times
        if note not in notes:
            notes.append(note)
        return np.rint(frames).astype(whole), times

    return fitting


def _recorded(
    made: Iterator[tuple[Pair, list[Pair]]], write: Callable[[np.ndarray, np.ndarray], None]
) -> Frames:
    """The frames of `Simulate._frames` as they pass; the video's frames beside them are written."""
    for pair, came in made:
        for frame, time in came:
            write(frame[None], np.array([time]))
        yield pair



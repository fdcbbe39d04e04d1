"""Options of commands that run a network over a recording in windows and make a film of its output.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Literal

from evflow.commands.options import Compiling, Reading, refuse, value
from evflow.errors import EvflowDataError

if TYPE_CHECKING:
    import numpy as np

    from evflow.types import Recording


@dataclasses.dataclass(frozen=True, kw_only=True)
class Windowed(Compiling, Reading):
    """Options on how a recording is read, cut into windows, and filmed."""

    sync: Literal["auto", "frames", "events", "ms"] = "auto"
    """Where windows end: at the recording's frames, after --window-events, or every --window-ms.
    auto: frames if there are at least two, else ms."""
    window_events: Annotated[int | None, value("N")] = None
    """Events per window (--sync events); by default .35 per pixel."""
    window_ms: float = 33.0
    """Length of a window (--sync ms, and auto without frames)."""
    fps: Annotated[float | None, value("HZ")] = None
    """Pictures per second of the film; by default it lasts as long as the recording."""
    scale: Annotated[int | None, value("N")] = None
    """Screen pixels per pixel of the film; by default it is about 640 wide."""
    codec: Literal["mpeg4", "vp9"] = "mpeg4"
    """For .mp4: mpeg4 plays in video players; vp9 also in browsers, and takes some 50 times
    longer."""
    overwrite: bool = False
    """Replace the output if it exists."""
    json: bool = False
    """Print JSON."""

    def check_film(self) -> None:
        """Raise EV020 if no such film can be made, before any long work."""
        from evflow.report.video import FPS, SCALES, check_within

        check_within(SCALES, "scale", self.scale)
        check_within(FPS, "fps", self.fps)

    def times(self, recording: Recording) -> np.ndarray:
        """The ends (T,) of the windows; EV020 if options contradict each other."""
        from evflow.downstream.sync import sync_times

        idle = {"frames": ("window_events", "window_ms"), "events": ("window_ms",),
                "ms": ("window_events",), "auto": ("window_events",)}[self.sync]
        refuse(self, idle, f"has no effect with --sync {self.sync}")
        if not self.window_ms > 0:
            raise EvflowDataError("EV020", f"--window-ms {self.window_ms:g}.", "It must be > 0.")
        return sync_times(recording, self.sync, count=self.window_events,
                          window_us=round(1000 * self.window_ms))


def frames_amid(recording: Recording, times: np.ndarray) -> range:
    """Which frames lie within the span of the events, since nothing is known without events; if all
    events lie between two frames, the second one. EV012 if events and frames do not overlap."""
    import numpy as np

    t = recording.events.t
    first, stop = (int(np.searchsorted(times, end, "right")) for end in (t[0], t[-1]))
    if first == stop and 0 < first < len(times):
        return range(first, first + 1)
    if first == stop:
        raise EvflowDataError(
            "EV012", f"events cover {t[0]:,}..{t[-1]:,} us, but the frames "
            f"{times[0]:,}..{times[-1]:,} us.",
            "Are both on one clock and in one unit? See --time-unit and --frames-offset-ms; or "
            "pass --sync ms, which does not use the frames.")
    return range(first, stop)


def lasting(pictures: int, duration_us: int) -> float:
    """Pictures per second of a film that lasts as long as what it shows, within the limits of video
    players."""
    from evflow.report.video import FPS

    return float(min(max(1e6 * pictures / max(duration_us, 1), FPS[0]), FPS[1]))

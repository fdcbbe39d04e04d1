"""Real recordings beside what their measured cameras make of their own frames.

    python -m experiments.real_recordings --preset debug
    python -m experiments.real_recordings --preset full --recordings flight.aedat4 drive.bag

Of each recording, with the photoreceptor measured, with an ideal pixel in its place, and with the
maps of the first alone, without its low-pass and the light added: theta, that light, and the
busiest part re-simulated from its own frames, as the report of `evflow estimate` does (correlation
of the pixels' counts, of signed events in cubes of 2 ms and 3x3 pixels, each beside the one that
would be seen if all were true, and events over those recorded), and the share of the brightness at
the events of the second half that the constants of the first explain. True thresholds of these
cameras are unknown. debug: the first recording. Writes real_recordings.json, .md and pictures.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

from evflow import load_weights, read_recording
from evflow.camera.optics import Optics
from evflow.estimation.pipeline import measure
from evflow.report.plots import event_image, new_figure, save_figure
from evflow.report.resimulate import INSTANT_US, Trial, busiest, held_out, resimulate, usable_runs
from evflow.types import Recording
from experiments.shared.common import begin, conclude, markdown, run_script, slug
from experiments.shared.recordings import distinct, held_recordings

Pixel = Literal["measured", "ideal", "maps alone"]
PIXELS: tuple[Pixel, ...] = ("measured", "ideal", "maps alone")
MIN_WINDOW_US = 40_000  # as `evflow estimate`
SIDES = ("on", "off")
HEADS = ("recording", "pixel", "θ ON / OFF", "light added", "cutoff", "r of counts ON / OFF",
         "r in space and time", "events, re-made / recorded", "explained, held out")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Compare real recordings with their re-simulation."""

    preset: Literal["debug", "full"] = "debug"
    out: Path = Path("out/real_recordings")
    seed: int = 0
    weights: str = "default"
    recordings: tuple[Path, ...] = ()
    """Recordings with frames (default: those under $EVFLOW_DATA)."""


def measured(
    recording: Recording, params: Any, pixel: Pixel, seed: int
) -> tuple[dict[str, Any], Trial]:
    """A row of the table, and the stretch that was re-simulated."""
    made = measure(recording, params, pixel="ideal" if pixel == "ideal" else "measured",
                   min_window_us=MIN_WINDOW_US)
    found, runs = made.found, usable_runs(recording)
    if pixel == "maps alone":
        fast = dataclasses.replace(found.sensor, cutoff_hz=0.0, cutoff_by_light=True)
        found = dataclasses.replace(found, sensor=fast, optics=Optics())
    trial = resimulate(recording, found, busiest(recording, runs), seed)
    explained = held_out(recording, params, runs, MIN_WINDOW_US, seed, made.first)[2] if (
        pixel == "measured") else None
    numbers = trial.numbers
    theta = {f"{part}theta_{side}": float(getattr(summary, f"theta_{side}")) for part, summary in (
        ("", found.summary), ("std_", found.summary_std)) for side in SIDES}
    return {**theta, "offset_dn": found.optics.offset_dn, "offset_std": found.optics.offset_dn_std,
            "cutoff_hz": found.sensor.cutoff_hz, "by_light": found.sensor.cutoff_by_light,
            "r": numbers["counts"]["r"], "space_time_r": numbers["space_time_r"],
            "ceiling": trial.ceiling, "events": numbers["rate_hz"]["ratio"],
            "explained": explained}, trial


def cells(name: str, pixel: str, row: dict[str, Any]) -> list[str]:
    most = row["ceiling"]
    theta = " / ".join(f"{row[f'theta_{s}']:.3f} ± {row[f'std_theta_{s}']:.3f}" for s in SIDES)
    cutoff = f"{row['cutoff_hz']:.0f} Hz" + " in any light" * (not row["by_light"])
    light = f"{row['offset_dn']:.0f} ± {row['offset_std']:.0f} DN" if pixel == "measured" else ""
    return [name, pixel, theta, light, cutoff if row["cutoff_hz"] else "",
            " / ".join(f"{row['r'][s]:.3f} of {most[s]:.3f}" for s in SIDES),
            f"{row['space_time_r']:.3f} of {most['space_time_r']:.3f}",
            " / ".join(f"{row['events'][s]:.2f}" for s in SIDES),
            "" if row["explained"] is None else f"{row['explained']:.3f}"]


def draw(trials: dict[str, Trial], path: Path) -> None:
    """The busiest 30 ms as recorded, and as each of the cameras makes them."""
    figure = new_figure(4.0 * (1 + len(trials)), 3.4)
    first = trials[PIXELS[0]]
    shown = {"recorded": first.real, **{f"{k} pixel": t.made for k, t in trials.items()}}
    for k, (name, events) in enumerate(shown.items(), 1):
        axis = figure.add_subplot(1, len(shown), k)
        span = (first.instant_us, first.instant_us + INSTANT_US)
        axis.imshow(event_image(events.slice(*span), *span), interpolation="nearest")
        axis.set(title=name, xticks=[], yticks=[])
    save_figure(figure, path)


def main(options: Options) -> dict[str, Any]:
    begin(options, "real_recordings")
    paths = distinct(options.recordings) or held_recordings()
    params = load_weights(options.weights)
    rows: list[list[str]] = []
    result: dict[str, Any] = {}
    for path in paths[:1] if options.preset == "debug" else paths:
        recording = read_recording(path)
        trials: dict[str, Trial] = {}
        result[path.name] = found = {}
        for pixel in PIXELS:
            found[pixel], trials[pixel] = measured(recording, params, pixel, options.seed)
        ideal, own = found["measured"].pop("explained") or (None, None)
        found["measured"]["explained"], found["ideal"]["explained"] = own, ideal
        for pixel in PIXELS:
            rows.append(cells(path.name, pixel, found[pixel]))
        draw(trials, options.out / f"{slug(path.stem)}.png")
    conclude(options, "real_recordings", result, markdown(HEADS, rows))
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

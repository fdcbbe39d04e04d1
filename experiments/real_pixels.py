"""Thresholds of cameras whose pixels are slow and whose frames are no measurement of light.

    python -m experiments.real_pixels --preset full --rows rows.json --recordings-at flight.aedat4

Hidden cameras, one condition a row: the relative error of theta, how often its 68 and 95 %
intervals hold the truth; of the first five of a row also with `estimate_camera(pixel="ideal")`,
which takes pixels for ideal. Then what else was measured: cutoff, dead time, leak, light
added, and noise rates over pixels, where a condition has them. Then real recordings: the
share of variance that the pooled regression of one half explains of the other, with an ideal pixel
and with that of the first half. The first camera of all rows is measured before the second of any,
so that an interrupted run (--rows) can be ended with fewer (--as-it-is). Writes real_pixels.json,
.md and .png. The paper knows ideal pixels alone.
"""

from __future__ import annotations

import dataclasses
import itertools
import operator
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from evflow import read_recording
from evflow.estimation.refine import frame_noise, plan_runs, receptor_sample
from evflow.estimation.refine.receptor_search import explained, find
from evflow.network.weights import weights_hash
from evflow.recordings.windows import plan_windows
from experiments.shared import pages
from experiments.shared import real_scores as scores
from experiments.shared.common import StudyOptions, begin, conclude, estimator, markdown, run_script
from experiments.shared.kept import Row, kept, resumed
from experiments.shared.many import Setup, made
from experiments.shared.real_cameras import BASE, CHANGES, known

FEW = ("ideal", "cutoff 30.0 Hz", "black level +16 DN")
BESIDE = 5  # cameras of a row that are also taken for ideal


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Measure cameras that are not ideal."""

    out: Path = Path("out/real_pixels")
    seed: int = 9_000_011
    recordings: int | None = None
    """Cameras a condition (default: the preset's)."""
    recordings_at: tuple[Path, ...] = ()
    """Real recordings with frames."""
    rows: Path | None = None
    """Where to keep the rows, to resume an interrupted run from."""
    conditions: tuple[str, ...] = ()
    """Only these conditions (default: the preset's)."""
    as_it_is: bool = False
    """Measure nothing more: tables of the rows that --rows holds, however many of a condition."""


def measured(options: Options, names: Sequence[str], count: int) -> dict[str, list[Row]]:
    """The rows of each condition; the first camera of all before the second of any, and what takes
    pixels for ideal last."""
    setup = Setup(options.weights, options.seed, photos=True)
    origin = [weights_hash(options.weights), options.seed]
    if options.as_it_is:
        return scores.gathered(kept(scores.need_rows(options.rows), origin), names)
    cameras = [(i, name) for i in range(count) for name in names]
    beside = [(i, name) for i, name in cameras if i < BESIDE]
    jobs: list[tuple[Any, int, str]] = [(scores.score, *job) for job in cameras]
    jobs += [(scores.score_ideal, *job) for job in beside]

    def make(left: list[int]) -> Iterable[Row]:
        for scored, some in itertools.groupby((jobs[k] for k in left), operator.itemgetter(0)):
            yield from made(scored, setup, [(i, dataclasses.replace(BASE, **CHANGES[name]))
                                            for _, i, name in some], options.workers)

    keys = [scores.key(name, i, ideal=of is scores.score_ideal) for of, i, name in jobs]
    rows = resumed(options.rows, origin, keys, make, "cameras")
    return scores.gathered(dict(zip(keys, rows, strict=True)), names)


def halves(path: Path) -> list[str] | None:
    """A real recording's cells; None where its halves determine nothing."""
    recording = read_recording(path)
    runs = plan_runs(recording, plan_windows(recording).pairs)
    if not (cuts := scores.in_two(runs)):
        return None
    noise = frame_noise([(recording, i) for run in runs for i in run])
    first, second = (receptor_sample(
        [(recording, cut) for cut in cuts[k::2]], noise) for k in (0, 1))
    if first is None or second is None:
        return None
    found = find(first)
    if found is None:
        return None
    shares = (explained(second, found.ideal, found.ideal_theta),
              explained(second, found.seen, found.theta))
    return [path.name, *(f"{s:.3f}" for s in shares),
            f"{found.seen.offset_dn:.0f} DN", f"{found.seen.cutoff_hz:.0f} Hz"]


def main(options: Options) -> dict[str, Any]:
    begin(options, "real_pixels")
    estimator(options.weights, "summary")
    count = options.count(options.recordings, debug=1, full=40)
    names = known(options.conditions) or (FEW if options.preset == "debug" else tuple(CHANGES))
    real = [line for path in options.recordings_at if (line := halves(path))]
    rows = measured(options, names, count)
    text = "\n\n".join((
        markdown(scores.HEADS, (scores.cells(n, r) for n, r in rows.items())),
        markdown(scores.OTHER_HEADS,
                 scores.sensor_lines(rows) + scores.light_lines(rows)),
        markdown(("recording", "R2 held out, ideal", "measured", "light added", "cutoff"), real)))
    result = {"conditions": rows, "real": real}
    conclude(options, "real_pixels", result, text)
    pages.slow_pixels(options.out / "real_pixels.png", rows)
    return result


if __name__ == "__main__":
    run_script(main, Options, __doc__)

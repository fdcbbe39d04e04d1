"""What experiment scripts refuse before any work, so that nothing is lost and none is in vain."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.networks import random_params

from benchmarks import __main__ as benchmarks
from evflow import Recording
from evflow.errors import EvflowDataError
from evflow.io import write_recording
from evflow.network.config import MODELS
from evflow.network.weights import load_weights, model_card, save_weights
from evflow.training.checkpoint import Checkpoints
from evflow.training.run import started_from
from evflow.types import Events
from experiments import (
    ablate,
    calibrate,
    changes,
    combine,
    compare_systems,
    coverage,
    curves,
    evaluate,
    fuse,
    gallery,
    generate,
    integrate,
    noise_rates,
    one_polarity,
    quickstart,
    real_pixels,
    real_recordings,
    see_better,
    tell_apart,
    template,
    true_video,
)
from experiments.shared import many, rows
from experiments.shared.common import begin, estimator, write_result
from experiments.shared.rows import saved_rows
from experiments.shared.same_runs import nothing_lost, same_setting
from experiments.shared.see_better_settings import preset_of

FITS: list[Any] = [calibrate, fuse, tell_apart]


@pytest.mark.parametrize(("script", "option"), [
    (ablate, "steps"), (changes, "batches"), (compare_systems, "sequences"),
    (coverage, "recordings"), (coverage, "workers"), (curves, "recordings"),
    (evaluate, "sequences"), (generate, "scenes"), (integrate, "seeds"), (true_video, "sequences"),
    (noise_rates, "seeds"), (one_polarity, "recordings"), (quickstart, "width"),
    (quickstart, "milliseconds")], ids=lambda x: x if isinstance(x, str) else x.__name__)
@pytest.mark.parametrize("count", [0, -1])
def test_counts_below_one(script: Any, option: str, count: int, tmp_path: Path) -> None:
    given: dict[str, Any] = {option: count, "out": tmp_path / "out"}
    if script is ablate:
        given["study"] = "losses"
    with pytest.raises(EvflowDataError, match=rf"EV020.*--{option} {count}"):
        script.main(script.Options(**given))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("script", [coverage, one_polarity, fuse, tell_apart],
                         ids=lambda x: x.__name__)
def test_negative_seeds(script: Any, tmp_path: Path) -> None:
    given: dict[str, Any] = {"weights": "default", "seed": -1}
    given["out"] = tmp_path / ("made.safetensors" if script in FITS else "out")
    with pytest.raises(EvflowDataError, match=r"EV020.*--seed -1"):
        script.main(script.Options(**given))


@pytest.mark.parametrize("given", [{"window_s": 0.0}, {"shape": (0, 64)}], ids=str)
def test_windows_without_anything_in_them(given: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match=rf"EV020.*--{next(iter(given)).replace('_', '-')} 0"):
        generate.main(generate.Options(out=tmp_path, **given))


def test_two_lengths_of_a_recording(tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match=r"EV020.*--intervals with --seconds"):
        coverage.main(coverage.Options(out=tmp_path, intervals=8, seconds=1.0))


@pytest.mark.parametrize(("script", "given"), [
    (fuse, {"steps": 0}), (fuse, {"recordings": 4}),
    (tell_apart, {"steps": 0}), (tell_apart, {"recordings": 1})],
    ids=lambda x: str(x) if isinstance(x, dict) else x.__name__)
def test_fits_of_too_little(script: Any, given: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match=rf"EV020.*--{next(iter(given))}"):
        script.main(script.Options("default", out=tmp_path / "made.safetensors", **given))


def test_fusions_that_have_seen_the_recordings(tmp_path: Path) -> None:
    seen = model_card("default")["fusion"]["seeds"]
    assert len(seen) > 1
    given = fuse.Options("default", out=tmp_path / "a.safetensors", continued=True, seed=seen[0])
    with pytest.raises(EvflowDataError, match=rf"EV020.*of seed {seen[0]} before"):
        fuse.main(given)


@pytest.mark.parametrize("script", [fuse, tell_apart, template, coverage, evaluate, true_video],
                         ids=lambda s: s.__name__)
def test_recordings_without_events_give_no_figures(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(_one: object, _setup: object, jobs: list[object], *_: object) -> Iterator[None]:
        yield from (None for _ in jobs)

    for module in (many, rows):
        monkeypatch.setattr(module, "scores", nothing)
    count = "sequences" if script in (evaluate, true_video) else "recordings"
    given: dict[str, Any] = {"out": tmp_path / "out", count: 6}
    if script in FITS:
        given |= {"weights": "default", "out": tmp_path / "made.safetensors"}
    if script is fuse:
        given["rows"] = tmp_path / "rows.npz"
    for _ in range(2):  # rows that are kept are read again
        with pytest.raises(EvflowDataError, match=r"EV017.*0 of the recordings had enough"):
            script.main(script.Options(**given))


@pytest.mark.parametrize("script", [*FITS, coverage, curves, one_polarity, true_video],
                         ids=lambda x: x.__name__)
def test_weights_without_a_summary_or_errors(script: Any, tmp_path: Path) -> None:
    """As those of the paper's network: what is fitted to errors, or scores them, has nothing."""
    paper = MODELS["paper"]
    small = dataclasses.replace(paper, flow=dataclasses.replace(paper.flow, steps=1, hidden=8))
    path = save_weights(tmp_path / "small.safetensors", random_params(small, "paper"), {})
    given = {"weights": str(path), "out": tmp_path / ("a.safetensors" if script in FITS else "out")}
    with pytest.raises(EvflowDataError, match=r"EV018.*no part .*sees every pixel alone"):
        script.main(script.Options(**given))


def test_noise_is_told_apart_after_the_fusion(tmp_path: Path) -> None:
    (name, net), = load_weights("default").items()
    path = save_weights(tmp_path / "unfused.safetensors",
                        {name: {k: v for k, v in net.items() if k != "fusion"}}, {})
    with pytest.raises(EvflowDataError, match=r"EV018.*no part fusion.*experiments\.fuse"):
        tell_apart.main(tell_apart.Options(path, out=tmp_path / "made.safetensors"))


@pytest.mark.parametrize(("given", "seen"), [
    ({"conditions": ("wet",)}, "EV020.*no condition wet"),
    ({"as_it_is": True}, "EV020.*--as-it-is without --rows"),
    ({"as_it_is": True, "rows": Path("absent.json")}, "EV016.*no rows at absent.json")])
def test_conditions_and_rows_that_are_not_there(
    given: dict[str, Any], seen: str, tmp_path: Path
) -> None:
    with pytest.raises(EvflowDataError, match=seen):
        real_pixels.main(real_pixels.Options(out=tmp_path, **given))


@pytest.mark.parametrize("name", ["a.aedat4", "a.bag"])
@pytest.mark.parametrize(("script", "option"), [
    (changes, "recording"), (integrate, "recording"), (real_recordings, "recordings")],
    ids=lambda x: x if isinstance(x, str) else x.__name__)
def test_recordings_of_one_name(script: Any, option: str, name: str, tmp_path: Path) -> None:
    both = (tmp_path / "one/a.aedat4", tmp_path / "other" / name)
    with pytest.raises(EvflowDataError, match=r"EV020.*more than one recording is called \['a'\]"):
        script.main(script.Options(out=tmp_path, **{option: both}))


def test_weights_that_workers_cannot_load_are_named_by_the_parent(tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match=r"EV016.*no weights at .*nowhere"):
        evaluate.main(evaluate.Options(
            weights=str(tmp_path / "nowhere.safetensors"), workers=2, out=tmp_path))


def test_the_mean_of_networks_of_several_sizes_is_refused(tmp_path: Path) -> None:
    paper, paths = MODELS["paper"], []
    for hidden in (8, 16):
        small = dataclasses.replace(
            paper, flow=dataclasses.replace(paper.flow, steps=1, hidden=hidden))
        paths.append(str(save_weights(tmp_path / f"{hidden}.safetensors",
                                      random_params(small, "paper"), {})))
    with pytest.raises(EvflowDataError, match=r"EV018.*networks of several sizes"):
        combine.main(combine.Options(paths[0], tmp_path / "a.safetensors", pixels=tuple(paths)))


def test_a_result_of_other_options_is_not_replaced(tmp_path: Path) -> None:
    options = generate.Options(out=tmp_path, scenes=3)
    begin(options, "generate")
    write_result(tmp_path / "generate.json", {}, dataclasses.asdict(options))
    took = json.loads((tmp_path / "generate.json").read_text())["took"]
    assert took["cpu_s"] > 0 < took["wall_s"]
    begin(options, "generate")
    other = dataclasses.replace(options, scenes=4, seed=5)
    with pytest.raises(EvflowDataError, match=r"EV013.*other options \(seed, scenes\)"):
        begin(other, "generate")
    workers = evaluate.Options(out=tmp_path, workers=2)
    write_result(tmp_path / "evaluate.json", {}, dataclasses.asdict(workers))
    begin(dataclasses.replace(workers, workers=1), "evaluate")
    kept = real_pixels.Options(out=tmp_path)
    write_result(tmp_path / "real_pixels.json", {}, dataclasses.asdict(kept))
    begin(dataclasses.replace(kept, rows=tmp_path / "rows.json"), "real_pixels")


def test_quickstart_replaces_no_other_recording(tmp_path: Path) -> None:
    options = quickstart.Options(out=tmp_path)
    write_result(tmp_path / "result.json", {}, dataclasses.asdict(options))
    begin(options, "result")  # repeated
    with pytest.raises(EvflowDataError, match=r"EV013.*other options \(recording\)"):
        quickstart.main(dataclasses.replace(options, recording=tmp_path / "flight.aedat4"))


def test_quickstart_needs_frames(tmp_path: Path) -> None:
    events = Events([1, 2], [3, 4], [0, 1000], [True, False], (32, 24))
    path = tmp_path / "bare.h5"
    write_recording(path, Recording.of_events(events))
    with pytest.raises(EvflowDataError, match=r"EV011.*bare\.h5 has no frames"):
        quickstart.main(quickstart.Options(path, out=tmp_path / "out"))


@pytest.mark.parametrize("text", ['{"result": {', "[1]", '{"result": {}}', '{"config": 3}'])
def test_a_file_that_is_no_result_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "evaluate.json"
    path.write_text(text)
    with pytest.raises(EvflowDataError, match=r"EV009.*evaluate\.json holds no result"):
        begin(evaluate.Options(out=tmp_path), "evaluate")
    for name in ("setting.json", "see_better.json"):
        (tmp_path / name).write_text('{"config')
    setting = preset_of("video", "debug")
    with pytest.raises(EvflowDataError, match=r"EV009.*setting\.json"):
        same_setting(tmp_path, "video", "default", setting, lpips=False)
    with pytest.raises(EvflowDataError, match=r"EV009.*see_better\.json"):
        nothing_lost(tmp_path, [], 1)


def test_results_that_cannot_be_written_are_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    with pytest.raises(EvflowDataError, match=r"EV019.*its folder is a file"):
        template.main(template.Options(out=tmp_path / "file/results"))
    with pytest.raises(EvflowDataError, match=r"EV013.*file is a file"):
        template.main(template.Options(out=tmp_path / "file"))
    with pytest.raises(EvflowDataError, match=r"EV013.*file is a file"):
        gallery.main(gallery.Options(out=tmp_path / "file"))
    with pytest.raises(EvflowDataError, match=r"EV013.*file is a file"):
        benchmarks.main(benchmarks.Options(out=tmp_path / "file/times.jsonl"))
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize("script", FITS, ids=lambda s: s.__name__)
def test_existing_weights_are_seen_before_the_work(script: Any, tmp_path: Path) -> None:
    out = tmp_path / "made.safetensors"
    out.write_text("kept")
    with pytest.raises(EvflowDataError, match="EV013"):
        script.main(script.Options("default", out=out))
    assert out.read_text() == "kept"
    with pytest.raises(EvflowDataError, match=r"EV020.*\.safetensors"):  # could not be read again
        script.main(script.Options("default", out=tmp_path / "made"))


@pytest.mark.parametrize("script", FITS, ids=lambda s: s.__name__)
def test_weights_of_event_networks_are_no_estimator(script: Any, tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match="EV018"):
        script.main(script.Options("e2vid-small", out=tmp_path / "made.safetensors"))


def test_parts_are_those_of_estimators(tmp_path: Path) -> None:
    out = tmp_path / "made.safetensors"
    for weights, given in (("e2vid-small", {"pixels": ("default",)}),
                           ("default", {"summary": "e2vid-small"}),
                           ("default", {"pixels": ("evflownet-small",)})):
        with pytest.raises(EvflowDataError, match="EV018"):
            combine.main(combine.Options(weights, out=out, **given))
    assert estimator("default")[0] == "default"


def test_a_run_starts_from_something() -> None:
    fresh: Any = SimpleNamespace(params={"default": {"flow": {"kernel": np.zeros(3)}}})
    for weights in ("e2vid-small", "default"):  # another network, and one of other sizes
        with pytest.raises(EvflowDataError, match=r"EV018.*no part of the network"):
            started_from(fresh, weights)


def test_a_file_is_no_folder_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(EvflowDataError, match=r"EV019.*is a file"):
        Checkpoints(tmp_path / "file")


def test_a_refused_command_leaves_its_folder_to_the_next(tmp_path: Path) -> None:
    for wrong in ({"names": ("foo",)}, {"cameras": (f"mine={tmp_path / 'absent.npz'}",)},
                  {"max_seconds": -1.0}, {"max_seconds": math.nan}):
        with pytest.raises(EvflowDataError, match=r"EV020|EV016"):
            see_better.main(see_better.Options(out=tmp_path / "sb", **wrong))
    assert not (tmp_path / "sb").exists()


def test_rows_are_those_of_this_command(tmp_path: Path) -> None:
    path = tmp_path / "rows.npz"
    for damaged in (b"no rows", b"PK\x03\x04 cut"):
        path.write_bytes(damaged)
        with pytest.raises(EvflowDataError, match="EV009"):
            saved_rows(path, "0 a", 5)
    np.savez(path, next=4, origin="0 a", y=np.arange(6.0).reshape(3, 2))
    begun, rows = saved_rows(path, "0 a", 5)
    assert (begun, [r["y"].tolist() for r in rows]) == (4, [[0, 1], [2, 3], [4, 5]])
    for origin, most in (("1 a", 5), ("0 a", 3)):
        with pytest.raises(EvflowDataError, match="EV013"):
            saved_rows(path, origin, most)


def test_real_recordings_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match=r"EV016.*absent"):
        compare_systems.main(compare_systems.Options(data=tmp_path / "absent", out=tmp_path))

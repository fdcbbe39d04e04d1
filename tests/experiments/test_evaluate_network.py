"""Evaluation of networks on recordings: the cut, its events and frames, what is done to images."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import exposure

from evflow import Recording
from evflow.downstream import E2VID, EVFlowNet, Network, event_tensor, normalise, reconstruct
from evflow.downstream.released import load_network, save_network
from evflow.errors import EvflowDataError
from evflow.io import write_recording
from evflow.metrics import PROTOCOLS, FwlConvention, fwl
from evflow.types import Events
from experiments import evaluate_network
from experiments.evaluate_network import Options
from experiments.shared import network_outputs, network_scores, recorded, recorded_parts, targets

SIZE = (32, 24)


def recording(seconds: float = 4.0, lead_us: int = 7_000) -> Recording:
    """A frame each 100 ms, the first before the first event; an event each ms."""
    t = lead_us + np.arange(0, round(1e6 * seconds), 1000)
    rng = np.random.default_rng(0)
    events = Events(rng.integers(0, 32, len(t)), rng.integers(0, 24, len(t)), t,
                    rng.random(len(t)) < 0.5, SIZE)
    times = np.arange(0, round(1e6 * seconds), 100_000)
    frames = (np.arange(len(times)) % 256)[:, None, None] * np.ones((24, 32), int)
    return Recording(events, frames.astype(np.uint8), times)


def saved(folder: Path, network: Network) -> str:
    path = folder / f"{type(network).__name__}.safetensors"
    return str(save_network(path, network, network.init(jax.random.key(0), SIZE), {}))


def test_the_cut_counts_and_its_warm_up_runs() -> None:
    part = recorded.part_of(recording(), "x", 1.0, 2.0, 0.5, 33.0)
    assert part.edges_us[0] == 400_000  # the clock starts at the first frame, at 0
    assert part.edges_us[1] == 500_000
    assert part.edges_us[part.warmup + 1] == 1_000_000
    assert part.edges_us[-1] == 1_900_000
    np.testing.assert_allclose(part.frames[:, 0, 0] * 255, np.arange(5, 20))
    assert part.events.t[0] == 401_000
    assert part.events.t[-1] == 1_900_000
    cold = recorded.part_of(recording(), "x", 1.0, 2.0, 0.0, 33.0)
    assert cold.warmup == 0
    assert cold.edges_us[1] == 1_000_000
    whole = recorded.part_of(recording(), "x", 0.0, np.inf, 10.0, 33.0)
    assert whole.edges_us[0] == 0
    assert len(whole.frames) == 39  # the frame before the first event has none
    assert len(whole.events) == np.count_nonzero(recording().events.t <= 3_900_000)


def test_without_frames_windows_follow_each_other() -> None:
    part = recorded.part_of(Recording.of_events(recording().events), "x", 0.0, np.inf, 10.0, 50.0)
    assert part.frames is None
    assert set(np.diff(part.edges_us)) == {50_000}
    assert part.edges_us[0] == 7_000
    assert part.warmup == 0
    assert len(part.edges_us) == 80
    assert part.events.t[0] == part.edges_us[0]


def test_a_recording_that_ends_before_the_cut_is_refused() -> None:
    with pytest.raises(EvflowDataError, match=r"EV012.*lasts 4\.01 s"):
        recorded.part_of(recording(lead_us=8_000), "x", 5.0, 20.0, 10.0, 33.0)
    with pytest.raises(EvflowDataError, match="EV001"):
        recorded.part_of(Recording.of_events(Events([], [], [], [], SIZE)), "x", 0.0, 1.0, 0.0, 33)


@pytest.mark.parametrize(("file", "name"), [
    ("indoor_flying1_data.hdf5", "indoor_flying1"), ("slider_depth", "slider_depth"),
    ("boxes_6dof.bag", "boxes_6dof"), ("bike_bay_hdr.h5", "bike_bay_hdr"),
    ("poster_6dof_cut.h5", "poster_6dof"), ("office_zigzag/events.npz", "office_zigzag")])
def test_sequences_are_known_by_their_files(file: str, name: str) -> None:
    assert recorded.sequence_name(Path("a.b") / file) == name


def test_the_folder_one_is_in_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "Boxes_6dof").mkdir()
    monkeypatch.chdir(tmp_path / "Boxes_6dof")
    assert recorded.sequence_name(Path(".")) == "Boxes_6dof"
    assert recorded.cut_of(Path(".")) == (5.0, 20.0)


def test_cuts_are_those_of_the_benchmarks() -> None:
    assert recorded.CUTS["slider_depth"] == (1.0, 2.5)
    assert recorded.CUTS["office_zigzag"] == (5.0, 12.0)
    assert recorded.CUTS["indoor_flying4"] == (10.0, 19.8)
    assert len(recorded.CUTS) == 13
    assert recorded.cut_of(Path("slider_depth.h5")) == (1.0, 2.5)
    assert recorded.cut_of(Path("slider_depth_cut.h5")) == (0.0, np.inf)  # it has had it
    assert recorded.cut_of(Path("mine.npz")) == (0.0, np.inf)
    assert all(0 <= a < b for a, b in recorded.CUTS.values())


def test_histograms_are_equalised() -> None:
    rng = np.random.default_rng(1)
    images = (0.4 + 0.1 * rng.random((2, 60, 80))).astype(np.float32)
    assert recorded.equalised(images, "none") is images
    even = recorded.equalised(images, "global")
    expected = exposure.equalize_hist(np.rint(255 * images[0]).astype(np.uint8), nbins=256)
    assert np.abs(even[0] - expected).max() <= 0.5 / 255 + 1e-6
    for how in ("global", "local", "clahe"):
        made = recorded.equalised(images, how)
        assert made.shape == images.shape
        assert made.std() > 1.5 * images.std()
        assert 0 <= made.min() < made.max() <= 1
    with pytest.raises(EvflowDataError, match="EV020"):
        recorded.equalised(images, "other")
    wide = recorded.stretched(images)
    np.testing.assert_allclose(np.percentile(wide[1], (1, 99)), (0, 1), atol=1e-4)


def test_video_and_flow_are_scored_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mine.npz"
    write_recording(path, recording(), "npz")
    names = (saved(tmp_path, E2VID(base=4, encoders=1, blocks=0)),
             saved(tmp_path, EVFlowNet(base=2)))
    shown: list[str] = []
    picture = evaluate_network.picture
    monkeypatch.setattr(evaluate_network, "picture",
                        lambda pairs, path: (shown.extend(pairs), picture(pairs, path)))
    result = evaluate_network.main(Options(
        weights=names, data=(path,), out=tmp_path / "out", aggregate="sequences", histeq="global"))
    video = result[names[0]]["video"]
    assert video["frames"] == 39
    assert video["protocol"]["aggregate"] == "sequences"
    assert np.isfinite([video["mse"], video["log_mse"], video["sequences"]["mine"]["ssim"]]).all()
    assert result[names[1]]["flow"]["mine"]["windows"] == 39
    assert shown == [f"mine, {names[0]}"]  # weights of one name in two folders are two
    told = capsys.readouterr().out
    assert "| mine |" in told
    assert "| GE (Ours) | .052/.704/.266 |" in told
    assert "| GE (Ours) | 1.66 |" in told
    stored = json.loads((tmp_path / "out" / "evaluate_network.json").read_text())
    assert stored["config"]["histeq"] == "global"
    assert cv2.imread(str(tmp_path / "out" / "evaluate_network.png")) is not None
    with pytest.raises(EvflowDataError, match="EV016"):
        evaluate_network.main(Options(weights=names, data=(tmp_path / "no",), out=tmp_path))
    twins = (tmp_path / "a/mine.npz", tmp_path / "b/mine_cut.npz")
    with pytest.raises(EvflowDataError, match=r"EV020.*\['mine'\]"):
        recorded_parts.parts(twins, 10.0, 33.0)
    aggregates = {p: PROTOCOLS[p].aggregate for p in ("evreal", "etnet")}
    assert aggregates == {"evreal": "frames", "etnet": "sequences"}


def test_images_that_are_not_clipped_are_for_the_log_domain(tmp_path: Path) -> None:
    trained = load_network(saved(tmp_path, E2VID(base=4, encoders=1, blocks=0)))
    part = recorded.part_of(recording(1.0), "x", 0.0, np.inf, 0.0, 33.0)
    scores, _ = network_outputs.real_video(trained, [part], PROTOCOLS["etnet"], None)
    assert scores["protocol"]["clip"] is False
    assert np.isfinite([scores["mse"], scores["log_mse"]]).all()


@pytest.mark.parametrize("wrong", [
    {"window_ms": 0.0}, {"window_ms": np.nan}, {"warmup_s": -0.2}, {"warmup_s": np.inf},
    {"scenes": 0}, {"side": 8}])
def test_options_out_of_range_are_refused(tmp_path: Path, wrong: dict) -> None:
    with pytest.raises(EvflowDataError, match=f"EV020.*{next(iter(wrong)).replace('_', '-')}"):
        evaluate_network.main(Options(out=tmp_path / "out", **wrong))
    assert not (tmp_path / "out").exists()


def test_recordings_that_give_nothing_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    def read(_: Path, **hints: object) -> Recording:
        asked.append(hints)
        return Recording.of_events(recording().events)

    monkeypatch.setattr(recorded, "read_recording", read)
    options = Options(weights=(saved(tmp_path, E2VID(base=4, encoders=1, blocks=0)),),
                      data=(tmp_path / "mine.txt",), out=tmp_path / "out", size="32x24")
    with pytest.raises(EvflowDataError, match=r"EV011.*mine\.txt could be scored"):
        evaluate_network.main(options)
    assert asked == [{"size": SIZE}]
    assert not options.out.exists()
    with pytest.raises(EvflowDataError, match=r"EV020.*WxH"):
        evaluate_network.main(dataclasses.replace(options, size="32"))
    with pytest.raises(EvflowDataError, match=r"EV020.*--size without --data"):
        evaluate_network.main(dataclasses.replace(options, data=()))


def test_tables_of_synthetic_cameras_say_how_they_are_scored() -> None:
    row = {"synthetic": {"high noisy": {"ssim": 0.5}}}
    text = network_scores.report({"a": row, "b": row}, "SSIM preset etnet.")
    assert text.count(network_scores.SYNTHETIC_SAID) == 1
    assert text.index("SSIM preset evreal") < text.index("high noisy")
    assert "evreal" not in network_scores.report({"a": {"synthetic": {}}}, "SSIM preset etnet.")


@pytest.mark.slow
def test_without_data_synthetic_cameras_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EVFLOW_DATA", raising=False)
    trained = load_network(saved(tmp_path, EVFlowNet(base=2)))
    options = Options()
    assert evaluate_network.parts(options.data, options.warmup_s, options.window_ms) == []
    assert evaluate_network.rotations() == {}
    monkeypatch.setattr(targets, "CAMERAS", {"low": (0.12, 0.16, 4.0, 2.5, 0.03)})
    monkeypatch.setattr(targets, "CIRCUITS", {
        "esim": targets.CIRCUITS["esim"]})
    rows = network_outputs.Synthetic(side=32, scenes=1).scores(trained, None)
    assert set(rows) == {"low esim"}
    assert rows["low esim"]["aee"] > 0
    split = dataclasses.replace(trained, network=EVFlowNet(bins=10, base=2), split=True)
    params = split.network.init(jax.random.key(0), (32, 32))
    other = network_outputs.Synthetic(side=32, scenes=1).scores(
        dataclasses.replace(split, params=params), None)
    assert other["low esim"]["aee"] > 0
    clips = network_outputs.Synthetic(side=32, scenes=1).clips["low esim"]
    whole = network_outputs._outputs(trained, clips)
    one_by_one = np.stack([reconstruct(trained.network, trained.params, events, edges[1:])
                           for events, edges in zip(clips.events, clips.edges_us, strict=True)], 1)
    np.testing.assert_allclose(whole, one_by_one, atol=1e-4)


@pytest.mark.parametrize(("name", "reference"), [("boxes", 1.56), ("dynamic", 2.06)])
def test_flow_of_a_rotation_is_scored_beside_the_gyroscope(
    name: str, reference: float, data_file: Callable[[str], Path], tmp_path: Path
) -> None:
    one = recorded.read_rotation(data_file(f"data/recordings/ijrr_{name}_rotation"))
    assert len(one.events) > 0.9 * len(one.t)
    trained = load_network(saved(tmp_path, EVFlowNet(base=2)))
    row = network_outputs.real_flow(trained, [], {name: one})[name]
    assert row["fwl_truth"] == pytest.approx(reference, abs=0.01)
    assert row["fwl"] < row["fwl_truth"]


def test_flow_of_a_rotation_is_made_of_the_tensors_that_the_network_learned_from(
    data_file: Callable[[str], Path]
) -> None:
    one = recorded.read_rotation(data_file("data/recordings/ijrr_dynamic_rotation"))
    trained = load_network("evflownet-small")
    assert trained.normalised
    found = network_outputs.real_flow(trained, [], {"dynamic": one})["dynamic"]["fwl"]
    assert found == pytest.approx(1.83, abs=0.01)  # as the model card says
    tensor = jnp.asarray(event_tensor(one.events))[None]
    columns = (*one.xy.T, one.t, one.p, np.ones(len(one.t), np.float32))
    by_hand, raw = (
        float(fwl(*columns, trained.network.apply(trained.params, x)[0][0],
                  FwlConvention(reference="first"))) for x in (normalise(tensor), tensor))
    assert found == pytest.approx(by_hand, rel=1e-5)
    assert abs(found - raw) > 0.02

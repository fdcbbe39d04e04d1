"""The experiment on trained networks: conditions differ in the camera alone, gains are paired."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import recordings
from helpers.networks import small_params

from evflow.camera import Camera
from evflow.camera.optics import Optics, as_arrays
from evflow.camera.sensors import SensorModel
from evflow.downstream import E2VID, EVFlowNet
from evflow.downstream.released import load_network
from evflow.downstream.simulated import SequenceConfig, Sequences, _crop
from evflow.errors import EvflowDataError
from evflow.process.provenance import provenance
from evflow.scenes import make_bank
from evflow.types import Events
from experiments import see_better
from experiments.see_better import Options
from experiments.shared import conditions as made_for
from experiments.shared import eventgan_sequences, gains, held_out, same_runs, targets
from experiments.shared.common import slug
from experiments.shared.conditions import (
    Files,
    Workshop,
    camera_medians,
    conditions,
    named_files,
    network_maps,
)
from experiments.shared.scored_on import OfClips, Recorded
from experiments.shared.see_better_settings import SIMULATED, preset_of
from experiments.shared.trainings import Trainings, run_card

SHAPE = (24, 32)
SMALL = E2VID(base=4, encoders=1, blocks=0)


def target(camera: str = "high", circuit: str = "noisy") -> targets.Target:
    return targets.target(camera, circuit, SHAPE)


def workshop(folder: Path) -> Workshop:
    def record(_: targets.Target) -> None:
        raise AssertionError("nothing is estimated here")

    return Workshop(SHAPE, 4, folder, record, None)


def test_circuits_share_the_camera_and_none_is_the_one_that_trains() -> None:
    noisy, brownian = target(), target(circuit="voltmeter")
    jax.tree.map(np.testing.assert_array_equal, noisy.camera, brownian.camera)
    assert SequenceConfig().model not in targets.CIRCUITS.values()
    seen = camera_medians(noisy.camera)
    for name, value in zip(("theta_on", "theta_off", "eta_on", "eta_off"), targets.CAMERAS["high"],
                           strict=False):
        assert seen[name] == pytest.approx(value, abs=0.02)
    assert float(noisy.camera.eta_on.max()) > 4  # a hot pixel


def test_event_tensors_and_frames_are_those_of_their_windows() -> None:
    edges = np.array([1000, 31_000, 61_000])
    t = np.array([500, 1000, 1001, 31_000, 31_001, 61_000, 61_001])
    events = Events(np.arange(7), np.zeros(7, np.int64), t, np.ones(7, bool), (32, 24))
    borders = np.zeros((3, *SHAPE))
    clip = targets.clip_of(events, edges, borders, np.zeros((2, 2, *SHAPE)))
    np.testing.assert_allclose(clip.tensors.sum((1, 2, 3)), [3, 2])
    assert clip.tensors[0, 0, 1:4].sum() == clip.tensors[0].sum()


@pytest.mark.slow
def test_clips_are_scenes_that_events_follow_and_repeat_themselves() -> None:
    bank = make_bank(jax.random.key(0), procedural=4, photos=False, size=64, cutout_size=24)
    data = SequenceConfig(scene=targets.SCENES)
    first, again = (next(targets.clips(target("low"), bank, data, 1, 4)) for _ in range(2))
    assert first.tensors.shape == (4, *SHAPE, 5)
    assert first.flow.shape == (4, 2, *SHAPE)
    assert 0 <= first.borders.min() < first.borders.max() <= 1
    np.testing.assert_array_equal(first.tensors, again.tensors)
    change = np.diff(np.log(first.borders + 0.08), axis=0)
    events = first.tensors.sum(-1)
    some = np.abs(change) > 0.15
    assert some.sum() > 100
    assert np.corrcoef(change[some], events[some])[0, 1] > 0.5


def test_scores_stand_beside_those_of_no_network() -> None:
    """Two clips of two windows, of which the first is not scored: flow (3, 4) px in one of them."""
    edges = np.array([0, 1000, 2000])
    events = [Events([3, 4], [3, 4], [1, 1500], [True, True], (32, 24))] * 2
    borders = jnp.zeros((3, 2, *SHAPE)).at[2].set(0.9)
    flow = np.zeros((2, 2, 2, *SHAPE), np.float32)
    flow[1, 0] = np.array([3.0, 4.0])[:, None, None]
    clips = held_out.Clips(events, [edges] * 2, jnp.zeros((2, 2, *SHAPE, 5)), borders, flow)
    found = held_out.without_network("flow", clips, 1, None)
    np.testing.assert_allclose(found["no flow"]["aee"], [5.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(found["mean flow of the clip"]["aee"], 0.0, atol=1e-5)
    grey = held_out.without_network("video", clips, 1, None)["even grey"]
    np.testing.assert_allclose(grey["mse"], 0.4**2, rtol=1e-4)
    rows = {"high noisy": {k: {n: float(np.nanmean(x)) for n, x in v.items()}
                           for k, v in found.items()}}
    assert "| no flow | 2.5000 |" in gains.report({"high noisy": {}}, "flow", {}, 0, rows)


def test_every_condition_has_cameras_of_one_shape(tmp_path: Path) -> None:
    whole = Camera.constant((10, 40), theta_on=0.3)
    plain, uncertain = tmp_path / "plain.npz", tmp_path / "uncertain.npz"
    whole.save(plain)
    whole.save(uncertain, **{f"{n}_std": np.full((10, 40), 0.05, np.float32)
                             for n in ("theta_on", "theta_off", "eta_on", "eta_off")})
    found = {c.name: c for c in conditions(
        workshop(tmp_path), [target(), target(circuit="esim"), target("low")],
        ("default", "wide", "wide-log", "e2vid", "oracle"),
        Files(cameras={"plain": plain, "uncertain": uncertain}))}
    assert set(found) == {"default", "wide", "wide-log", "e2vid", "high oracle", "low oracle",
                          "plain", "uncertain"}
    made = {name: c.make() for name, c in found.items()}
    for camera in made.values():
        assert camera is not None
        assert camera.shape == (4, *SHAPE)
        camera.validate()
    np.testing.assert_array_equal(made["high oracle"].theta_on[3], target().camera.theta_on)
    assert [t.name for t in found["high oracle"].targets] == ["high noisy", "high esim"]
    assert len(found["default"].targets) == 3
    assert camera_medians(made["default"])["sigma_on"] == pytest.approx(0.03, abs=0.003)
    wide, low = (np.median(made[name].theta_on, (1, 2)) for name in ("wide", "wide-log"))
    assert 0.05 < min(low) < min(wide)
    assert min(np.std(wide), np.std(low)) > 0.05
    np.testing.assert_array_equal(np.ptp(made["e2vid"].theta_off, (1, 2)), 0.0)
    assert np.median(made["e2vid"].theta_on) == pytest.approx(0.18, abs=0.05)
    assert not np.any(made["e2vid"].eta_on)
    np.testing.assert_allclose(made["plain"].theta_on, 0.3)
    assert 0.03 < float(jnp.std(made["uncertain"].theta_on)) < 0.07
    assert found["plain"].source != found["uncertain"].source


@pytest.mark.slow
def test_an_ablated_network_is_taken_by_its_own_maps() -> None:
    recording = recordings.make(count=3)
    (name, net), = small_params().items()
    weaker = jax.tree.map(lambda a: 0.9 * a, net["flow"])
    maps = [network_maps(recording, {name: net | {"flow": flow}}) for flow in (net["flow"], weaker)]
    assert maps[0].shape == maps[1].shape == (48, 64)
    assert float(jnp.abs(maps[0].theta_on - maps[1].theta_on).mean()) > 0.001


def test_unclear_conditions_are_refused(tmp_path: Path) -> None:
    shop = workshop(tmp_path)
    with pytest.raises(EvflowDataError, match=r"EV020.*nonsense"):
        conditions(shop, [target()], ("nonsense",))
    path = tmp_path / "absent.npz"
    for names, twice in ((("default",), Files(cameras={"default": path})),
                         (("wide", "wide"), Files()),
                         ((), Files(generators={"a": path}, cameras={"a": path}))):
        with pytest.raises(EvflowDataError, match=r"EV020.*two conditions"):
            conditions(shop, [target()], names, twice)
    for absent in (Files(cameras={"mine": path}), Files(generators={"mine": path})):
        with pytest.raises(EvflowDataError, match=r"EV016.*absent"):
            conditions(shop, [target()], (), absent)
    real = Recorded("real", "", recordings.make())
    for name in ("oracle", "oracle+circuit", "raw"):
        with pytest.raises(EvflowDataError, match=r"EV020.*recordings alone"):
            conditions(shop, [real], (name,))
    for given in (("x",), ("=y",), ("a=b", "a=c")):
        with pytest.raises(EvflowDataError, match="EV020"):
            named_files(given)
    assert named_files(("8 steps=a/b.npz",)) == {"8 steps": Path("a/b.npz")}
    assert slug("L_P + L_F/x") == "L_P_+_L_F_x"


def test_a_condition_has_the_targets_circuit_where_it_says_so(tmp_path: Path) -> None:
    measured = SensorModel(cutoff_hz=70.0, eta_is_all=True, noise_resets_memory=True)
    path = Camera.constant(SHAPE).save(
        tmp_path / "mine.npz", **as_arrays(measured, {}, Optics(5.0)))
    slow, fast = target(), target(circuit="esim")
    shop = workshop(tmp_path / "cameras")
    for seen in (slow, fast):
        kept = shop.folder / f"{seen.name} evflow.npz"
        kept.parent.mkdir(exist_ok=True)
        kept.write_bytes(path.read_bytes())
    found = {c.name: c.circuit and c.circuit() for c in conditions(
        shop, [slow, fast], ("default", "evflow", "oracle", "evflow+circuit", "oracle+circuit"),
        Files(cameras={"mine": path}))}
    assert {name: circuit and (circuit[0], circuit[1].offset_dn)
            for name, circuit in found.items()} == {
        "default": None, "high noisy evflow": None, "high esim evflow": None, "high oracle": None,
        "high noisy evflow+circuit": (measured, 5.0), "high esim evflow+circuit": (measured, 5.0),
        "high noisy oracle+circuit": (slow.circuit, 0.0), "mine": (measured, 5.0),
        "high esim oracle+circuit": (fast.circuit, 0.0)}


def test_taken_for_ideal_a_camera_is_measured_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(_recording: object, _params: object, *, pixel: str = "") -> Camera:
        return Camera.constant(SHAPE, theta_on=0.4 if pixel == "ideal" else 0.2)

    monkeypatch.setattr(made_for, "estimate_camera", measured)
    shop = dataclasses.replace(workshop(tmp_path), record=lambda _: recordings.make())
    for name, theta in (("evflow", 0.2), ("evflow ideal", 0.4), ("evflow", 0.2)):
        condition, = conditions(shop, [target()], (name,))
        camera = condition.make()
        assert camera is not None
        np.testing.assert_allclose(camera.theta_on, theta)
        assert condition.circuit is None


def test_cameras_larger_than_a_target_are_cropped_alike_with_their_errors(tmp_path: Path) -> None:
    maps = jnp.arange(40 * 50, dtype=jnp.float32).reshape(40, 50)
    whole = Camera(maps, maps + 1, maps, maps)
    shop = workshop(tmp_path)
    parts = shop.parts(whole)
    assert parts.shape == (4, *SHAPE)
    np.testing.assert_array_equal(parts.theta_off, parts.theta_on + 1)
    np.testing.assert_array_equal(np.diff(parts.eta_on, axis=1), 50)
    assert len({float(m[0, 0]) for m in parts.theta_on}) > 1
    np.testing.assert_array_equal(parts.theta_on, shop.parts(whole).theta_on)


@pytest.mark.slow
def test_a_recording_is_scored_by_its_own_frames_and_by_the_sharpness_of_its_events() -> None:
    whole = recordings.make(count=5)
    real = Recorded("real", "", whole)
    made, frames = real.images(SMALL, SMALL.init(jax.random.key(0), (48, 64)), False)
    assert made.shape == frames.shape
    np.testing.assert_allclose(frames[-1], whole.frame_dn(-1) / 255, atol=1e-6)
    grey = real.without_network("video", None)["even grey"]
    np.testing.assert_allclose(grey["mse"], np.mean((frames - 0.5) ** 2, (1, 2)), rtol=1e-4)
    flow = EVFlowNet(base=4)
    params = flow.init(jax.random.key(0), (48, 64))
    found = real.scores(flow, params, False, None)
    assert found.keys() == {"fwl"}
    np.testing.assert_allclose(real.without_network("flow", None)["no flow"]["fwl"], 1, rtol=1e-4)
    assert len(found["fwl"]) == 9  # whole windows of 30 ms in not quite 300


def test_a_run_is_that_of_the_file_its_camera_comes_from(tmp_path: Path) -> None:
    path = tmp_path / "mine.npz"
    Camera.constant(SHAPE).save(path)
    condition, = conditions(workshop(tmp_path), [target()], (), Files(cameras={"mine": path}))
    card = run_card(condition, condition.make(), seed=3)
    assert card["made_from"] == condition.source
    assert card["cameras"]["theta_on"] == pytest.approx(0.2)
    assert {"seed", "condition", *provenance()} <= card.keys()


def test_sequences_see_crops_of_all_cameras_of_a_stack() -> None:
    maps = jnp.arange(5 * 24 * 32, dtype=jnp.float32).reshape(5, *SHAPE)
    keys = jax.random.split(jax.random.key(0), 60)
    crop = jax.vmap(lambda key: _crop(key, Camera(maps, maps + 1, maps, maps), (16, 16)))(keys)
    rows, columns = (np.diff(crop.theta_on, axis=axis) for axis in (1, 2))
    assert np.all(rows == 32)
    assert np.all(columns == 1)
    np.testing.assert_array_equal(crop.theta_off, crop.theta_on + 1)
    which = np.asarray(crop.theta_on[:, 0, 0]) // (24 * 32)
    assert set(which) == {0, 1, 2, 3, 4}
    # One camera is cropped where the same one in a stack is.
    alone = jax.vmap(lambda key: _crop(key, Camera(*[maps[0]] * 4), (16, 16)))(keys)
    np.testing.assert_array_equal(crop.eta_on % (24 * 32), alone.eta_on)


def test_eventgan_keeps_the_scenes_and_all_of_its_events(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = eventgan_sequences.rebinning(16, 5)
    np.testing.assert_allclose(weights.sum(1), 1)
    np.testing.assert_allclose(weights[0], [1, 0, 0, 0, 0])
    np.testing.assert_allclose(weights[-1], [0, 0, 0, 0, 1])
    config = SequenceConfig(sequences=2, windows=3, crop=16, noise=0.0)
    borders = jax.random.uniform(jax.random.key(0), (4, 2, 16, 16))
    ones = jnp.ones((3, 2, 16, 16, 5))
    given = Sequences(ones, 0 * ones, borders, borders, borders, borders)
    monkeypatch.setattr(eventgan_sequences, "sample_sequences", lambda *_: given)
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def generate(_: object, before: jax.Array, after: jax.Array) -> jax.Array:
        seen.append((np.asarray(before), np.asarray(after)))
        return jnp.concatenate([jnp.full((*after.shape, 16), 2.0), jnp.ones((*after.shape, 16))],
                               -1)

    monkeypatch.setattr(eventgan_sequences, "generate", generate)
    made = eventgan_sequences.sample(jax.random.key(1), None, config, {})
    np.testing.assert_array_equal(made.borders, borders)
    np.testing.assert_allclose(seen[0][0], 255 * borders[:-1])
    np.testing.assert_allclose(seen[0][1], 255 * borders[1:])
    np.testing.assert_allclose(made.tensors.sum(-1), 16, rtol=1e-5)  # 2 - 1 of each bin


def test_a_table_is_never_replaced_by_a_narrower_one(tmp_path: Path) -> None:
    path = tmp_path / "see_better.json"
    both = [target(), target("low")]
    full, fewer = (conditions(workshop(tmp_path), both, names)
                   for names in (("default", "wide", "oracle"), ("wide",)))
    same_runs.nothing_lost(tmp_path, fewer, 1)  # there is none
    rows = {name: {"ssim": {0: np.full(6, 0.1), 1: np.full(6, 0.2)}}
            for name in ("default", "wide", "oracle")}
    found = {t.name: gains.compared(rows) for t in both}
    path.write_text(json.dumps({"result": {"targets": found}}))
    same_runs.nothing_lost(tmp_path, full, 2)
    alone = conditions(workshop(tmp_path), both[:1], ("default", "wide", "oracle"))
    for given, seeds, lost in ((fewer, 3, "default, oracle,"), (full, 1, "seed 1,"),
                               (alone, 2, "low noisy,")):
        with pytest.raises(EvflowDataError, match=f"EV013.* has {lost} which"):
            same_runs.nothing_lost(tmp_path, given, seeds)


def test_numbers_that_leave_nothing_to_do_are_refused() -> None:
    for wrong in ({"seeds": 0}, {"steps": 0}):
        with pytest.raises(EvflowDataError, match=r"EV020.*Give 1 or more"):
            see_better.chosen(Options(**wrong))


@pytest.mark.slow
def test_runs_are_kept_and_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = see_better.main(Options(out=tmp_path, seeds=1))
    assert set(first["high noisy"]) == set(SIMULATED)
    kept = {p: p.stat().st_mtime_ns for p in tmp_path.glob("runs/*/0/*")}
    assert len(kept) == 2 * len(SIMULATED)
    second = see_better.main(Options(out=tmp_path, seeds=2))
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert second["high noisy"]["evflow"]["ssim"]["seeds"] == [0, 1]
    assert second["high noisy"]["evflow"]["ssim"]["to wide"]["seeds"] == 2
    estimate = tmp_path / "cameras" / "high noisy evflow.npz"
    assert 0.2 < float(jnp.median(Camera.load(estimate).theta_on)) < 0.7
    monkeypatch.setattr(Trainings, "train", lambda *_: pytest.fail("trained again"))
    capsys.readouterr()
    assert see_better.main(Options(out=tmp_path, seeds=2)) == second
    assert "missing" not in capsys.readouterr().out
    see_better.main(Options(out=tmp_path, seeds=3, max_seconds=0.0))
    assert f"{len(SIMULATED)} trainings are missing" in capsys.readouterr().out
    saved = json.loads((tmp_path / "see_better.json").read_text())
    assert saved["result"]["missing"] == len(SIMULATED)
    assert saved["result"]["without_network"]["high noisy"]["even grey"]["mse"] > 0
    for name in ("see_better.png", "see_better_clips.png"):
        assert cv2.imread(str(tmp_path / name)) is not None
    with pytest.raises(EvflowDataError, match="EV013"):
        see_better.main(Options(out=tmp_path, steps=7))


@pytest.mark.slow
def test_recordings_of_the_target_train_without_true_flow(tmp_path: Path) -> None:
    setting = preset_of("flow", "debug")
    setting = dataclasses.replace(setting, names=("raw",), seeds=1, drawn=3, learning=(
        dataclasses.replace(setting.learning, steps=2)))
    runs = Trainings(setting, tmp_path)
    (raw,) = runs.conditions()
    assert (raw.label, raw.name, raw.make()) == ("raw", "high noisy raw", None)
    bank = runs.recorded(raw.targets[0])
    assert bank.tensors.shape == (3, 4, 32, 32, 5)
    assert bank.borders.shape == (3, 5, 32, 32)
    held = runs.scored_on(raw.targets[0])
    assert isinstance(held, OfClips)
    assert not np.array_equal(bank.borders[0, 0], held.clips.borders[0, 0])
    assert runs.recorded(raw.targets[0]) is bank  # made once for all seeds
    runs.complete(raw, 0)
    trained = load_network(str(runs.folder(raw, 0) / "weights.safetensors"))
    assert trained.network == runs.network(raw) == dataclasses.replace(setting.network, scales=4)
    found = runs.scores([raw])["high noisy"]["raw"]["aee"][0]
    assert found.shape == (setting.scenes,)


def test_presets_fit_their_networks() -> None:
    for task in ("video", "flow"):
        for preset in ("debug", "small", "full"):
            s = preset_of(task, preset)
            assert min(s.shape) >= s.learning.data.crop
            assert s.skipped < s.windows
            assert s.learning.data.crop % s.network.stride == 0
            assert s.network.bins == s.learning.data.bins
    chosen = see_better.chosen(Options(preset="full", targets=("low",), seeds=2))
    assert chosen.cameras == ("low",)
    assert dataclasses.replace(chosen, seeds=5).seeds != chosen.seeds

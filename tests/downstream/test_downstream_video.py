"""Recordings through event networks: windows, files of weights, frames made, scores."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.event_networks import EVEN, MOTION, even, saved, steady
from helpers.recordings import make

from evflow.downstream import flow, load_network, reconstruct, sync_times, video, window_edges
from evflow.downstream.prior import WidePrior
from evflow.downstream.sync import PER_PIXEL
from evflow.errors import EvflowDataError
from evflow.metrics import PROTOCOLS, score_flow, score_images
from evflow.metrics.flow import FWL
from evflow.types import Events, Recording


def test_windows_follow_frames_counts_or_the_clock() -> None:
    recording = make()
    t = recording.events.t
    np.testing.assert_array_equal(sync_times(recording), recording.frame_times)
    bare = Recording.of_events(recording.events)
    equal = sync_times(bare, window_us=20_000)
    np.testing.assert_array_equal(equal, sync_times(recording, "ms", window_us=20_000))
    np.testing.assert_array_equal(np.diff(equal), 20_000)
    assert t[0] + 20_000 == equal[0]
    assert t[-1] - 20_000 < equal[-1] <= t[-1]
    counted = sync_times(recording, "events", count=300)
    inside = np.searchsorted(t, counted, "right")
    assert np.all(np.abs(inside - 300 * np.arange(1, 7)) < 3)  # events may share an instant
    assert len(sync_times(recording, "events")) == int(2000 / (PER_PIXEL * 64 * 48))
    assert len(sync_times(recording, "ms", window_us=10**9)) == 1
    assert len(sync_times(recording, "events", count=10**9)) == 1


def test_edges_begin_with_the_first_event() -> None:
    recording = make()
    edges = window_edges(recording, recording.frame_times)
    assert edges[0] == recording.events.t[0]
    assert np.all(np.diff(edges) > 0)
    np.testing.assert_array_equal(edges[1:], recording.frame_times)
    early = recording.events.t[0] - 5
    np.testing.assert_array_equal(
        window_edges(recording, np.array([early, early + 50])), [early + 5, early + 50])


def test_events_of_one_instant_make_no_window() -> None:
    at_once = Recording.of_events(Events([1, 2], [1, 2], [7, 7], [True, False], (64, 48)))
    with pytest.raises(EvflowDataError, match=r"EV017.*all events are at 7 us"):
        window_edges(at_once, sync_times(at_once, "events"))


@pytest.mark.parametrize(("code", "options"), [
    ("EV011", {"sync": "frames"}), ("EV020", {"sync": "events", "count": 0}),
    ("EV020", {"sync": "ms", "window_us": 0}), ("EV020", {"sync": "often"}),
    ("EV020", {"sync": "ms", "window_us": 33_000.0}),
    ("EV020", {"sync": "ms", "window_us": np.nan}), ("EV020", {"sync": "events", "count": 100.0})])
def test_windows_that_cannot_be_are_refused(code: str, options: dict) -> None:
    bare = Recording.of_events(make().events)
    with pytest.raises(EvflowDataError, match=code):
        sync_times(bare, **options)
    with pytest.raises(EvflowDataError, match="EV001"):
        sync_times(Recording.of_events(bare.events.slice(0, 0)))
    with pytest.raises(EvflowDataError, match="EV001"):
        window_edges(Recording.of_events(bare.events.slice(0, 0)), np.array([1]))
    with pytest.raises(EvflowDataError, match="EV001"):
        window_edges(bare, np.zeros(0, np.int64))


def test_a_clock_that_jumps_takes_no_memory() -> None:
    unix = 1_700_000_000_000_000
    jump = Events([1, 2], [1, 2], [0, unix], [True, False], (64, 48))
    with pytest.raises(EvflowDataError, match=r"EV026.*1,700,000,000,000,000 us.*33,000 us"):
        sync_times(Recording.of_events(jump))


def test_a_saved_network_comes_back_whole(tmp_path: Path) -> None:
    for trained in (even(), steady()):
        back = load_network(saved(tmp_path, trained))
        assert back.network == trained.network
        jax.tree.map(np.testing.assert_array_equal, back.params, trained.params)
        assert back.how == {"normalised": False}


def test_other_files_are_no_networks(tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match="EV018"):
        load_network("default")
    with pytest.raises(EvflowDataError, match="EV016"):
        load_network(tmp_path / "none.safetensors")
    from evflow.downstream import released

    trained = even()
    wrong = {**trained.params, "prediction": {"conv": {"bias": jnp.zeros(3)}}}
    path = released.save_network(tmp_path / "w.safetensors", trained.network, wrong, {})
    with pytest.raises(EvflowDataError, match="EV018"):
        load_network(path)


def test_weights_that_are_not_finite_are_no_network(tmp_path: Path) -> None:
    trained = even()
    broken = jax.tree.map(lambda leaf: leaf.at[..., 0].set(jnp.nan), trained.params)
    with pytest.raises(EvflowDataError, match=r"EV007.*NaN or infinite"):
        saved(tmp_path, dataclasses.replace(trained, params=broken))


def test_missing_released_weights_say_how_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    from evflow.downstream import released

    monkeypatch.setitem(released.RELEASED, "absent-small", "firenet")
    with pytest.raises(EvflowDataError, match=r"EV016.*train_network --network firenet"):
        load_network("absent-small")


def passing(motion: tuple[float, float], steps: int = 96, side: int = 64) -> Events:
    """Events of a random texture that moves by `motion` px (x, y) in 30 ms, thresholds .2."""
    rng = np.random.default_rng(0)
    waves = rng.uniform(-0.9, 0.9, (40, 2))  # rad/px
    phases = rng.uniform(0, 2 * np.pi, 40)
    y, x = np.mgrid[:side, :side]
    columns: list[list[np.ndarray]] = []
    level = None
    for i in range(steps + 1):
        moved = np.multiply(motion, i / steps)
        light = 0.2 * sum(np.cos(kx * (x - moved[0]) + ky * (y - moved[1]) + phase)
                          for (kx, ky), phase in zip(waves, phases, strict=True))
        level = light.copy() if level is None else level
        for sign in (1, -1):
            rows, cols = np.nonzero(sign * (light - level) >= 0.2)
            level[rows, cols] += 0.2 * sign
            t = np.full(len(rows), i * 30_000 // steps)
            columns.append([cols, rows, t, np.full(len(rows), sign > 0)])
    xs, ys, ts, ps = (np.concatenate(c) for c in zip(*columns, strict=True))
    return Events(xs, ys, ts, ps, (side, side))


@pytest.mark.parametrize("motion", [(4.0, 0.0), (-3.0, 2.0), (0.0, -4.0), (1.0, 1.5)])
def test_the_released_flow_sees_where_a_texture_goes(motion: tuple[float, float]) -> None:
    events = passing(motion)
    trained = load_network("evflownet-small")
    (found,) = flow.window_flows(trained, events, np.array([0, 30_000]))
    error = np.hypot(*(found[:, events.y, events.x] - np.reshape(motion, (2, 1)))).mean()
    assert error < 0.5 * np.hypot(*motion)
    assert trained.card["held_out"]["aee"] < 0.75 * trained.card["held_out"]["none_aee"]


def test_frames_are_made_for_recordings_without() -> None:
    bare = Recording.of_events(make().events)
    calls: list[tuple[int, int]] = []
    seen = video.with_reconstructed_frames(
        bare, even(), window_us=20_000, progress=lambda *now: calls.append(now))
    assert seen.events is bare.events
    np.testing.assert_allclose(seen.frames, 255 * EVEN, rtol=1e-6)
    assert seen.frames.dtype == np.float32
    times = sync_times(bare, window_us=20_000)
    np.testing.assert_array_equal(seen.frame_times, times[video.WARM_UP:])
    assert seen.notes[-1].code == "frames.made"
    assert calls[-1] == (len(times), len(times))
    with pytest.raises(EvflowDataError, match="EV017"):
        video.with_reconstructed_frames(bare, even(), window_us=100_000)
    with pytest.raises(EvflowDataError, match="EV020"):
        video.with_reconstructed_frames(bare, steady())


def test_scores_of_a_stream_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    images = rng.uniform(-0.1, 1.1, (12, 24, 32)).astype(np.float32)
    frames = rng.uniform(0, 255, (12, 24, 32)).astype(np.float32)
    monkeypatch.setattr(video, "SCORED_AT_ONCE", 3)
    scores = video.FrameScores(PROTOCOLS["evreal"], None, warm_up=4)
    assert scores.result() is None
    for pair in zip(images, frames, strict=True):
        scores.add(*pair)
    found = scores.result()
    whole = score_images({"": (images[4:], frames[4:] / 255)}, "evreal")
    assert found is not None
    assert found["frames"] == 8
    assert found["protocol"] == whole["protocol"]
    for kind in ("mse", "ssim", "psnr", "rmse"):
        assert found[kind] == pytest.approx(whole[kind], rel=1e-5)


def test_an_event_on_an_edge_is_seen_in_the_window_where_it_is_scored() -> None:
    t = np.array([0, 3_000, 10_000, 10_000, 14_000, 20_000])
    events = Events(np.arange(6) * 9, np.arange(6) * 7, t, np.arange(6) % 2, (64, 48))
    edges, trained = np.array([0, 10_000, 20_000]), load_network("evflownet-small")
    scores = flow.FlowScores(events, edges)
    for i, found in enumerate(flow.window_flows(trained, events, edges)):
        alone = events.slice(*edges[i:i + 2].tolist())
        (wanted,) = reconstruct(trained.network, trained.params, alone, edges[i + 1:i + 2],
                                **trained.how)
        np.testing.assert_array_equal(found, wanted)
        scores.add(found)
    assert scores.result()["events_per_window"] == 2.5  # 2 and 3: none is seen twice


def test_flow_is_scored_window_by_window() -> None:
    recording = make()
    events, edges = recording.events, recording.frame_times
    shape = (len(edges) - 1, 2, 48, 64)
    truth = flow.FlowTruth(np.ones(shape, np.float32), edges, np.ones((shape[0], 48, 64), bool))
    scores = flow.FlowScores(events, edges, truth)
    flows = list(flow.window_flows(steady(), events, edges))
    for one in flows:
        np.testing.assert_allclose(one, np.broadcast_to(np.reshape(MOTION, (2, 1, 1)), shape[1:]))
        scores.add(one)
    found = scores.result()
    whole = score_flow(events, edges, np.stack(flows), truth=truth.flow, valid=truth.valid)
    assert found["aee"] == pytest.approx(np.hypot(2, 2), rel=1e-5)
    assert found["convention"] == FWL.as_dict()
    for kind in ("fwl", "rsat", "aee", "fwl_truth", "events_per_window", "windows"):
        assert found[kind] == pytest.approx(whole[kind], rel=1e-4), kind


def test_full_colour_is_at_the_fastest() -> None:
    recording = make()
    edges = window_edges(recording, recording.frame_times)
    assert flow.full_motion(steady(), recording.events, edges) == pytest.approx(np.hypot(*MOTION))
    silent = Events([0], [0], [5], [True], (64, 48))
    assert flow.full_motion(steady(), silent, np.array([100, 200])) == 1.0


def test_true_flow_of_another_recording_is_refused(tmp_path: Path) -> None:
    good = {"flow": np.zeros((2, 2, 48, 64), np.float32), "edges_us": np.array([0, 5, 9])}
    np.savez(tmp_path / "a.npz", **good)
    truth = flow.load_truth(tmp_path / "a.npz", (64, 48))
    assert truth.valid.shape == (2, 48, 64)
    assert truth.valid.all()
    bad = [("EV015", good | {"edges_us": np.array([0, 5])}), ("EV008", {"flow": good["flow"]}),
           ("EV015", good | {"flow": np.zeros(5)}), ("EV004", good | {"edges_us": np.array(3)}),
           ("EV015", good | {"flow": np.full((2, 2, 48, 64), "a")}),
           ("EV015", good | {"valid": np.ones(3)}),
           ("EV004", good | {"edges_us": np.array([0, 5, 5])}),
           ("EV004", good | {"edges_us": np.array([0, 5, 4], np.uint64)})]
    for code, arrays in bad:
        np.savez(tmp_path / "b.npz", **arrays)
        with pytest.raises(EvflowDataError, match=code):
            flow.load_truth(tmp_path / "b.npz", (64, 48))


def test_the_wide_prior_keeps_its_ranges() -> None:
    prior = WidePrior(mismatch=(0.0, 0.0))
    keys = jax.random.split(jax.random.key(0), 300)
    cameras = jax.jit(jax.vmap(lambda k: prior.sample(k, (2, 3))))(keys)
    on, off, eta = (np.asarray(m)[:, 0, 0] for m in (
        cameras.theta_on, cameras.theta_off, cameras.eta_on))
    assert on.min() >= 0.05
    assert on.max() <= 1.0
    assert abs(np.median(np.log(on)) - np.log(0.05) / 2) < 0.25  # even in the logarithm
    even = jax.jit(jax.vmap(lambda k: WidePrior(uniform=True).sample(k, (1, 1))))(keys)
    assert abs(np.median(even.theta_on) - 0.525) < 0.06
    assert 1.4 < np.exp(np.abs(np.log(on / off))).max() <= 1.5 + 1e-5
    assert 0 <= eta.min() < 0.1
    assert 1.9 < eta.max() <= 2
    uneven = jax.jit(lambda k: WidePrior().sample(k, (40, 40)))(keys[0])
    spread = float(uneven.theta_on.std() / uneven.theta_on.mean())
    assert 0.015 < spread < 0.25
    assert np.ptp(np.asarray(cameras.theta_on), axis=(1, 2)).max() == 0
    for wrong in ({"theta": (0.0, 1.0)}, {"ratio": 0.5}, {"eta": (2.0, 1.0)}):
        with pytest.raises(EvflowDataError, match="EV020"):
            WidePrior(**wrong)

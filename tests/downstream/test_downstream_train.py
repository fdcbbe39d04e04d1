"""Training of the event networks: sequences that agree with themselves, losses, one step."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evflow.baselines.eventgan import GanConfig
from evflow.camera import Camera
from evflow.camera.sensors import SensorModel
from evflow.downstream import E2VID, EVFlowNet, losses
from evflow.downstream.recorded import recorded_bank, sample_recorded
from evflow.downstream.simulated import (
    SequenceConfig,
    Sequences,
    draw_noise,
    has_events,
    sample_sequences,
    scene_clock,
)
from evflow.downstream.tensor import normalise
from evflow.downstream.train import LearningConfig, init_state, make_step, optimiser
from evflow.errors import EvflowDataError
from evflow.scenes import TextureBank, make_bank
from evflow.types import Events, Recording

DATA = SequenceConfig(sequences=4, windows=4, steps_per_window=4, crop=16, noise=0.1,
                      hot_pixels=0.0, model=SensorModel())
SMALL = E2VID(base=4, encoders=1, blocks=0)
sample = jax.jit(sample_sequences, static_argnames="config")


@functools.cache
def bank() -> TextureBank:
    return make_bank(jax.random.key(0), procedural=4, photos=False, size=64, cutout_size=24)


@functools.cache
def sequences(config: SequenceConfig = DATA) -> Sequences:
    return sample(jax.random.key(3), bank(), config)


def test_sequences_have_time_first_and_frames_on_0_to_1() -> None:
    s = sequences()
    lead = (DATA.windows, DATA.sequences)
    assert s.tensors.shape == (*lead, 16, 16, 5)
    assert s.frames.shape == s.visible.shape == (*lead, 16, 16)
    assert s.flow.shape == s.back.shape == (*lead, 2, 16, 16)
    assert 0 <= float(s.frames.min()) < float(s.frames.max()) <= 1
    jax.tree.map(np.testing.assert_array_equal, s, sample(jax.random.key(3), bank(), DATA))


def test_events_follow_the_light_between_frames() -> None:
    s = sequences()
    change = np.diff(np.log(np.asarray(s.borders) + 0.08), axis=0)
    events = np.asarray(s.tensors.sum(-1))
    some = np.abs(change) > 0.15
    assert some.sum() > 100
    assert np.corrcoef(change[some], events[some])[0, 1] > 0.6


def test_frames_moved_along_the_flow_are_the_next_frames() -> None:
    s = sequences()
    inside = np.asarray(s.visible, bool)
    still = np.abs(np.asarray(s.before - s.frames))[inside].mean()
    moved = np.abs(np.asarray(losses.warp(s.before, s.back) - s.frames))[inside].mean()
    assert moved < 0.6 * still


def test_the_scene_stands_still_in_pauses_and_time_never_falls() -> None:
    config = SequenceConfig(windows=400, steps_per_window=2, pause=0.2, resume=0.5, window_s=0.1)
    clock = np.asarray(scene_clock(jax.random.key(0), config))
    assert clock.shape == (801,)
    moved = np.diff(clock[::2])
    still = moved == 0
    np.testing.assert_allclose(moved[~still], 0.1, rtol=1e-3)
    assert abs(still.mean() - 0.2 / 0.7) < 0.08  # of the two-state chain
    never = scene_clock(jax.random.key(0), SequenceConfig(pause=0.0))
    np.testing.assert_allclose(never[-1], 14 * 0.03, rtol=1e-4)


def test_noise_spares_the_first_window_and_hot_pixels_stay() -> None:
    config = SequenceConfig(windows=4, crop=64, noise=0.1, hot_pixels=0.0)
    key = jax.random.key(5)
    noisy = np.asarray(draw_noise(key, config))
    assert not noisy[0].any()
    assert abs(noisy[1:].std() - 0.1) < 0.002
    hot = np.asarray(draw_noise(key, dataclasses.replace(config, hot_pixels=1.0))) - noisy
    assert 0.02 < (hot[0] != 0).any(-1).mean() < 0.98
    np.testing.assert_allclose(hot, np.broadcast_to(hot[:1, ..., :1], hot.shape), atol=1e-6)


def test_noise_is_not_taken_for_events() -> None:
    """Normalised tensors have deviation 1 where there are events, as they will have in use."""
    s = sequences()
    np.testing.assert_array_equal(s.given(False), s.tensors + s.noise)
    assert float(jnp.std(s.noise[1:])) == pytest.approx(0.1, rel=0.05)
    clean = np.asarray(s.given(True) - s.noise)
    np.testing.assert_allclose(clean, normalise(s.tensors), atol=1e-6)
    assert not clean[s.tensors == 0].any()
    assert 0.2 < np.mean(s.tensors == 0) < 1


@pytest.mark.slow
def test_a_measured_camera_is_the_one_that_looks() -> None:
    """A camera of high thresholds has fewer events, and its dead columns have none."""
    silent = {"eta_on": 0.0, "eta_off": 0.0}
    low = Camera.constant((16, 16), theta_on=0.1, theta_off=0.1, **silent)
    dead = jnp.full((16, 16), 0.6).at[:, 5].set(50.0)
    high = dataclasses.replace(low, theta_on=dead, theta_off=dead)
    many, few = (sample(jax.random.key(3), bank(), DATA, camera) for camera in (low, high))
    assert float(jnp.abs(few.tensors).sum()) < 0.5 * float(jnp.abs(many.tensors).sum())
    assert not np.asarray(few.tensors[..., 5, :]).any()
    assert np.asarray(few.tensors[..., 6, :]).any()
    with pytest.raises(EvflowDataError, match="EV015"):
        sample_sequences(jax.random.key(0), bank(), DATA, Camera.constant((8, 20)))


@pytest.mark.slow
def test_its_circuit_looks_too() -> None:
    """A slow or a dead pixel has fewer events of the same frames, and one that sees more light."""
    camera = Camera.constant((16, 16), theta_on=0.1, theta_off=0.1, eta_on=0.0, eta_off=0.0)

    def events(model: SensorModel, offset_dn: float = 0.0) -> np.ndarray:
        data = dataclasses.replace(DATA, model=model, offset_dn=offset_dn)
        return np.asarray(sample(jax.random.key(3), bank(), data, camera).tensors)

    ideal = events(SensorModel())
    for slow in (events(SensorModel(cutoff_hz=10.0)), events(SensorModel(refractory_s=0.02)),
                 events(SensorModel(), 40.0)):
        assert np.abs(slow).sum() < 0.8 * np.abs(ideal).sum()
        assert np.corrcoef(slow.sum(-1).ravel(), ideal.sum(-1).ravel())[0, 1] > 0.4


def test_the_truth_costs_nothing_and_flicker_does() -> None:
    s = sequences()
    assert float(losses.reconstruction(s.frames, s.frames)) < 1e-5
    steady = float(losses.temporal(s.frames, s.frames, s.back, s.visible, 1))
    sign = jnp.array([1.0, -1.0, 1.0, -1.0]).reshape(4, 1, 1, 1)
    flicker = float(losses.temporal(s.frames + 0.2 * sign, s.frames, s.back, s.visible, 1))
    assert steady < 0.3 * flicker
    assert float(losses.flow_l1(s.flow + 0.5, s.flow)) == pytest.approx(0.5, rel=1e-5)


def test_pixels_without_events_may_count_less() -> None:
    s = sequences()
    seen = has_events(s.tensors)
    assert 0 < float(seen.mean()) < 1
    off = s.flow + jnp.where(seen, 1.0, 3.0)[:, :, None]
    for elsewhere, mean in ((1.0, 3.0 - 2.0 * seen.mean()), (0.0, 1.0)):
        weight = jnp.where(seen, 1.0, elsewhere)
        assert float(losses.flow_l1(off, s.flow, weight)) == pytest.approx(float(mean), rel=1e-5)
    assert float(losses.flow_l1(off, s.flow, jnp.zeros_like(weight))) == 0.0


def test_the_true_flow_explains_the_frames_best() -> None:
    """Photometric loss of constant flows on an image that moves by 2 px in x, 1 in y."""
    rng = np.random.default_rng(0)
    texture = jax.image.resize(jnp.asarray(rng.uniform(size=(1, 16, 16))), (1, 64, 64), "cubic")
    before, after = texture[:, 8:40, 8:40], texture[:, 7:39, 6:38]

    photometric = jax.jit(losses.photometric)

    def loss(x: float, y: float) -> float:
        full = np.broadcast_to(np.float32([x, y]).reshape(1, 2, 1, 1), (1, 2, 32, 32))
        return float(photometric((0.5 * full[..., ::2, ::2], full), before, after))

    true = loss(2.0, 1.0)
    assert true < min(loss(*other) for other in ((0, 0), (-2, -1), (1, 1), (2, 2), (3, 1)))
    rough = rng.normal(size=(1, 2, 32, 32)).astype(np.float32)
    same = np.zeros(before.shape, np.float32)
    assert float(photometric((rough,), same, same)) > 0.2  # by its roughness alone


def test_leaving_the_image_costs() -> None:
    rng = np.random.default_rng(2)
    frame = jnp.asarray(rng.uniform(0.2, 0.8, (1, 32, 32)), jnp.float32)

    def loss(x: float) -> float:
        flow = jnp.stack([jnp.full((1, 32, 32), x), jnp.zeros((1, 32, 32))], 1)
        return float(losses.photometric((flow,), frame, frame))

    assert loss(0.0) < 0.1 * loss(2.0) < 0.1 * loss(256.0)


def test_smoothness_does_not_outweigh_the_frames() -> None:
    """Half of the image moves by 2 px: its flow, with a step in it, beats none and the mean."""
    rng = np.random.default_rng(1)
    texture = jax.image.resize(jnp.asarray(rng.uniform(size=(1, 16, 16))), (1, 64, 64), "cubic")
    texture = 0.4 + 0.2 * texture  # the contrast of an indoor scene
    half = jnp.arange(32) < 16
    before = texture[:, 8:40, 8:40]
    after = jnp.where(half, texture[:, 8:40, 6:38], before)

    def loss(left: float, right: float) -> float:
        x = jnp.broadcast_to(jnp.where(half, left, right), (1, 32, 32))
        return float(losses.photometric((jnp.stack([x, jnp.zeros_like(x)], 1),), before, after))

    assert loss(2.0, 0.0) < 0.5 * min(loss(0.0, 0.0), loss(1.0, 1.0), loss(2.0, 2.0))


@pytest.mark.slow
def test_four_scales_learn_without_true_flow() -> None:
    """One batch over and over: it is explained better than by no flow, with which it begins. A
    few pixels of flow leave much of a crop of 16, so there is not much to gain."""
    config = LearningConfig(data=DATA, steps=80, warmup=20, rate=3e-4, skip=1)
    network = EVFlowNet(base=2, scales=4)
    tx = optimiser(config)
    step = jax.jit(make_step(network, config, tx))
    start = init_state(network, config, tx)
    state, history = start, []
    for _ in range(80):
        state, metrics = step(dataclasses.replace(state, step=start.step), bank())
        history.append(float(metrics["loss"]))
    assert history[-1] < 0.98 * history[0]


def recorded(intervals: int, size: tuple[int, int] = (40, 24), seed: int = 0) -> Recording:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 30_000 * intervals, 3000))
    events = Events(rng.integers(0, size[0], 3000), rng.integers(0, size[1], 3000), t,
                    rng.integers(0, 2, 3000), size)
    frames = rng.integers(20, 200, (intervals + 1, size[1], size[0])).astype(np.uint8)
    return Recording(events, frames, 30_000 * np.arange(intervals + 1))


def test_recordings_give_sequences_of_their_own_events() -> None:
    recording = recorded(11)
    found = recorded_bank([recording], DATA)
    assert found.tensors.shape == (2, 4, 24, 40, 5)  # the third run is one interval short
    inside = recording.events.slice(30_000 * 4, 30_000 * 5)
    sign = np.where(inside.p, 1.0, -1.0)
    counts = np.zeros((24, 40))
    np.add.at(counts, (inside.y, inside.x), sign)
    np.testing.assert_allclose(found.tensors[1, 0].sum(-1), counts, atol=1e-5)
    np.testing.assert_allclose(found.borders[1], recording.frames[4:9] / 255, rtol=1e-6)
    s = jax.jit(sample_recorded, static_argnames="config")(jax.random.key(0), found, DATA)
    assert s.tensors.shape == (4, 4, 16, 16, 5)
    crops = {np.asarray(found.borders[n, 1, y:y + 16, x:x + 16]).tobytes()
             for n in range(2) for y in range(9) for x in range(25)}
    assert all(np.asarray(frame).tobytes() in crops for frame in s.frames[0])
    np.testing.assert_array_equal(s.before[1:], s.frames[:-1])
    assert recorded_bank([recording], DATA, most_bytes=1).borders.shape[0] == 1


def test_recordings_that_cannot_train_are_refused() -> None:
    with pytest.raises(EvflowDataError, match=r"EV015.*\(40, 24\)"):
        recorded_bank([recorded(8), recorded(8, (32, 24))], DATA)
    with pytest.raises(EvflowDataError, match=r"EV015.*crops of 16"):
        recorded_bank([recorded(8, (40, 12))], DATA)
    with pytest.raises(EvflowDataError, match="EV017"):
        recorded_bank([recorded(3)], DATA)


def test_warp_is_bilinear() -> None:
    image = jnp.arange(12.0).reshape(1, 3, 4)
    back = jnp.stack([jnp.full((3, 4), 0.5), jnp.full((3, 4), 1.0)])[None]
    moved = np.asarray(losses.warp(image, back))[0]
    np.testing.assert_allclose(moved[0, :3], [4.5, 5.5, 6.5])
    np.testing.assert_allclose(moved[2], 0)


@pytest.mark.parametrize("network", [
    SMALL, pytest.param(EVFlowNet(base=4), marks=pytest.mark.slow)], ids=["E2VID", "EV-FlowNet"])
def test_steps_learn_a_batch_and_repeat_themselves(network) -> None:
    config = LearningConfig(data=DATA, steps=40, warmup=2, rate=1e-2, skip=1)
    tx = optimiser(config)
    step = jax.jit(make_step(network, config, tx))
    state = start = init_state(network, config, tx)
    history = []
    for _ in range(40):
        state, metrics = step(dataclasses.replace(state, step=start.step), bank())
        history.append(float(metrics["loss"]))
    assert history[-1] < 0.8 * history[0]
    first, _ = step(start, bank())
    second, metrics = step(first, bank())
    assert int(second.step) == 2
    assert float(metrics["loss"]) != history[1]  # the next step draws other sequences
    again, _ = step(first, bank())
    jax.tree.map(np.testing.assert_array_equal, again.params, second.params)


@pytest.mark.parametrize("make", [
    lambda: SequenceConfig(windows=1), lambda: SequenceConfig(pause=2.0),
    lambda: SequenceConfig(window_s=0.0), lambda: LearningConfig(rate=-1.0),
    lambda: LearningConfig(rate=np.nan), lambda: LearningConfig(clip=np.inf),
    lambda: LearningConfig(data=DATA, skip=3), lambda: LearningConfig(seed=2**32),
    lambda: GanConfig(seed=99_999_999_999),
    lambda: make_step(EVFlowNet(base=2, scales=4), LearningConfig(SequenceConfig(crop=24)),
                      optimiser(LearningConfig())),
    lambda: make_step(E2VID(bins=4), LearningConfig(), optimiser(LearningConfig()))])
def test_impossible_options_are_refused(make) -> None:
    with pytest.raises(EvflowDataError, match="EV020"):
        make()

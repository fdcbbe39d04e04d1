"""The noise of a static scene, with frames and without; a refusal of a moving one without."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers.networks import hidden

from evflow import Events, Recording, check, estimate_camera, read_recording
from evflow.errors import EvflowDataError
from evflow.estimation.static import estimate_noise
from evflow.notes import Note
from evflow.recordings.gaps import event_gaps
from evflow.recordings.stillness import clustered, coincidence_excess, stands_still

SIZE = (64, 48)
SECONDS = 20.0


def static(
    on_hz: float = 0.3, off_hz: float = 0.2, hot: int = 4, spread: float = 0.2, seed: int = 0
) -> tuple[Recording, np.ndarray, np.ndarray]:
    """Poisson noise of a sensor, its true rates (2, H, W), and hot (H, W): pixels at 20 Hz."""
    rng = np.random.default_rng(seed)
    shape = (2, SIZE[1], SIZE[0])
    rates = np.array([on_hz, off_hz])[:, None, None] * np.exp(spread * rng.normal(size=shape))
    is_hot = np.zeros(shape[1:], bool)
    is_hot.ravel()[rng.choice(is_hot.size, hot, replace=False)] = True
    rates[:, is_hot] = 20.0
    counts = rng.poisson(rates * SECONDS)
    where = np.repeat(np.arange(counts.size), counts.ravel())
    t = rng.integers(0, round(SECONDS * 1e6), len(where))
    order = np.argsort(t, kind="stable")
    off, y, x = np.unravel_index(where[order], shape)
    return Recording.of_events(Events(x, y, t[order], off == 0, SIZE)), rates, is_hot


def test_rates_of_a_static_scene_are_found() -> None:
    recording, rates, hot = static()
    found = estimate_camera(recording)
    assert (found.hot == hot).all()
    for i, name in enumerate(("eta_on", "eta_off")):
        truth = rates[i][~hot].mean()
        assert float(getattr(found.summary, name)) == pytest.approx(truth, rel=0.03)
        estimate, error = (np.asarray(getattr(c, name)) for c in (found.camera, found.std))
        away = (estimate - rates[i]) / error
        assert 0.8 < np.sqrt(np.mean(away[~hot] ** 2)) < 1.2  # the std is the error's
        assert estimate[hot] == pytest.approx(20.0, rel=0.25)
        # pooled with all others, a pixel is nearer to its truth than by its own count
        alone = recording.events.count_map()[i] / SECONDS
        own = np.abs(alone - rates[i])[~hot].mean()
        assert np.abs(estimate - rates[i])[~hot].mean() < 0.95 * own


def test_one_frame_is_enough() -> None:
    recording = static()[0]
    frame = np.full((1, SIZE[1], SIZE[0]), 90, np.uint8)
    one = dataclasses.replace(recording, frames=frame, frame_times=np.array([5_000_000]))
    assert not check(one).errors
    moving = dataclasses.replace(one, events=dataclasses.replace(
        one.events, x=np.sort(one.events.x), y=np.sort(one.events.y)))
    error = check(moving).errors[0]
    assert error.code == "EV011"
    assert "one frame;" in error.seen
    assert "--protocol static" in error.fix


def test_the_time_between_bursts_is_no_gap() -> None:
    """As of steps of light: most events come in bursts, between which a small sensor is slow."""
    rng = np.random.default_rng(0)
    bursts = np.concatenate([rng.uniform(s, s + 20_000, 2000) for s in np.arange(24) * 300_000])
    rest = rng.uniform(0, 24 * 300_000, 24 * 60)
    t = np.sort(np.concatenate([bursts, rest]).astype(np.int64))
    assert not len(event_gaps(t))
    assert len(event_gaps(np.concatenate([t, t + t[-1] + 3_000_000]))) == 1


def test_thresholds_are_said_to_be_undetermined() -> None:
    found = estimate_camera(static()[0])
    assert not found.valid.any()
    assert found.windows == 0
    for name in ("theta_on", "theta_off"):
        assert float(getattr(found.summary_std, name)) > 0.1
        assert (np.asarray(getattr(found.std, name)) > 0.1).all()
    assert found.undetermined == ("theta_on", "theta_off")
    assert [note.code for note in found.notes] == ["frames.none", "pixels.hot"]
    assert "4 hot pixels" in found.notes[1].text
    assert len(found.as_dict()["hot_pixels"]) == 4


def seen(events: Events, drift: float = 0.0) -> Recording:
    """The recording with noisy frames of a texture, which brightens by `drift` log units."""
    rng = np.random.default_rng(5)
    texture = rng.uniform(40, 120, (SIZE[1], SIZE[0]))
    light = np.exp(drift * np.linspace(0, 1, 41))[:, None, None]
    frames = texture * light + rng.normal(0, 1, (41, *texture.shape))
    times = np.linspace(0, SECONDS * 1e6, 41).astype(np.int64)
    return Recording(events, np.rint(frames).astype(np.uint8), times)


def test_frames_that_stand_still_change_nothing() -> None:
    events = static()[0].events
    found = estimate_camera(seen(events))
    jax.tree.map(np.testing.assert_array_equal, found.camera, estimate_camera(static()[0]).camera)
    assert found.notes[0].code == "scene.static"
    assert found.undetermined == ("theta_on", "theta_off")
    assert not found.valid.any()
    assert check(seen(events)).errors == ()


def test_what_moves_in_frames_or_events_does_not_stand_still() -> None:
    events = static()[0].events
    assert stands_still(seen(events))
    assert stands_still(seen(events, drift=0.05))
    assert not stands_still(seen(events, drift=0.2))
    moving = hidden(14, 600)[0].events
    frames = np.full((7, moving.size[1], moving.size[0]), 90, np.uint8)
    assert len(moving) > 1000
    assert not stands_still(Recording(moving, frames, 100_000 * np.arange(7)))
    assert not stands_still(seen(events.slice(0, 400_000)))  # too short to tell


def test_a_moving_scene_is_refused() -> None:
    recording = Recording.of_events(hidden(14, 600)[0].events)
    with pytest.raises(EvflowDataError, match=r"EV011.*scene moves.*: provide frames, --frames"):
        estimate_camera(recording)
    lost = dataclasses.replace(recording, notes=(Note("frames.unused", "frames are 60x40"),))
    with pytest.raises(EvflowDataError, match=r"EV011.*no frames: frames are 60x40; .*mend what"):
        estimate_camera(lost)
    with pytest.raises(EvflowDataError, match=r"EV017.*the scene moves.*Record some seconds in "):
        estimate_noise(recording)


def test_company_is_what_independent_noise_lacks() -> None:
    for rate in (0.05, 1.0, 10.0):
        recording, _, hot = static(rate, rate, seed=1)
        assert abs(coincidence_excess(recording.events, hot)) < 0.02
    moving = hidden(14, 600)[0].events
    assert coincidence_excess(moving, np.zeros((48, 64), bool)) > 1.0


def test_many_hot_pixels_are_faults_where_they_are_scattered() -> None:
    recording, rates, hot = static(hot=120)  # of 3,072
    found = estimate_camera(recording)
    assert (found.hot == hot).all()
    assert float(found.summary.eta_on) == pytest.approx(rates[0][~hot].mean(), rel=0.03)
    with pytest.raises(EvflowDataError, match=r"EV011.*13\.0% of the pixels are far busier"):
        estimate_camera(static(hot=400)[0])


def test_a_lamp_that_flickers_is_no_fault() -> None:
    lamp = np.zeros((48, 64), bool)
    lamp[20:26, 30:36] = True
    assert clustered(lamp)
    events = static(hot=0)[0].events
    y, x = np.nonzero(lamp)
    rng = np.random.default_rng(3)
    which = rng.integers(0, len(x), 15_000)
    t = rng.integers(0, round(SECONDS * 1e6), 15_000)
    order = np.argsort(np.concatenate([events.t, t]), kind="stable")
    columns = ((events.x, x[which]), (events.y, y[which]), (events.t, t),
               (events.p, np.arange(15_000) % 2 == 0))
    both = Events(*(np.concatenate(c)[order] for c in columns), SIZE)
    with pytest.raises(EvflowDataError, match=r"EV011.*1\.2% of the pixels.*adjacent"):
        estimate_camera(Recording.of_events(both))


def test_a_short_recording_cannot_tell() -> None:
    recording = static()[0]
    part = Recording.of_events(recording.events.slice(0, 300_000))
    with pytest.raises(EvflowDataError, match=r"EV011.*only"):
        estimate_camera(part)


def test_a_real_static_scene(data_file: Callable[[str], Path]) -> None:
    """ON .232, OFF .198 Hz per pixel, counted without the noisiest .1 % of the pixels."""
    path = data_file("data/recordings/noise_static_dvxplorer640/events.npz")
    found = estimate_camera(read_recording(path))
    assert float(found.summary.eta_on) == pytest.approx(0.232, rel=0.05)
    assert float(found.summary.eta_off) == pytest.approx(0.198, rel=0.05)
    assert 100 < found.hot.sum() < 1000


@pytest.mark.parametrize("name", [
    "recordings/gen3_vga_person/events.npz", "formats/dvxplorer320.aedat4",
    "formats/davis240_aedat2.aedat", "recordings/emlb_newton_cradle/events.npz"])
def test_real_moving_scenes_are_refused(data_file: Callable[[str], Path], name: str) -> None:
    recording = read_recording(data_file(f"data/{name}"))
    with pytest.raises(EvflowDataError, match=r"EV011.*the scene moves"):
        estimate_camera(recording)


@pytest.mark.parametrize("lost_s", [2, 12])
def test_time_without_any_event_is_not_observed(lost_s: int) -> None:
    """Packets lost amid a static scene change neither its rates nor whether it is static."""
    recording, rates, hot = static(hot=0)
    t = recording.events.t
    kept = (t < 4_000_000) | (t >= 1_000_000 * (4 + lost_s))
    events = Events(*(getattr(recording.events, n)[kept] for n in ("x", "y", "t", "p")), SIZE)
    found = estimate_noise(Recording.of_events(events), lux=5.0)
    for i, name in enumerate(("eta_on", "eta_off")):
        assert float(getattr(found.summary, name)) == pytest.approx(
            rates[i][~hot].mean(), rel=0.05)
    assert [note.code for note in found.notes] == ["frames.none", "events.gaps"]
    assert f"for {lost_s} s no pixel sent an event (1 gap)" in found.notes[1].text
    assert found.bench is not None
    assert found.bench.levels[0].seconds == pytest.approx(SECONDS - lost_s, rel=1e-3)


@pytest.mark.parametrize(("burst_us", "period_us"), [(10_000, 100_000), (40_000, 500_000)])
def test_silence_between_the_bursts_of_a_flicker_is_observed(burst_us: int, period_us: int) -> None:
    rng = np.random.default_rng(0)
    width, height = SIZE
    n, bursts = width * height, 10_000_000 // period_us
    t = np.sort(np.concatenate(
        [rng.integers(k * period_us, k * period_us + burst_us, n) for k in range(bursts)]))
    events = Events(rng.integers(0, width, t.size), rng.integers(0, height, t.size), t,
                    rng.random(t.size) < 0.5, SIZE)
    with pytest.raises(EvflowDataError, match="EV017"):
        estimate_noise(Recording.of_events(events))

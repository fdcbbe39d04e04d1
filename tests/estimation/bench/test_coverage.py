"""Steps and rests whose events are missing, wholly or in part, take no part in a calibration."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.benches import bench, cameras, without

from evflow import Recording
from evflow.camera import Camera
from evflow.errors import EvflowDataError
from evflow.estimation.bench.calibration import calibrate_step
from evflow.estimation.bench.coverage import lost_steps, noise_us, watched
from evflow.estimation.bench.rests import rests_between
from evflow.types import Events

LEVELS = [40, 100, 55, 220, 40, 55, 220, 100, 40, 220, 55, 100, 40]
EDGES = 1000 * (100 + 120 * np.arange(len(LEVELS) - 1))
SHAPE = (24, 32)
RNG = np.random.default_rng(0)
CAMERA = Camera(*(np.float32(theta * (1 + 0.03 * RNG.standard_normal(SHAPE)))
                  for theta in (0.25, 0.3)), *np.ones((2, *SHAPE), np.float32))


@pytest.fixture(scope="module")
def whole() -> Recording:
    return bench(CAMERA, LEVELS)


def check(found) -> None:
    """Within 7 %; the whole recording gives .243, .297, .97, 1.0."""
    for name, tolerance in (("theta_on", 0.07), ("theta_off", 0.07), ("eta_on", 0.1),
                            ("eta_off", 0.1)):
        true = float(np.mean(getattr(CAMERA, name)))
        assert float(getattr(found.summary, name)) == pytest.approx(true, rel=tolerance)


@pytest.mark.parametrize(("begin", "end", "skipped"), [
    (0, 0, 0), (int(EDGES[1]) + 60_000, 2_000_000, 2), (0, int(EDGES[8]) - 5000, 4),
    (0, int(EDGES[11]) + 8000, 1)], ids=["whole", "later", "earlier", "amid a step"])
def test_steps_that_the_events_do_not_cover_are_left_out(
    whole: Recording, begin: int, end: int, skipped: int
) -> None:
    part = whole if not end else Recording(
        whole.events.slice(begin, end), whole.frames, whole.frame_times)
    found = calibrate_step(part, lux=(4.0, 5.5, 10.0, 22.0))
    check(found)
    assert found.windows == len(EDGES) - skipped
    text = "".join(n.text for n in found.notes if n.code == "steps.skipped")
    assert text[:len("5 of 12")] == f"{skipped} of 12" * bool(skipped)


def test_a_recording_that_ends_amid_its_last_edge(whole: Recording) -> None:
    """Without frames only the noise shows that there are no more events."""
    lux = [0.1 * v for v in LEVELS]
    cut = Recording.of_events(whole.events.slice(0, int(EDGES[-1]) + 8000))
    found = calibrate_step(cut, lux=lux, triggers_us=EDGES)
    check(found)
    assert found.windows == len(EDGES) - 1
    assert "steps.skipped" in [note.code for note in found.notes]
    few = calibrate_step(Recording.of_events(whole.events.slice(0, int(EDGES[3]) + 8000)),
                         lux=lux[:5], triggers_us=EDGES[:4])
    error = float(few.summary_std.theta_off)  # from one step of two thresholds
    assert abs(float(few.summary.theta_off) - 0.3) < 2.0 * error
    with pytest.raises(EvflowDataError, match=r"EV017.*of 1 steps of the light none lies between"):
        calibrate_step(Recording.of_events(whole.events.slice(0, int(EDGES[0]) + 8000)),
                       lux=lux[:2], triggers_us=EDGES[:1])


def test_a_late_trigger_after_the_last_event() -> None:
    """Without noise the last event is a step's own; whether it is there, --lux decides."""
    events = bench(cameras(0.03), LEVELS[:5]).events.slice(0, int(EDGES[3]) + 4000)
    for count in (4, 5):
        assert len(rests_between(EDGES[:4] + 9000, events, count)) == count
    with pytest.raises(EvflowDataError, match=r"EV020.*6 values of lux, 3 edges"):
        rests_between(EDGES[:4] + 9000, events, 6)


@pytest.mark.parametrize("step", [0, 2, 11])
def test_a_step_that_lost_its_events_is_left_out(whole: Recording, step: int) -> None:
    at = int(EDGES[step])
    found = calibrate_step(without(whole, at - 2000, at + 18_000))
    check(found)
    assert found.windows == len(EDGES) - 1
    text = next(n.text for n in found.notes if n.code == "steps.skipped")
    assert f"(number {step + 1}): they sent far fewer events" in text


@pytest.mark.usefixtures("known_levels")
def test_silence_at_rest_is_not_observed(whole: Recording) -> None:
    """Noise of a rest of which the longer half is lost, and rates as of the whole recording."""
    at = int(EDGES[5])
    found = calibrate_step(without(whole, at + 45_000, at + 100_000))
    check(found)
    assert [n.code for n in found.notes] == ["events.gaps"]


def test_silence_between_the_bursts_of_a_flicker_is_observed() -> None:
    height, width = SHAPE
    t = np.sort(np.concatenate([k * 50_000 + RNG.integers(0, 5_000, 400) for k in range(20)]))
    events = Events(RNG.integers(0, width, t.size), RNG.integers(0, height, t.size), t,
                    RNG.random(t.size) < 0.5, (width, height))
    rests = [(0, 500_000), (500_000, 1_000_000)]
    assert watched(events, rests[1], noise_us(events, rests, np.array([True]))[1]) == rests[1]


def test_lost_steps_are_those_far_below_the_others() -> None:
    changes = np.array([1.0, -1.0, 0.5, -0.5] * 3)
    sent = np.stack([np.maximum(changes, 0) / 0.2, np.maximum(-changes, 0) / 0.25], -1)
    sent[sent > 0] -= 1.0  # the way back
    sent[2] = (1.5, 0.0)
    sized = np.ones(len(changes), bool)
    assert not lost_steps(changes, sent, sized).any()
    sent[4], sent[7] = (1.5, 0.0), (0.0, 0.0)
    # the other one sends an event at most
    assert np.flatnonzero(lost_steps(changes, sent, sized)).tolist() == [4]
    assert not lost_steps(changes[:4], 0.0 * sent[:4], sized[:4]).any()


def clipped(whole: Recording, gain: float, columns: int = 32, floor: float = 0.0) -> Recording:
    """The recording with frames so bright that some levels are white, or black, in some columns."""
    frames = np.asarray(whole.frames).copy()
    frames[:, :, :columns] = np.clip(gain * frames[:, :, :columns] - floor, 0.0, 255.0)
    return Recording(whole.events, np.rint(frames).astype(np.uint8), whole.frame_times)


@pytest.mark.usefixtures("known_levels")
@pytest.mark.parametrize("columns", [32, 10])
def test_levels_that_saturated_frames_hide_are_not_used(whole: Recording, columns: int) -> None:
    """220 DN are shown as 255, not as 396: to the whole view, or to some pixels."""
    found = calibrate_step(clipped(whole, 1.8, columns))
    check(found)
    theta = np.median(np.asarray(found.camera.theta_on)[:, :columns])
    assert theta == pytest.approx(0.25, rel=0.07)
    assert [n.code for n in found.notes] == ["levels.clipped", "steps.small"] * (columns == 32)
    assert found.bench is not None
    assert len(found.bench.steps) == (6 if columns == 32 else 12)


def test_the_light_of_saturated_levels_may_be_given(whole: Recording) -> None:
    check(calibrate_step(clipped(whole, 1.8), lux=(4.0, 5.5, 10.0, 22.0)))
    assert not calibrate_step(clipped(bench(CAMERA, [40, 220, 40]), 1.8)).valid.any()
    with pytest.raises(EvflowDataError, match=r"EV017.*saturated or black at 1 of 2 rests.*--lux"):
        calibrate_step(clipped(bench(CAMERA, [40, 220]), 1.8))

"""Which simulator foretells a camera: its table, and that each finds its own recordings."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from helpers.networks import hidden

from evflow import Camera, Recording, SensorModel, estimate_camera, simulate
from evflow.camera.sensors import Voltmeter
from evflow.report.simulators import (
    CLOSE,
    Film,
    Tried,
    as_dicts,
    distance,
    likeness,
    simulators_panel,
    verdict,
    which_simulator,
)
from evflow.types import Events

SAME: dict[str, float | None] = {
    "counts_r": 0.8, "counts_ceiling": 0.8, "space_time_r": 1.0, "space_time_ceiling": 1.0,
    "intervals": 0.0, "events_on": 1.0, "events_off": 1.0}


def tried(name: str, away: float) -> Tried:
    return Tried(name, {"k1": 5.0, "k3": 0.0}, ("k3",), SAME, away)


def test_what_is_the_same_is_no_distance_away_and_nothing_is_far() -> None:
    assert distance(SAME) == 0
    for name, value in (("counts_r", 0.5), ("counts_ceiling", 1.0), ("intervals", 0.3),
                        ("events_on", 2.0), ("events_on", 0.5), ("space_time_r", None)):
        assert distance({**SAME, name: value}) > 0.04
    events = Events(np.array([1, 2]), np.array([1, 1]), np.array([5, 9]), np.array([1, 0], bool),
                    (4, 3))
    film = Film(np.zeros((2, 3, 4), np.float32), np.array([0, 20]), events, (0, 20),
                np.zeros((3, 4), bool))
    nothing = likeness(film, events.slice(0, 0), events)
    assert distance(nothing) > 1
    alike = likeness(film, events, events)
    assert alike["counts_r"] == pytest.approx(1)
    assert alike["counts_ceiling"] == pytest.approx(1)


def test_the_nearest_is_named_and_those_that_are_alike() -> None:
    assert verdict([tried("esim", 0.1), tried("v2e", 0.2)]).endswith("recorded: ESIM.")
    said = verdict([tried("v2e", 0.1), tried("esim", 0.11), tried("voltmeter", 0.3)])
    assert "v2e and ESIM" in said
    rows = [tried("voltmeter", 0.1), tried("measured", 0.3)]
    panel = simulators_panel(rows, "")
    assert "k3 unknown" in panel.body
    assert panel.body.index("DVS-Voltmeter") < panel.body.index("as measured")
    assert as_dicts(rows)[0]["undetermined"] == ["k3"]
    assert "no second half" in simulators_panel((), "there is no second half.").body
    assert "no second half" in verdict((), "there is no second half.")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "others"), [
    ("v2e", ("esim", "voltmeter")), ("esim", ("voltmeter",)), ("voltmeter", ("esim", "v2e"))])
def test_recordings_of_a_simulator_choose_it(kind: str, others: tuple[str, ...]) -> None:
    """v2e: uneven pixels behind a low-pass, shot noise, which the others lack; DVS-Voltmeter: an
    even pixel that diffuses; ESIM's is v2e's without all that, and has two thresholds."""
    recording, camera = hidden(15, 440)
    frames = recording.frames.astype(np.float32)
    even = Camera.constant(frames.shape[1:], 0.25, 0.4, eta_on=0.0, eta_off=0.0)
    models = {"v2e": SensorModel(cutoff_hz=40.0, shot_hz=2.0, noise_resets_memory=True),
              "esim": SensorModel(kind="esim"),
              "voltmeter": SensorModel(kind="voltmeter", voltmeter=Voltmeter(
                  5.0, 42.0, 0.0, 1e-7, 0.0, 1.5e-3))}
    if kind == "esim":
        frames = np.rint(frames * (90.0 / 255.0))
    if kind == "voltmeter":
        even = dataclasses.replace(even, theta_on=0.8 * even.theta_on,
                                   theta_off=0.5 * even.theta_off)
    film = Film.of(Recording(recording.events, frames.astype(np.uint8), recording.frame_times),
                   (0, len(frames) - 1), len(frames), np.zeros(frames.shape[1:], bool))
    uneven = dataclasses.replace(camera, eta_on=0.0 * camera.eta_on, eta_off=0.0 * camera.eta_off)
    events = simulate(jax.random.key(3), film.frames, film.times_us,
                      uneven if kind == "v2e" else even, model=models[kind])
    made = Recording(events, frames.astype(np.uint8), recording.frame_times)
    half = Recording(events.slice(int(made.frame_times[0]), int(made.frame_times[5])),
                     made.frames[:6], made.frame_times[:6])
    found = which_simulator(made, estimate_camera(half), (0, 5), (5, 10))
    away = {one.name: one.distance for one in found}
    assert away[kind] < found[0].distance + CLOSE
    assert min(away[name] for name in others) > away[kind] + CLOSE

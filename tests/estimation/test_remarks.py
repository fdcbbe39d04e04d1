"""What is told of the light that the frames do not show, and of the pixels' logarithm."""

from __future__ import annotations

import numpy as np
import pytest

from evflow.camera import Summary
from evflow.camera.optics import Optics
from evflow.camera.sensors import LogMap
from evflow.estimation.refine import Found
from evflow.estimation.refine.frame_exposure import UNSEEN, Exposure, Late
from evflow.estimation.refine.frame_timing import UNTIMED, Timing
from evflow.estimation.refine.receptor_result import OtherMap
from evflow.estimation.remarks import receptor_notes, timing_notes
from evflow.recordings.rolling import Rolling, Side
from evflow.simulator.photoreceptor import Photoreceptor

SUMMARY = Summary(*(np.float32(v) for v in (0.2, 0.25, 0.1, 0.1, 0.03, 0.03)))
STD = Summary(*(np.float32(v) for v in (0.01, 0.0125, 0.03, 0.04, 0.005, 0.006)))  # 5 % of theta


def told(
    offset_dn: float, std_dn: float, due: float, log_map: LogMap = "linlog",
    other: OtherMap | None = None, loss: float = 0.0,
) -> dict[str, str]:
    """The notes, by code, where what is open of the offset changes theta by the share `due`, and a
    loss of contrast by `loss`."""
    seen = Photoreceptor(offset_dn, log_map=log_map)
    found = Found(
        seen, np.full(2, 0.3), np.full(2, 0.3), np.diag([std_dn**2, 1e-8, 1e-8]), np.full(2, due),
        (0.9, 0.9), 0.1, 0.0, 400.0, np.zeros((2, 3)), np.zeros((2, 2)), other, np.full(2, due),
        np.full(2, loss))
    optics = Optics(offset_dn, 0.0, std_dn, 1e-4)
    return {note.code: note.text
            for note in receptor_notes(found, optics, SUMMARY, STD, sought=True)}


@pytest.mark.parametrize(("offset_dn", "std_dn", "due", "code"), [
    (0.0, 24.0, 0.15, "frames.offset"), (0.0, 2.0, 0.02, ""), (20.0, 5.0, 0.15, "frames.light")])
def test_light_is_told_where_it_is_seen_or_may_matter(
    offset_dn: float, std_dn: float, due: float, code: str
) -> None:
    notes = told(offset_dn, std_dn, due)
    assert {name for name in notes if name.startswith("frames.")} == ({code} if code else set())
    if code == "frames.offset":
        assert "0 ± 24 DN" in notes[code]
        assert "15%" in notes[code]


def test_a_logarithm_in_dark_light_is_told() -> None:
    assert "pixels.log" in told(0.0, 1.0, 0.01, "log_eps")
    assert "pixels.log" not in told(0.0, 1.0, 0.01)


@pytest.mark.parametrize(("chance", "told_so"), [(0.4, True), (1e-4, False)])
def test_a_logarithm_that_the_light_leaves_open_is_told(chance: float, told_so: bool) -> None:
    notes = told(0.0, 1.0, 0.01, other=OtherMap(chance, np.array([0.5, 0.45])))
    assert ("pixels.map" in notes) == told_so
    if told_so:
        assert "lin-log, as v2e's, and may be logarithmic" in notes["pixels.map"]
        assert "probability 40%" in notes["pixels.map"]
        assert "-50 % (ON) and -55 % (OFF)" in notes["pixels.map"]
        swapped = told(0.0, 1.0, 0.01, "log_eps", OtherMap(chance, np.array([2.0, 2.0])))
        assert "logarithmic, as ESIM's, and may be lin-log" in swapped["pixels.map"]


def test_contrast_that_may_be_lost_is_told() -> None:
    assert "include 12%" in told(0.0, 1.0, 0.01, loss=0.12)["pixels.losing"]
    assert "pixels.losing" not in told(0.0, 1.0, 0.01, loss=0.002)


@pytest.mark.parametrize(("delay_s", "way"), [(4e-3, "after"), (-4e-3, "before"), (2e-3, "")])
def test_frame_times_that_disagree_with_the_events_are_told(delay_s: float, way: str) -> None:
    notes = timing_notes(UNTIMED, Optics(0.0, delay_s, 1.0, 1e-4))
    assert [note.code for note in notes] == ["frames.delay"] * bool(way)
    if way:
        assert f"4.0 ms or more {way} frames" in notes[0].text


@pytest.mark.parametrize("exposed_s", [0.0, 0.018])
def test_what_frame_times_are_wrong_by_is_told_and_stands_first(exposed_s: float) -> None:
    """With the option that takes it out, and what else may be the cause."""
    timing = Timing(Exposure(0.02, 0.003), Late(7.8e-3, 7e-4, exposed_s), 7.8e-3)
    delay, exposure = timing_notes(timing, Optics(0.0, 4e-3, 1.0, 1e-4))
    assert "7.8 ± 0.7 ms after frames" in delay.text
    assert "--frames-offset-ms 7.8, or auto" in delay.text
    assert ("18 ms before slow pixels" in delay.text) == bool(exposed_s)
    assert exposure.code == "frames.exposure"
    assert "20 ± 3 ms" in exposure.text
    assert timing_notes(Timing(UNSEEN), None) == []


@pytest.mark.parametrize(("first", "options"), [
    ("top", "--rolling-ms 12.3, or auto"),
    ("right", "--rolling-ms 12.3 --rolling-from right, or auto")])
def test_a_rolling_shutter_is_told(first: Side, options: str) -> None:
    timing = UNTIMED._replace(rolling=Rolling(0.0123, first))
    note, = timing_notes(timing, Optics(0.0, -4e-3, 1.0, 1e-4))
    assert note.code == "frames.rolling"
    assert f"frames were read from the {first}" in note.text
    assert options in note.text


@pytest.mark.parametrize("sought", [True, False])
def test_a_photoreceptor_that_was_looked_for_in_vain_is_told(sought: bool) -> None:
    notes = receptor_notes(None, None, SUMMARY, STD, sought=sought)
    assert [note.code for note in notes] == ["pixels.open"] * sought

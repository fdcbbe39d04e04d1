"""Long recordings of photographs: what is kept is of these photographs and this rate."""

from __future__ import annotations

from pathlib import Path

import pytest

from evflow.errors import EvflowDataError
from experiments.shared import panned_photographs
from experiments.shared.panned_photographs import Pan, recorded


def test_a_kept_recording_is_that_of_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panned_photographs, "write", lambda path, *_: path.touch())
    pans = [Pan(tmp_path / name / "photos", (8, 6), 1.0, 25, 0.03, 1) for name in "AB"]
    one, other, again = (recorded(pan, tmp_path)[0] for pan in (*pans, pans[0]))
    assert one == again != other


@pytest.mark.parametrize("rate", [30, 2000])
def test_frames_are_whole_milliseconds_apart(rate: int, tmp_path: Path) -> None:
    with pytest.raises(EvflowDataError, match=rf"EV020.*--frames-hz {rate}"):
        recorded(Pan(tmp_path, (8, 6), 1.0, rate, 0.03, 1), tmp_path)

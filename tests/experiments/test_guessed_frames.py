"""Figures of `guessed_frames` are those of cameras whose truth is known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments import guessed_frames


def test_a_real_recording_is_none_of_the_hidden_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compared(_recording: object, _trained: object, truth: dict[str, float] | None
                 ) -> dict[str, dict[str, float]]:
        made = {"theta_on": 0.3, "theta_off": 0.4}
        return {"truth": truth or dict.fromkeys(made, 9.0), "seen": made, "made": made}

    hidden = SimpleNamespace(recording=None, nominal=SimpleNamespace(theta_on=0.3, theta_off=0.4))
    for name, result in (("load_network", None), ("make_bank", None), ("read_recording", None),
                         ("hidden_recording", hidden)):
        monkeypatch.setattr(guessed_frames, name, lambda *_, result=result, **__: result)
    monkeypatch.setattr(guessed_frames, "compared", compared)
    monkeypatch.setattr(guessed_frames, "table", str)
    result = guessed_frames.main(guessed_frames.Options(
        out=tmp_path, cameras=1, recordings=(Path("hidden_street.aedat4"),)))
    assert len(result["cameras"]) == 2
    assert result["rms_log_seen"] == pytest.approx(0.0, abs=1e-6)

"""Recordings of the accuracy tables: 64x64 pixels, 200 ms, 8-bit frames every 25 ms."""

from __future__ import annotations

from evflow.camera import CameraPrior
from evflow.camera.sensors import SENSORS, SensorModel
from experiments.shared.cameras import Protocol

ENOUGH = 200  # signal events of a polarity (all minus expected noise)
V2E = SensorModel(timestamps="v2e", noise_resets_memory=True)


def protocols() -> dict[str, Protocol]:
    """Rows of the table: both mismatches on a running camera; v2e's own slots and memory from
    the first frame on; noise that does not follow the threshold."""
    rows = {f"{m:.2f}": Protocol(prior=CameraPrior(mismatch=(m, m))) for m in (0.03, 0.15)}
    rows["0.03 v2e"] = Protocol(prior=CameraPrior(mismatch=(0.03, 0.03)), model=V2E, fresh=True)
    rows["0.03 free noise"] = Protocol(
        prior=CameraPrior(mismatch=(0.03, 0.03), noise="independent"), model=SensorModel())
    return rows


def other_protocols() -> dict[str, Protocol]:
    """Cameras that were never trained on: thresholds, mismatch and noise of another prior; pixels
    of another simulator (DVS-Voltmeter's, which have no rate of noise)."""
    other = CameraPrior((0.06, 0.6), (0.08, 0.08), noise="independent", eta=(0.01, 3.0))
    walk = CameraPrior((0.1, 0.4), (0.03, 0.03), noise="none")
    return {"other prior": Protocol(prior=other, model=SensorModel()),
            "Voltmeter": Protocol(prior=walk, model=SENSORS["dvs346"].model)}

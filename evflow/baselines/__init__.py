"""The compared systems: other methods for a camera's thresholds and noise, one file each.

    SYSTEMS["ecc median"].fit(recording) -> Fitted

ecc.py least squares on frame differences · jaer.py gains that learn · s2r.py event rates ·
match.py simulation of the same scene (resimulate.py) · lgan.py adversarial, per recording ·
noise_forms.py noise rates in closed form. Written from the equations of the papers that they name;
where a published rule and the strongest fair reading differ, both are implemented. The paper's own
ground truth (Section III-B) is in evflow/estimation/bench.
"""

from evflow.baselines.akf import Akf
from evflow.baselines.base import Fitted, Solution, System
from evflow.baselines.complementary import Complementary
from evflow.baselines.ecc import Ecc, EccEvents
from evflow.baselines.integration import Integration
from evflow.baselines.jaer import Jaer
from evflow.baselines.lgan import Lgan
from evflow.baselines.match import Match
from evflow.baselines.noise_forms import v2e_noise, voltmeter_noise
from evflow.baselines.reconstruction import Reconstructor
from evflow.baselines.s2r import S2r
from evflow.estimation.bench.calibration import calibrate_step

# By name, in the order of the table; an experiment is a loop over them.
SYSTEMS: dict[str, System] = {
    "ecc": Ecc(),
    "ecc offset 40": Ecc(offset_dn=40.0),
    "ecc median": Ecc("median"),
    "ecc global": Ecc("global", span=1),
    "ecc events": EccEvents(),
    "s2r": S2r(),
    "s2r same": S2r("same"),
    "s2r same, per polarity": S2r("same", per_polarity=True),
    "jaer": Jaer(),
    "jaer normalised": Jaer(passes=100, normalised=True),
    "match": Match(),
    "lgan": Lgan(),
}

# Brightness from events and frames at known thresholds: RECONSTRUCTORS[name].reconstruct(...).
RECONSTRUCTORS: dict[str, Reconstructor] = {
    "integration": Integration(),
    "complementary": Complementary(),
    "akf": Akf(),
    "akf, latest frame": Akf(reference="latest"),
}

__all__ = [
    "RECONSTRUCTORS", "SYSTEMS", "Akf", "Complementary", "Ecc", "EccEvents", "Fitted",
    "Integration", "Jaer", "Lgan", "Match", "Reconstructor", "S2r", "Solution", "System",
    "calibrate_step", "v2e_noise", "voltmeter_noise",
]

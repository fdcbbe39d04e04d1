"""What all exports share: the scalars that summarise a camera, the noise, and the export itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from evflow.camera.leak import without_leak
from evflow.camera.sensors import DeadContrast, SensorModel

Maps = Mapping[str, np.ndarray]
PACE = (128 + 20) / 275  # cutoff at 128 DN over that at 255 DN, for a low-pass that follows light
GREY = 1 - 0.75 * PACE  # shot noise of v2e at 128 DN over that at 0 DN
MAD = 1.4826  # standard deviations in a median absolute deviation of a normal distribution

LIGHT = '''# the light, 0..255, of each byte: sRGB is undone, as evflow simulate does for videos
light_of = np.arange(256) / 255
light_of = np.where(light_of <= 0.04045, light_of / 12.92, ((light_of + 0.055) / 1.055) ** 2.4)
light_of = (255 * light_of).astype(np.float32)'''
SWITCH = '''
if "--linear" in sys.argv[4:]:
    light_of = np.arange(256, dtype=np.float32)'''
SRGB = '''The script undoes the sRGB of the video, as evflow simulate does; with --linear
as the last word it takes the video's bytes as light.
'''

LOSES: Mapping[str, str] = {  # programs whose pixels drop events; by SensorModel.dead_contrast
    "keeps": '''- Contrast that changes within the dead time is lost; the pixels of v2e and
  of this camera keep it for later. At 1 ms that took a sixth to a fifth of one video's events.
''',
    "drops": '''- Events that fall into the dead time are dropped, as by this camera's pixels.
''',
    "resets": '''- Events that fall into the dead time are dropped. This camera's pixels begin anew
  at its end, and send fewer where light changes fast.
'''}
ANEW: Mapping[str, str] = {  # programs whose pixels begin anew at the end of the dead time
    **LOSES,
    "drops": '''- Pixels begin anew at the end of the dead time. This camera's drop the events that
  fall into it but keep the rest of the contrast, and send more where light changes fast.
''',
    "resets": '''- Pixels begin anew at the end of the dead time, as this camera's.
'''}
KEEPS = '''- Contrast that changes within the dead time is kept for later; this camera's pixels lose
  it. Where light changes fast, there are more events (1.1 to 1.5 times, with 2 and 5 ms).
'''

# of an image read from the first argument
SIZE = '''    if image.shape[:2] != ({height}, {width}):
        sys.exit(f"{{sys.argv[1]}} has {{image.shape[1]}}x{{image.shape[0]}} pixels, the camera "
                 "{width}x{height}: scale or crop the video first.")'''

NOISE = '''"""Adds the measured noise to simulated events: Poisson, per pixel and polarity."""

import numpy as np


def add_noise(x, y, t_us, p, maps, start, stop, seed=0):
    """Columns (N,) of a simulation without noise -> columns sorted by time; p is 0 or 1.

    maps: eta_on, eta_off (H, W) in Hz. start, stop: of the video, in us: noise occurs throughout,
    not only between the first and the last event. A noise event does not reset the pixel's memory.
    """
    rng, columns = np.random.default_rng(seed), [[x], [y], [t_us], [p]]
    for polarity, name in ((1, "eta_on"), (0, "eta_off")):
        count = rng.poisson(maps[name] * (stop - start) * 1e-6)
        rows, cols = np.nonzero(count)
        n = count[rows, cols]
        new = (np.repeat(cols, n), np.repeat(rows, n), rng.integers(start, stop, n.sum()),
               np.full(n.sum(), polarity))
        for column, values in zip(columns, new):
            column.append(values)
    x, y, t_us, p = (np.concatenate(column) for column in columns)
    order = np.argsort(t_us, kind="stable")
    return x[order], y[order], t_us[order], p[order]
'''


@dataclasses.dataclass(frozen=True)
class Settings:
    """The scalars that summarise a camera's maps: medians over the pixels, or an estimate's
    summary, whose rates are means; thresholds in natural-log units, rates in Hz per pixel and
    polarity; sigma: standard deviation of a threshold over pixels. Of the circuit, 0 where not
    measured: cutoff_hz (at 255 DN, if it depends on light), dead_s, leak_hz and shot_hz (v2e's, in
    the dark), both part of eta. even_hz: the measured cutoff if it does not depend on light;
    cutoff_hz is then chosen to be right at 128 DN."""

    width: int
    height: int
    theta_on: float
    theta_off: float
    sigma_on: float
    sigma_off: float
    eta_on: float
    eta_off: float
    cutoff_hz: float = 0.0
    even_hz: float = 0.0
    dead_s: float = 0.0
    leak_hz: float = 0.0
    shot_hz: float = 0.0
    log_eps: bool = False
    dead_contrast: DeadContrast = "keeps"

    @staticmethod
    def of(
        maps: Maps, std: Maps | None = None, sensor: SensorModel = SensorModel(),
        summary: Mapping[str, float] | None = None,
    ) -> Settings:
        """From maps (H, W), their standard deviations and the circuit. Medians and spreads are
        robust to hot and dead pixels; a spread combines that of the estimates with their own
        errors, in which the error that all pixels share cannot be told apart without a summary.
        summary: an estimate's summary, which is used instead of medians of the maps."""
        middle = {name: float(np.median(values)) for name, values in maps.items()}
        sigma = {}
        for name in ("theta_on", "theta_off"):
            spread = MAD * float(np.median(np.abs(maps[name] - middle[name])))
            within = float(np.median(std[name])) if std else 0.0
            sigma[name.replace("theta", "sigma")] = float(np.hypot(spread, within))
        height, width = maps["theta_on"].shape
        cutoff = {"cutoff_hz": sensor.cutoff_hz}
        if not sensor.cutoff_by_light:
            cutoff = {"cutoff_hz": sensor.cutoff_hz / PACE, "even_hz": sensor.cutoff_hz}
        values = {**middle, **sigma, **cutoff, **(summary or {})}
        return Settings(width, height, **values, dead_s=sensor.refractory_s,
                        leak_hz=sensor.leak_hz, shot_hz=sensor.shot_hz,
                        log_eps=sensor.log_map == "log_eps", dead_contrast=sensor.in_dead_time)

    @property
    def leak_seen(self) -> float:
        """ON noise that is leak, in Hz."""
        on, off = np.float64(self.eta_on), np.float64(self.eta_off)
        return float(on - without_leak(on, off, self.leak_hz)) if self.leak_hz else 0.0

    @property
    def circuit(self) -> str:
        """The measured circuit in words."""
        cutoff = f"cutoff {self.cutoff_hz:.0f} Hz at 255 DN" if self.cutoff_hz else "no cutoff"
        if self.even_hz:
            cutoff = f"cutoff {self.even_hz:.0f} Hz at any light, equal to {cutoff} at mid-grey"
        dead = f"dead time {1e3 * self.dead_s:.2f} ms" if self.dead_s else "no dead time"
        leak = f", leak {self.leak_hz:.3f} Hz (part of the ON noise)" if self.leak_hz else ""
        return f"{cutoff}, {dead}{leak}"

    @property
    def begun_anew(self) -> str:
        """What a program says of the dead time whose pixels begin anew at its end."""
        return ANEW[self.dead_contrast]

    @property
    def dropped(self) -> str:
        """An entry on the dead time for a program whose pixels drop the events in it."""
        return LOSES[self.dead_contrast]

    @property
    def kept(self) -> str:
        """The same for a program whose pixels keep the contrast; "" if the camera's do."""
        return "" if self.dead_contrast == "keeps" else KEEPS

    @property
    def light_lost(self) -> str:
        """An entry on measured shot noise for a program whose noise is the same in any light; ""
        if none was measured."""
        if not self.shot_hz:
            return ""
        return (f"- The camera has shot noise: {self.shot_hz:.3f} Hz in the dark (ON and OFF "
                "together), a quarter\n  of it in the brightest pixels. Here noise has one rate in "
                "any light: its dependence on light is\n  lost.\n")

    @property
    def refers_to(self) -> str:
        """The log map that the thresholds refer to, in words."""
        return ("the camera's thresholds refer to log(I / 255 + .001)" if self.log_eps else
                "the camera's thresholds refer to v2e's map,\n  linear below 20 DN")

    @property
    def same_size(self) -> str:
        """Lines of a script that refuse an image of another size."""
        return SIZE.format(width=self.width, height=self.height)

    @property
    def sigma(self) -> float:
        """One standard deviation for both polarities: the root of the mean variance."""
        return float(np.hypot(self.sigma_on, self.sigma_off) / np.sqrt(2))


@dataclasses.dataclass(frozen=True)
class Export:
    """text: how to use it and what is lost. scripts: name -> Python source. arrays: name.npy ->
    array, written beside the maps."""

    text: str
    scripts: Mapping[str, str]
    arrays: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

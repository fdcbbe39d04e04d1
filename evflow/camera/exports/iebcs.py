"""IEBCS (ICNS): thresholds by resetting its maps before each frame, noise as its spectra.

A spectrum file is (H, W, 72): per pixel the cumulative share of intervals up to each of the
instantaneous frequencies 1..9 x 10^k Hz, k = -3..4; the last entry is 0, as in the measured files.
IEBCS draws the interval of the entry below, so an entry here holds the share up to the geometric
mean with the next frequency: the simulated rate is then the camera's. (Read as if it were measured,
such a file gives a rate 15 % higher.)
"""

from __future__ import annotations

import numpy as np

from evflow.camera.exports.common import LIGHT, SRGB, SWITCH, Export, Maps, Settings

USUAL_DEAD_US = 100  # in IEBCS's examples
FREQUENCIES = np.concatenate([np.arange(1, 10) * 10.0**k for k in range(-3, 5)])

SCRIPT = '''"""A video through IEBCS with the measured thresholds and noise; run in its root folder.

    python run_iebcs.py VIDEO FPS EVENTS.dat [--linear]
"""

import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.append("./src")
from dvs_sensor import DvsSensor
from event_buffer import EventBuffer

folder = Path(__file__).parent
maps = np.load(folder / "maps.npz")
sensor = DvsSensor("measured")
sensor.set_shape({width}, {height})
sensor.set_dvs_sensor(th_pos={theta_on:.5f}, th_neg={theta_off:.5f}, th_n=0.0, lat=100, tau=40,
                      jit=10, bgnp={bgnp:.5f}, bgnn={bgnn:.5f}, ref={dead_us})
sensor.init_bgn_hist(str(folder / "noise_pos.npy"), str(folder / "noise_neg.npy"))
{light}
video, step, events, frame = cv2.VideoCapture(sys.argv[1]), 1e6 / float(sys.argv[2]), None, 0
while True:
    more, image = video.read()
    if not more:
        break
{same_size}
    light = cv2.cvtColor(light_of[image], cv2.COLOR_BGR2GRAY).astype(float) / 255.0 * 1e4
    # IEBCS draws a threshold anew, around one mean, after each event: the maps are put back
    sensor.cur_th_pos[...], sensor.cur_th_neg[...] = maps["theta_on"], -maps["theta_off"]
    if frame == 0:
        sensor.init_image(light)
        events = EventBuffer(1)
    else:
        events.increase_ev(sensor.update(light, int(step)))
    frame += 1
events.write(sys.argv[3])
'''

TEXT = '''The camera for IEBCS (https://github.com/neuromorphicsystems/IEBCS)

    python run_iebcs.py VIDEO FPS EVENTS.dat                     (in the root of IEBCS)
{srgb}
Scalars only: set_dvs_sensor(th_pos={theta_on:.4f}, th_neg={theta_off:.4f}, th_n={sigma:.4f},
    lat=100, tau=40, jit=10, bgnp={bgnp:.4f}, bgnn={bgnn:.4f}, ref={dead_us})

What IEBCS cannot represent
- Per-pixel thresholds: it redraws each after every event, around one mean (th_n is noise in time,
  not mismatch). The script restores the measured maps before every frame: a pixel's first event in
  a frame interval uses its own threshold, later ones the median. Use many frames per second.
- Noise maps: noise_pos.npy and noise_neg.npy hold the spectrum of a Poisson process at the measured
  rate of each pixel, but IEBCS assigns them to its pixels at random: the distribution of rates is
  kept, the locations are not. Rates are quantised to its bins, 1 to 9 times a power of ten; a
  silent pixel fires once in 1000 s. A noise event stores the present intensity.
{light_lost}{dead}{upright}\
- Latency, time constant and jitter (lat, tau, jit) are those of IEBCS's examples, and so is the
  dead time (ref, microseconds) if none was measured (here: {circuit}). Its latency is no low-pass.
- The log map is log(I + 1) with white at 1e4; {refers_to}.
'''
UPRIGHT = '''- Sensors that are higher than wide: it looks the noise of a pixel up at
  row * height + column, beyond the last one (IndexError). Turn video and maps by 90 degrees.
'''


def export(maps: Maps, s: Settings) -> Export:
    """Scalars, a script, and spectra of the noise."""
    slowest = float(FREQUENCIES[0])  # IEBCS divides by the rate
    rates = {"bgnp": max(s.eta_on, slowest), "bgnn": max(s.eta_off, slowest)}
    values = vars(s) | rates | {
        "light": LIGHT + SWITCH, "srgb": SRGB, "same_size": s.same_size, "sigma": s.sigma,
        "refers_to": s.refers_to, "circuit": s.circuit, "dead": s.begun_anew,
        "light_lost": s.light_lost, "upright": UPRIGHT if s.height > s.width else "",
        "dead_us": round(s.dead_s * 1e6) or USUAL_DEAD_US}
    arrays = {"noise_pos.npy": spectrum(maps["eta_on"]), "noise_neg.npy": spectrum(maps["eta_off"])}
    return Export(TEXT.format(**values), {"run_iebcs.py": SCRIPT.format(**values)}, arrays)


def spectrum(rate: np.ndarray) -> np.ndarray:
    """(H, W) Hz -> (H, W, 72) float32: P(1 / interval <= edge) = exp(-rate / edge), edges at the
    geometric means of neighbouring frequencies."""
    edges = np.sqrt(FREQUENCIES[:-1] * FREQUENCIES[1:])
    share = np.exp(-rate[..., None].astype(np.float64) / edges)
    share[..., -1] = 1.0
    return np.concatenate([share, np.zeros_like(share[..., :1])], -1).astype(np.float32)

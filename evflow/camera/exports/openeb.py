"""OpenEB (metavision_core_ml): threshold maps can be set; its noise does not work."""

from __future__ import annotations

from evflow.camera.exports.common import LIGHT, NOISE, SRGB, SWITCH, Export, Maps, Settings

LOW, HIGH = 0.01, 1.0  # where OpenEB clips thresholds

SCRIPT = '''"""A video through OpenEB with the measured thresholds and noise of every pixel.

    python run_openeb.py VIDEO FPS EVENTS.npz [--linear]     # t int64 us, x, y, p {{0, 1}}, size
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from add_noise import add_noise
from metavision_core_ml.video_to_event.simulator import EventSimulator

maps = np.load(Path(__file__).with_name("maps.npz"))
simulator = EventSimulator(
    {height}, {width}, {theta_on:.5f}, {theta_off:.5f}, {dead_us}, cutoff_hz={cutoff_hz:.1f})
simulator.Cps = np.clip(maps["theta_on"], 0.01, 1)
simulator.Cns = np.clip(maps["theta_off"], 0.01, 1)
{light}
video, step, found, frame = cv2.VideoCapture(sys.argv[1]), 1e6 / float(sys.argv[2]), [], 0
while True:
    more, image = video.read()
    if not more:
        break
{same_size}
    simulator.image_callback(cv2.cvtColor(light_of[image], cv2.COLOR_BGR2GRAY), round(frame * step))
    found.append(simulator.get_events())
    simulator.event_maker.num = 0  # flush_events would zero its buffer of 1.6 GB for each frame
    frame += 1
events = np.concatenate(found)
x, y, t, p = add_noise(*(events[n].astype(np.int64) for n in ("x", "y", "t", "p")), maps,
                       0, round(frame * step))
np.savez(sys.argv[3], t=t, x=x.astype(np.uint16), y=y.astype(np.uint16), p=p > 0,
         size=np.array([{width}, {height}]))
'''

TEXT = '''The camera for OpenEB (https://github.com/prophesee-ai/openeb, metavision_core_ml)

Every pixel (recommended):
    python run_openeb.py VIDEO FPS EVENTS.npz
{srgb}
Scalars only, its own sample, without noise (add_noise.py adds it):
    python viz_video_to_event_simulator.py VIDEO --Cp {theta_on:.4f} --Cn {theta_off:.4f} \\
        --sigma_threshold {sigma:.4f} --refractory_period {dead_us} --cutoff_hz {cutoff_hz:.1f} \\
        --leak_rate_hz 0 --shot_noise_rate_hz 0

What OpenEB cannot represent
- Its sample takes the bytes of a video as light. Of an sRGB video it sees about half the contrast,
  and sends about half the events.
- The command line has one sigma for both polarities (measured ON {sigma_on:.4f}, OFF
  {sigma_off:.4f}); thresholds are clipped to .01 .. 1{clipped}.
- Noise: its shot noise does not have the rate that it is given. OpenEB draws it once per frame, but
  divides its rate by the crossings of the busiest pixel in that frame, and one more: on one video a
  quarter was left at 1000 frames per second, a hundredth at 40; a static scene gets none. So both
  turn it off, and add_noise.py adds the measured maps, ON {eta_on:.4f} and OFF {eta_off:.4f} Hz per
  pixel; noise events do not reset the pixels' memories.
{light_lost}- Its low-pass has two poles; one pole was measured ({circuit}).
{dead}- The log map is log(I / 255 + 1e-7); {refers_to}:
  dark scenes give other counts.
'''


def export(maps: Maps, s: Settings) -> Export:
    """Maps for the script; for the sample the medians."""
    thetas = maps["theta_on"], maps["theta_off"]
    outside = sum(int(((theta < LOW) | (theta > HIGH)).sum()) for theta in thetas)
    clipped = f"; {outside:,} of the measured ones are" if outside else ""
    values = vars(s) | {
        "circuit": s.circuit, "dead": s.dropped,
        "light_lost": s.light_lost, "dead_us": round(s.dead_s * 1e6), "sigma": s.sigma,
        "clipped": clipped, "light": LIGHT + SWITCH, "srgb": SRGB,
        "same_size": s.same_size, "refers_to": s.refers_to}
    return Export(TEXT.format(**values),
                  {"run_openeb.py": SCRIPT.format(**values), "add_noise.py": NOISE})

"""v2e (SensorsINI): two attributes of its emulator take all maps; its command line takes scalars.
Log map, thresholds and memory are those of evflow's `SensorModel(kind="v2e")`.
"""

from __future__ import annotations

from evflow.camera.exports.common import GREY, LIGHT, SRGB, SWITCH, Export, Maps, Settings
from evflow.camera.leak import leak_behind

SCRIPT = '''"""A video through v2e with the measured thresholds and noise of every pixel.

    python run_v2e.py VIDEO FPS EVENTS.npy [--linear]     # rows t[s], x, y, p (-1, 1), float32
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from v2ecore.emulator import EventEmulator

GAIN = {gain:.5f}  # shot noise in the dark over the measured; at 128 DN v2e has .59636 of it

maps = {{k: torch.tensor(v) for k, v in np.load(Path(__file__).with_name("maps.npz")).items()}}
emulator = EventEmulator(
    pos_thres={theta_on:.5f}, neg_thres={theta_off:.5f}, sigma_thres=0.01,
    cutoff_hz={cutoff_hz:.1f}, leak_rate_hz={leak_hz:.5f}, refractory_period_s={dead_s:.6f},
    shot_noise_rate_hz=2 * GAIN, device="cpu")
{light}
video, step, found, frame = cv2.VideoCapture(sys.argv[1]), 1 / float(sys.argv[2]), [], 0
while True:
    more, image = video.read()
    if not more:
        break
{same_size}
    grey = cv2.cvtColor(light_of[image], cv2.COLOR_BGR2GRAY)
    events = emulator.generate_events(grey, frame * step)
    if frame == 0:  # v2e draws its thresholds at the first frame: here they are replaced
        emulator.pos_thres, emulator.neg_thres = maps["theta_on"], maps["theta_off"]
        # v2e's probability of a noise event is (R / 2) dt f(I) times these; the median pixel's
        # leak is left out, as v2e adds leak itself
        emulator.pos_thres_pre_prob = (maps["eta_on"] - {leak_seen:.5f}).clip(min=0)
        emulator.neg_thres_pre_prob = maps["eta_off"]
    if events is not None:
        found.append(events)
    frame += 1
np.save(sys.argv[3], np.concatenate(found) if found else np.zeros((0, 4), np.float32))
'''

TEXT = '''The camera for v2e (https://github.com/SensorsINI/v2e)

Every pixel (recommended): thresholds and noise rates of maps.npz in v2e's emulator
    python run_v2e.py VIDEO FPS EVENTS.npy
{srgb}
Scalars only, from v2e's command line:
    {command}

What v2e cannot represent
- The command line takes the bytes of a video as light. Of an sRGB video it sees about half the
  contrast, and sends about half the events.
- The command line draws its own thresholds: one sigma for both polarities ({sigma:.4f} here;
  measured ON {sigma_on:.4f}, OFF {sigma_off:.4f}), normal and uncorrelated. Which pixel has which
  is lost.
- --shot_noise_rate_hz is the total of ON and OFF in the dark, half of each, and falls to a quarter
  in the brightest pixels. Here {right}.
- Noise is one rate on the command line, times nominal over actual threshold. In the script every
  pixel has its own rate: at 128 DN, {share} of maps.npz{apart}.
  v2e sends at most one noise event per pixel, polarity and frame: a hot pixel with
  more needs more frames per second.
- A noise event stores the present intensity in the pixel's memory.
- Its circuit is the measured one ({circuit}), if the frames come at several times the cutoff: its
  low-pass is exact for short steps only, and its dead time delays events by whole frames.
{log}{kept}- All events of a pixel between two frames share v2e's time slots; times are float32
  seconds.
'''

LOG = """- Its logarithm is linear below 20 DN, with up to three times the contrast; the measured
  one is logarithmic there too.
"""


def export(maps: Maps, s: Settings) -> Export:
    """Scalars for the command line, a script for the maps."""
    separate, on = bool(s.leak_hz or s.shot_hz), s.eta_on
    if separate:
        leak, on = s.leak_hz, s.eta_on - s.leak_seen
        shot = s.shot_hz or (on + s.eta_off) / GREY
    else:
        more = max(s.eta_on - s.eta_off, 0.0)
        both = 2 * s.eta_off if more else s.eta_on + s.eta_off
        leak, shot = leak_behind(more, both), both / GREY
    gain = s.shot_hz / max(on + s.eta_off, 1e-12) if s.shot_hz else 1 / GREY
    command = (
        f"v2e -i VIDEO -o OUT --output_width {s.width} --output_height {s.height} "
        f"--pos_thres {s.theta_on:.4f} --neg_thres {s.theta_off:.4f} --sigma_thres {s.sigma:.4f} "
        f"--cutoff_hz {s.cutoff_hz:.1f} --leak_rate_hz {leak:.4f} --shot_noise_rate_hz {shot:.4f} "
        f"--refractory_period {s.dead_s:.6f} --dvs_h5 events.h5")
    measured, half = f"ON {on:.4f} and OFF {s.eta_off:.4f} Hz", shot * GREY / 2
    if s.shot_hz:
        right = (f"it is as measured, {half:.4f} Hz of each at 128 DN;\n  in the recording's own "
                 f"light, noise without leak was {measured}")
    elif separate:
        right = (f"its sum is right at 128 DN, {half:.4f} Hz of each;\n  measured noise without "
                 f"leak was {measured}")
    elif leak:
        right = (f"it is right at 128 DN for the OFF noise (measured {s.eta_off:.4f}\n  Hz); what "
                 f"ON has more of it ({more:.4f} Hz) is leak, a regular drift"
                 + (". --leak_rate_hz\n  is higher than that difference, as every shot noise event "
                    "takes the drift back" if both else ""))
    else:
        right = f"it is right at 128 DN for the mean of both (measured\n  {measured})"
    values = vars(s) | {
        "circuit": s.circuit, "sigma": s.sigma, "command": command, "right": right,
        "share": f"{gain * GREY:.3f} times that" if s.shot_hz else "that",
        "apart": f", ON without {s.leak_seen:.4f} Hz of leak" if s.leak_hz else "",
        "srgb": SRGB, "log": LOG if s.log_eps else "", "kept": s.kept}
    source = SCRIPT.format(**vars(s) | {
        "gain": gain, "leak_seen": s.leak_seen, "light": LIGHT + SWITCH,
        "same_size": s.same_size})
    return Export(TEXT.format(**values), {"run_v2e.py": source})

"""ESIM (rpg_vid2e, esim_py and esim_torch): two scalar thresholds, no noise, no map."""

from __future__ import annotations

from evflow.camera.exports.common import LIGHT, NOISE, Export, Maps, Settings

SCRIPT = '''"""Images through esim_py with the nearest scalars, and the measured noise added.

    python run_esim.py IMAGES TIMESTAMPS.txt EVENTS.npz     # t int64 us, x, y, p {{0, 1}}, size
"""

import sys
from pathlib import Path

import cv2
import esim_py
import numpy as np
from add_noise import add_noise

for path in sorted(Path(sys.argv[1]).iterdir())[:1]:
    image = cv2.imread(str(path))
{same_size}
maps = np.load(Path(__file__).with_name("maps.npz"))
simulator = esim_py.EventSimulator({theta_on:.5f}, {theta_off:.5f}, {dead_s:.6f}, 1e-3, True)
x, y, t, p = simulator.generateFromFolder(sys.argv[1], sys.argv[2]).reshape(-1, 4).T
start, *_, stop = np.rint(np.loadtxt(sys.argv[2], ndmin=1) * 1e6).astype(np.int64)
x, y, t, p = add_noise(x.astype(int), y.astype(int), np.rint(t * 1e6).astype(np.int64),
                       (p > 0).astype(int), maps, start, stop)
np.savez(sys.argv[3], t=t, x=x.astype(np.uint16), y=y.astype(np.uint16), p=p > 0,
         size=np.array([{width}, {height}]))
'''

LINEAR = f'''"""Images in sRGB -> grey images that are linear in light, as PNG.

    python linear_images.py IMAGES OUT

They are numbered in the order of the numbers in their names: ESIM sorts names letter by letter, 10
before 2.
"""

import re
import sys
from pathlib import Path

import cv2
import numpy as np

{LIGHT}
out, number = Path(sys.argv[2]), 0
out.mkdir(parents=True)


def natural(path):
    return [int(part) if part.isdigit() else part for part in re.split("([0-9]+)", path.name)]


for path in sorted(Path(sys.argv[1]).iterdir(), key=natural):
    image = cv2.imread(str(path))
    if image is not None:
        grey = np.rint(cv2.cvtColor(light_of[image], cv2.COLOR_BGR2GRAY)).astype(np.uint8)
        cv2.imwrite(str(out / f"{{number:08d}}.png"), grey)
        number += 1
'''

TEXT = '''The camera for ESIM (https://github.com/uzh-rpg/rpg_vid2e)

Videos and most images are in sRGB, which ESIM takes as light: first undo it.
    python linear_images.py IMAGES LINEAR_IMAGES
esim_py, noise added:
    python run_esim.py LINEAR_IMAGES TIMESTAMPS.txt EVENTS.npz
esim_torch, without noise: it reads a folder that holds imgs/ and timestamps.txt (seconds, a line
for each image) and nothing else, and passes over all others without a word.
    python linear_images.py IMAGES FOLDER/imgs
    cp TIMESTAMPS.txt FOLDER/timestamps.txt
    python esim_torch/scripts/generate_events.py -i FOLDER -o OUT \\
        -cp {theta_on:.4f} -cn {theta_off:.4f} -rp {dead_ns}
It writes a .npz for each image, with t in nanoseconds (later versions: events.h5, microseconds).

ESIM reads a folder in the order of the letters of its names, 10.png before 2.png, and meets the
times in that order. linear_images.py numbers the images so that both orders are one.

What ESIM cannot represent
- The response of the images: evflow simulate undoes the sRGB of a video, ESIM reads its bytes as
  light. Of sRGB images it sees about half the contrast, and sends about half the events. Linear
  images of 8 bits, which is all it reads, have coarse steps in the dark.
- Thresholds per pixel: it has one number per polarity, here the medians. The measured spread, ON
  {sigma_on:.4f} and OFF {sigma_off:.4f}, is lost. (rpg_esim's contrast_threshold_sigma is no
  substitute: it draws anew for every pixel and frame.)
- Noise: it has none. add_noise.py adds the measured rates, ON {eta_on:.4f} and OFF {eta_off:.4f} Hz
  per pixel, to its output; noise events do not reset the pixels' memories.
{light_lost}- The photoreceptor's low-pass (measured: {circuit}): it has none.
{dead}{log}'''


LOG = '''- The log map: ESIM uses log(I / 255 + eps), {refers_to}.
  Dark scenes give other counts: 22 % fewer on one video, with eps = 1e-3.
'''
SAME_LOG = '''- The log map: esim_torch's script adds 1e-5 of white before the log, not 1e-3 as
  the camera and run_esim.py: it sends more events in the dark.
'''


def export(maps: Maps, s: Settings) -> Export:
    """The medians, and a script that adds the noise."""
    values = vars(s) | {"circuit": s.circuit, "dead": s.dropped, "light_lost": s.light_lost,
                        "dead_ns": round(s.dead_s * 1e9),
                        "same_size": s.same_size,
                        "log": SAME_LOG if s.log_eps else LOG.format(refers_to=s.refers_to)}
    return Export(TEXT.format(**values),
                  {"run_esim.py": SCRIPT.format(**values), "add_noise.py": NOISE,
                   "linear_images.py": LINEAR})

"""The camera as values: per-pixel maps, what all pixels share, the prior, and known sensors.

    prior.py     Summary (what a whole camera shares), and the distribution it is drawn from
    camera.py    Camera: theta and eta per pixel
    file.py      its maps as an .npz
    sensors.py   SensorModel, the pixel circuit, and sensors by name
    leak.py      the part of its noise that is leak
    arguments.py keys, shapes and numbers at the border
    optics.py    what is measured beside the maps: summary, circuit, how frames relate to light
    perturb.py   hot and dead pixels, measured noise
    exports/     a camera as settings of other simulators
"""

from evflow.camera.camera import THETA_MIN, Camera, sample_pixels
from evflow.camera.file import PARAMETERS
from evflow.camera.prior import CameraPrior, Summary, noise_of_threshold, sample_nominal

__all__ = [
    "PARAMETERS", "THETA_MIN", "Camera", "CameraPrior", "Summary", "noise_of_threshold",
    "sample_nominal", "sample_pixels",
]

"""The public names: what type checkers and editors see, and what `import evflow` loads lazily."""

from .camera import Camera as Camera
from .camera import CameraPrior as CameraPrior
from .camera import Summary as Summary
from .camera.perturb import (
    read_noise_histogram as read_noise_histogram,
)
from .camera.perturb import (
    with_faults as with_faults,
)
from .camera.perturb import (
    with_noise_histogram as with_noise_histogram,
)
from .camera.sensors import SENSORS as SENSORS
from .camera.sensors import SensorModel as SensorModel
from .errors import EvflowDataError as EvflowDataError
from .estimation.pipeline import estimate_camera as estimate_camera
from .estimation.result import CameraEstimate as CameraEstimate
from .io import (
    open_writer as open_writer,
)
from .io import (
    read_events as read_events,
)
from .io import (
    read_recording as read_recording,
)
from .io import (
    write_events as write_events,
)
from .io import (
    write_recording as write_recording,
)
from .light.log_maps import delta_log_intensity as delta_log_intensity
from .metrics.streams import compare as compare
from .network.api import (
    Code as Code,
)
from .network.api import (
    Stats as Stats,
)
from .network.api import (
    code_from_video as code_from_video,
)
from .network.api import (
    encode as encode,
)
from .network.api import (
    estimate as estimate,
)
from .network.api import (
    estimate_with_std as estimate_with_std,
)
from .network.api import (
    finish as finish,
)
from .network.api import (
    forward as forward,
)
from .network.api import (
    generate as generate,
)
from .network.api import (
    inverse as inverse,
)
from .network.api import (
    log_prob as log_prob,
)
from .network.api import (
    squash as squash,
)
from .network.api import (
    summarize as summarize,
)
from .network.api import (
    unsquash as unsquash,
)
from .network.weights import load_weights as load_weights
from .network.weights import save_weights as save_weights
from .recordings.adjust import linearised as linearised
from .recordings.check import Finding as Finding
from .recordings.check import Report as Report
from .recordings.check import check as check
from .recordings.windows import iter_windows as iter_windows
from .report.camera import write_report as write_report
from .simulator import (
    simulate as simulate,
)
from .simulator import (
    simulate_counts as simulate_counts,
)
from .simulator import (
    simulate_stream as simulate_stream,
)
from .simulator import (
    simulate_voxels as simulate_voxels,
)
from .types import Events as Events
from .types import Recording as Recording
from .types import Window as Window
from .voxel import voxelize as voxelize

__version__: str

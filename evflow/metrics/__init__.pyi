from .flow import (
    FwlConvention as FwlConvention,
)
from .flow import (
    aee as aee,
)
from .flow import (
    endpoint_error as endpoint_error,
)
from .flow import (
    fwl as fwl,
)
from .flow import (
    rsat as rsat,
)
from .flow import (
    warped_image as warped_image,
)
from .flow_scores import score_flow as score_flow
from .image import (
    log_map as log_map,
)
from .image import (
    mae_intensity_change as mae_intensity_change,
)
from .image import (
    mse as mse,
)
from .image import (
    psnr as psnr,
)
from .image import (
    rmse as rmse,
)
from .image import (
    ssim as ssim,
)
from .image_scores import (
    PROTOCOLS as PROTOCOLS,
)
from .image_scores import (
    ImageProtocol as ImageProtocol,
)
from .image_scores import (
    frame_scores as frame_scores,
)
from .image_scores import (
    score_images as score_images,
)
from .perceptual import load_lpips as load_lpips
from .perceptual import lpips as lpips

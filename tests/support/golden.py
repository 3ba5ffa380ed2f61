"""The golden images: what gsplat itself rendered, beside the Gaussians it was given."""

from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera, Gaussians


def load_golden(path: Path) -> tuple[Gaussians, Camera, Array]:
    """Gaussians, camera and (H, W, 4) image on black; the camera is the one the image was made with."""
    data = load_file(path)
    gaussians = Gaussians(data["means"], data["scales"], data["quats"], data["opacities"], data["coeffs"])
    height, width, _ = data["out_img"].shape
    matrix = np.eye(4)
    matrix[:3, 3] = (-0.123, -0.456, 8.0)
    camera = Camera(width, height, width / 2, width / 2, width / 2, height / 2, matrix)
    return gaussians, camera, data["out_img"]

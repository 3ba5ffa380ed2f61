"""View-dependent colour: real spherical harmonics up to degree 3, as 3D Gaussian Splatting uses them."""

import numpy as np

from langsplat_core.arrays import Array, unit

C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def basis(directions: Array, count: int) -> Array:
    """(N, 3) unit directions from the camera to the Gaussians -> (N, count) basis values."""
    x, y, z = np.moveaxis(directions, -1, 0)
    values = [np.full_like(x, C0)]
    if count > 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if count > 4:
        values += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * z * z - x * x - y * y),
            -C2[0] * x * z,
            C2[2] * (x * x - y * y),
        ]
    if count > 9:
        values += [
            -C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -C3[2] * x * (4 * z * z - x * x - y * y),
            C3[4] * z * (x * x - y * y),
            -C3[0] * x * (x * x - 3 * y * y),
        ]
    return np.stack(values, -1)


def colours(sh: Array, means: Array, camera_position: Array) -> Array:
    """(N, K, 3) coefficients seen from `camera_position` -> (N, 3) float64 display colours >= 0.

    Not clamped above: values over 1 are legal until the picture is quantised. Invalid rows give 0.
    """
    if sh.shape[1] == 1:
        directions = np.broadcast_to(np.array([0.0, 0.0, 1.0]), means.shape)
    else:
        with np.errstate(invalid="ignore"):
            directions = unit(means.astype(np.float64) - camera_position, 1e-12)
    rgb = np.einsum("nk,nkc->nc", basis(directions, sh.shape[1]), sh.astype(np.float64)) + 0.5
    return np.where(np.isfinite(rgb), np.maximum(rgb, 0), 0)

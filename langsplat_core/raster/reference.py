"""Float64 reference rasterizer, written to be read; every other backend is tested against it.

Image formation, from top to bottom (constants in `config.RasterSettings`):

1. Camera space: p = R x + t; Gaussians with p.z <= near or p.z > far are not drawn.
2. Footprint: the perspective map is linearised at p, with p.x/p.z and p.y/p.z clamped to 1.3 times the half
   field of view on each side of the principal point (of an orthographic camera, whose map is linear, J is
   diag(fx, fy) without a third column). With A = J R rotation diag(scales) (2x3) the 2D covariance is
   A A^T + 0.3 I, positive definite by construction.
3. alpha(u) = min(0.99, opacity * exp(-1/2 (u-m)^T cov^-1 (u-m))) at pixel centres u; alphas below 1/255 are
   skipped, so a Gaussian's extent is the ellipse where alpha equals 1/255.
4. Front to back by camera z, ties by index: weight = alpha * T, T <- T (1 - alpha); a pixel stops before the
   Gaussian that would bring T to 1e-4 or below. The cap of 0.99 is the float32 next to it, as in every
   kernel: two capped layers then leave T just below 1e-4, where the double nearest 0.99 leaves it just above.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array, check_array, rotation_matrices, sigmoid, unit
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster.protocol import LiftingView, dilation, far_plane, tangent_limits
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.scene.transform import sh_basis


def colours(sh: Array, means: Array, camera_position: Array) -> Array:
    """Return (N, 3) float64 display colours >= 0 of (N, K, 3) coefficients seen from `camera_position`.

    Not clamped above: values over 1 are legal until the image is quantised. Invalid rows give 0.
    """
    if sh.shape[1] == 1:
        directions = np.broadcast_to(np.array([0.0, 0.0, 1.0]), means.shape)
    else:
        with np.errstate(invalid="ignore"):
            directions = unit(means.astype(np.float64) - camera_position, 1e-12)
    rgb = np.einsum("nk,nkc->nc", sh_basis(directions, sh.shape[1]), sh.astype(np.float64)) + 0.5
    return np.where(np.isfinite(rgb), np.maximum(rgb, 0), 0)


@dataclass(frozen=True, eq=False)
class Footprints:
    """Projected Gaussians, N rows; rows that are not drawn have opacity 0."""

    means_px: Array  # (N, 2) pixels
    depths: Array  # (N,) camera z
    conics: Array  # (N, 3) entries xx, xy, yy of the inverse 2D covariance, 1/px^2
    extents_px: Array  # (N, 2) half width and half height of the alpha = alpha_min contour
    opacities: Array  # (N,) in [0, 1]


def project(gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> Footprints:
    """Do steps 1 and 2 of the module's list, for all Gaussians at once."""
    valid = gaussians.valid()
    means = np.where(valid[:, None], gaussians.means, 0).astype(np.float64)
    # Not a matrix product: BLAS may round equal rows differently, and equal depths tie by index.
    points = (means[:, None, :] * camera.rotation).sum(2) + camera.world_to_camera[:3, 3]
    drawn = valid & (points[:, 2] > settings.near) & (points[:, 2] <= far_plane(settings))
    x, y, z = np.where(drawn[:, None], points, (0.0, 0.0, 1.0)).T

    # Clamp where the Jacobian is taken, not where the mean goes (EWA splatting's linearisation
    # explodes far outside the field of view).
    left, top, right, bottom = tangent_limits(camera, settings)
    tx = np.clip(x / z, -left, right) * z
    ty = np.clip(y / z, -top, bottom) * z
    zero, over, bent = np.zeros_like(z), z, 1.0
    if camera.orthographic:
        over, bent = np.ones_like(z), 0.0
    jacobian = np.stack(
        [
            np.stack([camera.fx / over, zero, -bent * camera.fx * tx / z**2], -1),
            np.stack([zero, camera.fy / over, -bent * camera.fy * ty / z**2], -1),
        ],
        -2,
    )
    scales = np.exp(np.where(drawn[:, None], gaussians.log_scales, 0).astype(np.float64))
    quats = np.where(drawn[:, None], gaussians.quats_wxyz, (1.0, 0.0, 0.0, 0.0)).astype(np.float64)
    a = jacobian @ camera.rotation @ (rotation_matrices(quats) * scales[:, None, :])

    # det(A A^T) = |row0 x row1|^2 (Cauchy-Binet): no cancellation, however thin the needle.
    xx = (a[:, 0] ** 2).sum(1)
    yy = (a[:, 1] ** 2).sum(1)
    xy = (a[:, 0] * a[:, 1]).sum(1)
    det_sharp = (np.cross(a[:, 0], a[:, 1]) ** 2).sum(1)
    added, fitted = dilation(camera, settings)
    det_fitted = det_sharp + fitted * (xx + yy) + fitted**2
    det = det_sharp + added * (xx + yy) + added**2
    xx, yy = xx + added, yy + added

    opacities = sigmoid(np.where(drawn, gaussians.opacity_logits, -np.inf).astype(np.float64))
    if fitted < added:
        opacities = opacities * np.sqrt(np.maximum(det_fitted / det, 0.005**2))
    opacities = np.where(drawn & (opacities >= settings.alpha_min), opacities, 0)
    reach = np.sqrt(2 * np.log(np.maximum(opacities / settings.alpha_min, 1)))  # in standard deviations
    return Footprints(
        means_px=np.stack([camera.fx * x / over + camera.cx, camera.fy * y / over + camera.cy], -1),
        depths=z,
        conics=np.stack([yy / det, -xy / det, xx / det], -1),
        extents_px=np.stack([reach * np.sqrt(xx), reach * np.sqrt(yy)], -1),
        opacities=opacities,
    )


@dataclass(frozen=True, eq=False)
class Step:
    """One Gaussian's part in an image, at the pixels of a window."""

    index: int
    window: tuple[slice, slice]  # rows and columns of the image that it may touch
    running: Array  # False where the pixel has stopped before
    alpha: Array  # capped, but not cut off
    before: Array  # transmittance before the Gaussian
    weights: Array  # alpha T, 0 where the Gaussian is not added
    after: Array  # transmittance behind the Gaussian


def alphas_in(f: Footprints, index: int, window: tuple[slice, slice], settings: RasterSettings) -> Array:
    """Return alpha of one Gaussian at the pixels of a window (rows, columns), capped but not cut off."""
    rows, columns = window
    dx = np.arange(columns.start, columns.stop) + 0.5 - f.means_px[index, 0]
    dy = (np.arange(rows.start, rows.stop) + 0.5 - f.means_px[index, 1])[:, None]
    xx, xy, yy = f.conics[index]
    alpha = f.opacities[index] * np.exp(-0.5 * (xx * dx**2 + 2 * xy * dx * dy + yy * dy**2))
    return np.minimum(np.float64(np.float32(settings.alpha_max)), alpha)


def rim(f: Footprints, settings: RasterSettings, relative: float) -> Array:
    """Return (N, 2) half extents of the contour alpha = alpha_min (1 - relative), px, rounded up."""
    squared = 2 * np.log(np.maximum(f.opacities / settings.alpha_min, 1 + 1e-9))
    return f.extents_px * np.sqrt(1 + 2.1 * relative / squared)[:, None] + 1e-3


class ReferenceView(LiftingView):
    """Blending weights of one view, recomputed Gaussian by Gaussian in every call."""

    def __init__(self, footprints: Footprints, camera: Camera, settings: RasterSettings) -> None:
        self.camera, self.settings, self.footprints = camera, settings, footprints
        self.count, self.depths = len(footprints.depths), footprints.depths
        self.order = np.argsort(footprints.depths, kind="stable")

    def steps(self, wider: float = 0.0) -> Iterator[Step]:
        """Yield every Gaussian that is drawn, front to back: steps 3 and 4 of the module's list.

        Windows only save time: outside of them alpha is below alpha_min (1 - wider).
        """
        f, s = self.footprints, self.settings
        size = (self.camera.width, self.camera.height)
        transmittance, running = np.ones(size[::-1]), np.ones(size[::-1], bool)
        reach = rim(f, s, wider)
        low = np.clip(np.ceil(f.means_px - reach - 0.5), 0, size).astype(int)
        high = np.clip(np.floor(f.means_px + reach - 0.5) + 1, 0, size).astype(int)
        for i in self.order[((f.opacities > 0) & (low < high).all(1))[self.order]]:
            window = np.s_[low[i, 1] : high[i, 1], low[i, 0] : high[i, 0]]
            alpha = alphas_in(f, i, window, s)
            before, was_running = transmittance[window].copy(), running[window].copy()
            hit = was_running & (alpha >= s.alpha_min)
            after = before * (1 - alpha)
            stops = hit & (after <= s.transmittance_min)
            hit &= ~stops
            running[window] &= ~stops
            transmittance[window] = np.where(hit, after, before)
            weights = np.where(hit, alpha * before, 0)
            yield Step(int(i), window, was_running, alpha, before, weights, transmittance[window])

    def cut_off_band(self, relative: float) -> Array:
        """Return (H, W) True where some Gaussian's alpha, or T behind it, is within `relative` of a cut-off.

        There rounding decides, and a fast rasterizer may come out on the other side.
        """
        s, band = self.settings, np.zeros((self.camera.height, self.camera.width), bool)
        for step in self.steps(relative):
            at_cut = np.abs(step.alpha / s.alpha_min - 1) < relative
            if s.transmittance_min > 0:
                after = step.before * (1 - step.alpha) / s.transmittance_min
                at_cut |= (step.alpha >= s.alpha_min) & (np.abs(after - 1) < relative)
            band[step.window] |= step.running & at_cut
        return band

    def splat(self, values: Array) -> tuple[Array, Array]:
        check_array("values", np.asarray(values), (len(self.order), "C"))
        image = np.zeros((self.camera.height, self.camera.width, values.shape[1]))
        alpha = np.zeros((self.camera.height, self.camera.width))
        for step in self.steps():
            image[step.window] += step.weights[..., None] * values[step.index]
            alpha[step.window] += step.weights
        return image, alpha

    def gather(self, image: Array) -> Array:
        check_array("image", np.asarray(image), (self.camera.height, self.camera.width, "C"))
        values = np.zeros((len(self.order), image.shape[2]))
        for step in self.steps():
            values[step.index] = np.tensordot(step.weights, image[step.window], 2)
        return values

    def median_depth(self) -> Array:
        return np.append(self.footprints.depths, 0)[self.median_rows()]

    def median_rows(self) -> Array:
        """Return (H, W) int64 Gaussian at which the transmittance falls to 0.5 or below, -1 for none."""
        rows = np.full((self.camera.height, self.camera.width), -1)
        for step in self.steps():
            passed = (step.weights > 0) & (step.after <= 0.5)
            rows[step.window][(rows[step.window] == -1) & passed] = step.index
        return rows


class ReferenceRasterizer:
    """Float64, one Gaussian at a time: slow and plain."""

    name = "reference"

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> ReferenceView:
        return ReferenceView(project(gaussians, camera, settings), camera, settings)

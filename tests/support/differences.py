"""Gradients of the float64 reference by central differences: what backward passes are compared with."""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import RasterSettings
from langsplat_core.raster.reference import Footprints, ReferenceView, project
from langsplat_core.scene import Camera, Gaussians

PARAMETERS = ("means", "log_scales", "quats_wxyz", "opacity_logits")
STEP = 1e-6  # in every parameter's own unit


@dataclass(frozen=True, eq=False)
class Exact:
    """Gaussians in float64, as the reference reads them; all rows valid."""

    means: Array
    log_scales: Array
    quats_wxyz: Array
    opacity_logits: Array

    def __len__(self) -> int:
        return len(self.means)

    def valid(self) -> Array:
        return np.ones(len(self), bool)


def reference_gradients(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    values: Array,
    image_grad: Array,
    alpha_grad: Array,
    rows: Array | None = None,
) -> dict[str, Array]:
    """Gradients of <image, image_grad> + <alpha, alpha_grad> by the parameters, values and pixel means of the
    Gaussians at `rows`, by default of all.

    Pixels at a cut-off must carry no loss: there the image jumps.
    """
    rows = np.arange(len(gaussians)) if rows is None else rows
    exact = Exact(*(getattr(gaussians, name).astype(np.float64) for name in PARAMETERS))

    def loss(footprints: Footprints) -> float:
        image, alpha = ReferenceView(footprints, camera, settings, 0).splat(values)
        return float((image * image_grad).sum() + (alpha * alpha_grad).sum())

    def moved(array: Array, place: tuple[int, ...], step: float) -> Array:
        array = array.copy()
        array[place] += step
        return array

    footprints, found = project(exact, camera, settings), {}  # type: ignore[arg-type]
    for name in PARAMETERS:
        whole = getattr(exact, name)
        grad = found[name] = np.empty((len(rows), *whole.shape[1:]))
        for place in np.ndindex(grad.shape):
            at = (int(rows[place[0]]), *place[1:])
            ends = [replace(exact, **{name: moved(whole, at, step)}) for step in (STEP, -STEP)]
            high, low = (loss(project(end, camera, settings)) for end in ends)  # type: ignore[arg-type]
            grad[place] = (high - low) / (2 * STEP)
    grad = found["means_px"] = np.empty((len(rows), 2))
    for place in np.ndindex(grad.shape):
        at = (int(rows[place[0]]), place[1])
        ends_px = [moved(footprints.means_px, at, step) for step in (STEP, -STEP)]
        high, low = (loss(replace(footprints, means_px=end)) for end in ends_px)
        grad[place] = (high - low) / (2 * STEP)
    found["values"] = ReferenceView(footprints, camera, settings, 0).gather(image_grad)[rows]  # linear
    return found

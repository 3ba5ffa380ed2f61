"""A capture: photographs with known cameras, as every loader returns them."""

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.datasets.images import Photo
from langsplat_core.scene import Camera

log = logging.getLogger("langsplat")

DECIMALS = 9  # of world units: what a digest tells apart, far above rounding and far below a pixel


def tell_of_lost_points(good: Array, source: str) -> None:
    """A warning where most of the points of `source` had to be left out; `good`: (M,) bool, those that were
    not."""
    if 2 * good.sum() < len(good):
        log.warning(
            "%d of the %d points of %s are damaged or badly located and are left out; was it written whole?",
            len(good) - good.sum(),
            len(good),
            source,
        )


@dataclass(frozen=True, eq=False)
class Capture:
    """Undistorted photographs, in name order, with pinhole cameras of the same size."""

    cameras: tuple[Camera, ...]  # camera.name is the photograph's file stem
    images: tuple[Array, ...]  # (H, W, 3) uint8 each, display (sRGB) values
    points: Array  # (M, 3) float64 structure-from-motion points; M may be 0
    colours: Array  # (M, 3) uint8
    metres_per_unit: float | None = None  # > 0, how long a unit of its world is; None: unknown
    photos: tuple[Photo, ...] = ()  # the files, in the same order; none for pictures made otherwise
    drawn: bool = False  # by `lab.world`, where encoders are calibrated, see `scene.Reading.elsewhere`

    def __post_init__(self) -> None:
        if len(self.cameras) != len(self.images):
            raise ValueError(f"{len(self.cameras)} cameras for {len(self.images)} photographs")
        for camera, image in zip(self.cameras, self.images, strict=True):
            check_array(f"photograph {camera.name}", image, (camera.height, camera.width, 3), dtype=np.uint8)
        dims = check_array("points", self.points, ("M", 3))
        check_array("colours", self.colours, ("M", 3), dims)
        if self.photos and len(self.photos) != len(self.images):
            raise ValueError(f"{len(self.photos)} files for {len(self.images)} photographs")

    def __len__(self) -> int:
        return len(self.cameras)

    def split(self, test_every: int) -> tuple[list[int], list[int]]:
        """Indices of (training, held-out) views; every `test_every`-th is held out, 0 holds out none.

        Never leaves fewer than one training view.
        """
        test = [i for i in range(len(self)) if test_every > 1 and i % test_every == 0 and len(self) > 1]
        return [i for i in range(len(self)) if i not in test], test

    def digest(self, indices: Sequence[int]) -> str:
        """Of all that a training on the photographs at `indices` sees: these in their order, their cameras,
        and the points. Structure from motion run again may place the same photographs in another world, so
        names alone do not identify a capture. Poses and points count to `DECIMALS`, so that a work folder is
        taken up on another processor too, whose products of matrices differ in their last digits."""
        digest = hashlib.blake2b(digest_size=16)
        for camera, image in ((self.cameras[i], self.images[i]) for i in indices):
            digest.update(repr((camera.name, camera.intrinsics)).encode())
            digest.update(_rounded(camera.world_to_camera).tobytes())
            digest.update(np.ascontiguousarray(image).data)
        digest.update(_rounded(self.points).tobytes())
        digest.update(self.colours.tobytes())
        return digest.hexdigest()

    def extent(self) -> float:
        """1.1 times the largest distance of a camera from the cameras' mean: the scene scale that the
        INRIA code multiplies position learning rates with. World units, > 0."""
        centres = np.array([camera.position for camera in self.cameras])
        return max(1.1 * float(np.linalg.norm(centres - centres.mean(0), axis=1).max()), 1e-6)


def _rounded(values: Array) -> Array:
    """To `DECIMALS`, float64, without a negative zero."""
    rounded: Array = np.round(values.astype(np.float64), DECIMALS) + 0.0
    return rounded

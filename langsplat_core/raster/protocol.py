"""Pictures that this machine's memory cannot hold are refused before anything is allocated for them."""

import math
import os
from functools import cache
from pathlib import Path
from typing import Protocol, runtime_checkable

from scipy import sparse

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import InputError
from langsplat_core.scene import Camera, Gaussians

# Of a picture of colours with alpha while it is drawn and turned into display values, float32 and uint8.
BYTES_PER_PIXEL = 40
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def check_picture(camera: Camera) -> None:
    """InputError where a picture of the camera's size needs more than all of this machine's memory."""
    needed = camera.width * camera.height * BYTES_PER_PIXEL
    if needed > memory_bytes():
        raise InputError(
            f"a picture of {camera.width}x{camera.height} pixels needs {needed / 1e9:.0f} GB of memory, and "
            f"this machine has {memory_bytes() / 1e9:.0f}; choose a smaller size"
        )


@cache
def memory_bytes() -> float:
    """What a process here may use at most: the machine's memory, or its container's share; infinite where the
    system does not say."""
    found = [float("inf")]
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        found.append(float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    for limit in _LIMITS:
        try:
            found.append(float(limit.read_text()))
        except (OSError, ValueError):  # not there, or "max"
            continue
    return min(found)


# What every rasterizer is: a linear operator per view, and nothing more.
#
# With geometry frozen, a rendered image is ``F = W x``: `x` holds one vector per Gaussian and `W` the
# blending weights alpha_i T_i of the view. A backend projects a view once and then offers `splat`
# (``W x``) and, where it can lift, `gather` (``W^T y``, the exact adjoint).


def farthest(settings: RasterSettings) -> float:
    """The largest camera z at which Gaussians are drawn, world units."""
    return math.inf if settings.far is None else settings.far


class View(Protocol):
    """N Gaussians as one camera of H x W pixels sees them."""

    @property
    def dropped(self) -> int:
        """How many rows were invalid (see `Gaussians.valid`) and therefore not drawn."""

    def splat(self, values: Array) -> tuple[Array, Array]:
        """(N, C) values -> (H, W, C) image ``W x`` without background, and (H, W) alpha = row sums of W."""

    def depth(self) -> Array:
        """(H, W) alpha-weighted mean depth along camera z, world units; 0 where nothing is drawn."""


@runtime_checkable
class MedianDepth(Protocol):
    """A view that also knows where half of the light is stopped."""

    def median_depth(self) -> Array:
        """(H, W) camera z, world units, of the Gaussian at which the transmittance falls to 0.5 or below; 0
        where it never does."""


class LiftingView(View, Protocol):
    """A view whose backend also has the adjoint."""

    def gather(self, image: Array) -> Array:
        """(H, W, C) image -> (N, C) values ``W^T y``."""

    def contributions(self) -> Array:
        """(N,) blending weight of each Gaussian summed over the picture, in pixels: ``W^T 1``."""


@runtime_checkable
class LabelView(Protocol):
    """A view that lifts label maps in one walk, however many labels there are."""

    def gather_labels(self, maps: Array, count: int, least: float = 0.0) -> sparse.csr_matrix:
        """(L, H, W) int32 labels below `count`, -1 for none -> (N, count) float32 ``W^T onehot``, in pixels.

        A pixel counts once for every label that it has in any map. Entries of at most `least` are left out.
        """


@runtime_checkable
class FreezableView(Protocol):
    """A lifting view that can keep W itself."""

    def frozen(self) -> "FrozenView":
        """The same view with W kept in fewer digits: `splat` and `gather` get cheaper, from some calls on."""


class FrozenView(LiftingView, Protocol):
    """A view whose W is kept."""

    @property
    def nbytes(self) -> int:
        """Memory of what is kept."""


class Rasterizer(Protocol):
    """A backend; stateless apart from device resources."""

    name: str

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> View:
        """Project `gaussians` into `camera` once, for any number of `splat` calls."""


class LiftingRasterizer(Rasterizer, Protocol):
    """A backend whose views can gather."""

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> LiftingView:
        """As in `Rasterizer`."""

"""The float64 reference on three small windows of a picture: an error for scenes of any size.

The reference draws Gaussians one by one, so a whole picture of a million of them takes minutes. A window's
pixels depend only on the Gaussians that reach into it; projected by the whole picture's camera (as the
Jacobian's clamp depends on the picture's size) and shifted, they give exactly the pixels of the whole.

Pixels where rounding may decide a cut-off (an alpha of just 1/255, a transmittance of just 1e-4) are the
*band*: there one flip outweighs every other error, so flips are counted and the error is stated without them.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster.reference import Footprints, ReferenceView, project, rim
from langsplat_core.scene import Camera, Gaussians

WINDOW = 64  # pixels a side
_PLACES = ((0.5, 0.5), (0.3, 0.42), (0.64, 0.7))  # centres of the windows, as fractions of the picture
_BAND = 1e-3  # relative distance to a cut-off; float32 footprints of a GPU are within about 3e-4 of it
_FLIP = 2e-5  # an error in the band is a flip if larger than this and than twice all others


@dataclass(frozen=True)
class Error:
    """Differences from the reference."""

    largest: float  # over all pixels compared
    off_cuts: float  # over those where no cut-off is near
    flips: int  # pixels near a cut-off that came out on its other side


@dataclass(frozen=True, eq=False)
class Window:
    """Part of a picture and its exact blending weights."""

    at: tuple[slice, slice]  # rows and columns of the picture
    weights: scipy.sparse.csr_array  # (pixels, K) alpha_i T_i, K = len(Truth.rows)
    band: Array  # (h, w) bool


@dataclass(frozen=True, eq=False)
class Truth:
    """What the reference says of one view of N Gaussians."""

    footprints: Footprints  # of all N
    rows: Array  # (K,) ascending: the Gaussians that reach into a window
    windows: tuple[Window, ...]

    def splat(self, values: Array) -> list[Array]:
        """(N, C) -> each window's (h, w, C) image, float64."""
        x = values[self.rows].astype(np.float64)
        return [(w.weights @ x).reshape(*w.band.shape, -1) for w in self.windows]

    def splat_error(self, image: Array, values: Array) -> Error:
        """Of the (H, W, C) `image` that a backend made from `values`."""
        errors = [
            np.abs(image[window.at] - want).max(-1, initial=0)
            for window, want in zip(self.windows, self.splat(values), strict=True)
        ]
        off = max(float(e[~w.band].max(initial=0)) for e, w in zip(errors, self.windows, strict=True))
        flips = sum(
            int((e[w.band] > max(_FLIP, 2 * off)).sum()) for e, w in zip(errors, self.windows, strict=True)
        )
        return Error(max(float(e.max()) for e in errors), off, flips)

    def masked(self, image: Array) -> Array:
        """`image` with 0 outside the windows and in their bands: what a backend must gather or pull back
        to be compared, as a window knows nothing of the pixels outside."""
        kept = np.zeros_like(image)
        for window in self.windows:
            kept[window.at] = image[window.at] * ~window.band[..., None]
        return kept

    def gather(self, masked: Array) -> Array:
        """(H, W, C) image from `masked` -> (K, C) values of the Gaussians `rows`, float64; others get 0."""
        # Windows may overlap: every pixel counts once.
        left = masked.astype(np.float64)
        total = np.zeros((len(self.rows), masked.shape[2]))
        for window in self.windows:
            total += window.weights.T @ left[window.at].reshape(-1, masked.shape[2])
            left[window.at] = 0
        return total

    def gather_error(self, values: Array, masked: Array) -> Error:
        """Of the (N, C) `values` that a backend gathered from `masked`; off the cut-offs alone."""
        want = np.zeros(values.shape)
        want[self.rows] = self.gather(masked)
        off = float(np.abs(values - want).max(initial=0))
        return Error(off, off, 0)


def make_truth(gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> Truth:
    """Draw the windows with the reference; about 0.1 ms for each Gaussian that reaches into one."""
    footprints = project(gaussians, camera, settings)
    places = [_place(camera, fraction) for fraction in _PLACES]
    reaching = [np.flatnonzero(_reaches(footprints, settings, at)) for at in places]
    rows = np.unique(np.concatenate(reaching))
    windows = []
    for at, mine in zip(places, reaching, strict=True):
        columns = (len(rows), np.searchsorted(rows, mine))
        windows.append(_window(_take(footprints, mine), camera, settings, at, columns))
    return Truth(footprints, rows, tuple(windows))


def _reaches(footprints: Footprints, settings: RasterSettings, at: tuple[slice, slice]) -> Array:
    """(N,) bool: drawn, and not wholly outside the window."""
    rows, columns = at
    reach = rim(footprints, settings, _BAND)
    low, high = footprints.means_px - reach, footprints.means_px + reach
    inside = (high > (columns.start, rows.start)) & (low < (columns.stop, rows.stop))
    return inside.all(1) & (footprints.opacities > 0)


def _take(f: Footprints, rows: Array) -> Footprints:
    return Footprints(f.means_px[rows], f.depths[rows], f.conics[rows], f.extents_px[rows], f.opacities[rows])


def _place(camera: Camera, fraction: tuple[float, float]) -> tuple[slice, slice]:
    slices = []
    for size, part in ((camera.height, fraction[1]), (camera.width, fraction[0])):
        start = min(max(round(size * part) - WINDOW // 2, 0), max(size - WINDOW, 0))
        slices.append(slice(start, min(start + WINDOW, size)))
    return slices[0], slices[1]


def _window(
    footprints: Footprints,
    camera: Camera,
    settings: RasterSettings,
    at: tuple[slice, slice],
    place: tuple[int, Array],
) -> Window:
    """`place`: how many columns the matrix has, and the column of each footprint."""
    count, where_to = place
    rows, columns = at
    height, width = rows.stop - rows.start, columns.stop - columns.start
    moved = replace(footprints, means_px=footprints.means_px - (columns.start, rows.start))
    view = ReferenceView(moved, replace(camera, width=width, height=height), settings, dropped=0)
    pixels = np.arange(height * width).reshape(height, width)
    indices, where, weights = [np.empty(0, int)], [np.empty(0, int)], [np.empty(0)]
    for step in view.steps():
        hit = step.weights > 0
        where.append(pixels[step.window][hit])
        weights.append(step.weights[hit])
        indices.append(np.full(len(where[-1]), where_to[step.index]))
    entries = (np.concatenate(weights), (np.concatenate(where), np.concatenate(indices)))
    matrix = scipy.sparse.csr_array(entries, shape=(height * width, count))
    return Window(at, matrix, view.cut_off_band(_BAND))

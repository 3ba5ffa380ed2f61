"""Selections: (N,) bool arrays over Gaussians, by place, along the surface, and drawn on an image.

Growing and shrinking walk along the surface and never jump to a thing behind or above. Gaussians too faint to
be on it go where the one goes that they are nearest to (`Surface.anchors`); those near none never change.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import InputError
from langsplat_core.query.answers import Regions
from langsplat_core.scene import Camera
from langsplat_core.scene.surface import Surface


def of_rows(rows: Array, count: int) -> Array:
    """(K,) rows of `count` Gaussians -> (count,) bool."""
    selected = np.zeros(count, bool)
    selected[rows] = True
    return selected


def in_sphere(means: Array, centre: Array, radius: float) -> Array:
    """(N, 3) -> (N,) bool: at most `radius` from `centre` (3,), world units.

    A mean that is not finite is nowhere.
    """
    offsets = np.asarray(means, np.float64) - centre
    with np.errstate(invalid="ignore"):
        squares: Array = (offsets**2).sum(1)
        return squares <= radius**2


def in_box(means: Array, low: Array, high: Array) -> Array:
    """(N, 3) -> (N,) bool: between two corners (3,) along the world's axes, faces included."""
    return np.all((means >= np.asarray(low)) & (means <= np.asarray(high)), axis=1)


def above_plane(means: Array, normal: Array, offset: float) -> Array:
    """(N, 3) -> (N,) bool: on the side of a plane that its `normal` (3,) points to, itself included.

    offset: of its points along the normal as it is given. A mean that is not finite is nowhere.
    """
    with np.errstate(invalid="ignore"):
        above: Array = np.asarray(means, np.float64) @ np.asarray(normal, np.float64) >= offset
        return above & np.isfinite(means).all(1)


def at_point(surface: Surface, regions: Regions, level: int, point: Array) -> Array:
    """Return the (N,) bool region of what lies nearest to `point` (3,), world units.

    It is the whole region at a level (index into LEVELS), with the faint Gaussians beside it. Nothing where
    the scene has no surface.
    """
    if len(surface.rows) == 0:
        return np.zeros(len(surface.anchors), bool)
    nearest = int(((surface.positions - point) ** 2).sum(1).argmin())
    return regions.everywhere[level] == regions.everywhere[level, surface.rows[nearest]]


def in_pixel(regions: Regions, level: int, rows: Array, weights: Array) -> Array:
    """Return the (N,) bool region, at a level, that paints most of a pixel.

    rows: (M,) Gaussians in the pixel; weights: (M,) blending weights. Nothing where no region does.
    """
    of = regions.everywhere[level]
    shares = np.bincount(of[rows] + 1, weights, 1)[1:]
    return np.asarray(of == shares.argmax()) if shares.any() else np.zeros(len(of), bool)


def grow(surface: Surface, selected: Array, distance: float) -> Array:
    """Return `selected` and all that lies within `distance` of it along the surface, world units."""
    if not 0 <= distance < float("inf"):
        raise InputError(f"a distance of {distance:g} cannot be walked along the surface; give 0 or more")
    reached = selected[surface.rows]
    if not reached.any() or reached.all():
        return _with_reached(surface, selected, reached)
    lengths = dijkstra(
        _lengths(surface), directed=False, indices=np.flatnonzero(reached), limit=distance, min_only=True
    )
    return _with_reached(surface, selected, np.isfinite(lengths))


def shrink(surface: Surface, selected: Array, distance: float) -> Array:
    """Return `selected` without what lies within `distance` of the rest along the surface, world units.

    Where the surface itself ends, nothing is lost.
    """
    return ~grow(surface, ~selected, distance)


def _with_reached(surface: Surface, selected: Array, reached: Array) -> Array:
    """Return `selected` and every Gaussian at a `reached` (M,) point of the surface."""
    if len(reached) == 0:
        return selected.copy()
    return selected | (reached[surface.anchors] & (surface.anchors >= 0))


def _lengths(surface: Surface) -> csr_matrix:
    """Return the links of the surface, weighted by their lengths, world units."""
    links = surface.links
    source = np.repeat(np.arange(len(surface.rows)), np.diff(links.indptr))
    gaps = np.linalg.norm(surface.positions[source] - surface.positions[links.indices], axis=1)
    # A stored zero is no link to the sparse format's walkers: coincident points are at the least distance.
    return csr_matrix((np.maximum(gaps, 1e-12), links.indices, links.indptr), shape=links.shape)


# Selections drawn on an image: the Gaussians whose centres a camera sees inside an outline or a stroke.
#
# Places are pixels of the camera, x to the right and y down, the centre of the first pixel at (0.5, 0.5).
# What lies on or behind the camera's plane, or has no finite place, is never inside.

BEHIND = 0.03  # of the surface's depth: a centre no farther behind it is on the surface that one sees


@dataclass(frozen=True, eq=False)
class Projected:
    """The places of N centres in one image."""

    pixels: Array  # (N, 2) float64
    depths: Array  # (N,) float64 camera z, world units; -1 where there is no place

    @property
    def ahead(self) -> Array:
        """(N,) bool: before the camera."""
        return self.depths > 0


def project(means: Array, camera: Camera) -> Projected:
    """(N, 3) world points as `camera` sees them."""
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(np.asarray(means, np.float64))
        known = (depths > 0) & np.isfinite(depths) & np.isfinite(pixels).all(1)
    return Projected(np.where(known[:, None], pixels, -1.0), np.where(known, depths, -1.0))


def in_rectangle(seen: Projected, corner: Array, opposite: Array) -> Array:
    """(N,) bool: between two opposite corners (2,), pixels, borders included."""
    corners = np.stack([corner, opposite]).astype(np.float64)
    low, high = corners.min(0), corners.max(0)
    return seen.ahead & ((seen.pixels >= low) & (seen.pixels <= high)).all(1)


def in_polygon(seen: Projected, outline: Array) -> Array:
    """Return (N,) bool: inside the closed `outline` (K, 2), pixels, by the even-odd rule.

    Nothing is inside fewer than three corners. What lies exactly on an edge may count either way. A ray from
    the centre to the right crosses an odd number of edges (Shimrat 1962, Algorithm 112). Centres are sorted
    by height once, so that an edge meets only those that are level with it.
    """
    outline = np.asarray(outline, np.float64)
    check_array("outline", outline, ("K", 2))
    inside = np.zeros(len(seen.depths), bool)
    if len(outline) < 3:
        return inside
    near = np.flatnonzero(in_rectangle(seen, outline.min(0), outline.max(0)))
    near = near[np.argsort(seen.pixels[near, 1], kind="stable")]
    x, y = seen.pixels[near].T
    odd = np.zeros(len(near), bool)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        first, last = np.searchsorted(y, (min(y0, y1), max(y0, y1)))
        level = slice(first, last)
        if first < last:  # also: the edge is not level itself
            odd[level] ^= x[level] < x0 + (y[level] - y0) * ((x1 - x0) / (y1 - y0))
    inside[near] = odd
    return inside


def in_stroke(seen: Projected, path: Array, radius: float) -> Array:
    """Return (N,) bool: at most `radius` pixels from the line through `path` (K, 2), pixels, K >= 1.

    Of one place, that is a disk. Between two places of a fast mouse there is no gap.
    """
    path = np.asarray(path, np.float64)
    check_array("path", path, ("K", 2))
    inside = np.zeros(len(seen.depths), bool)
    if len(path) == 0:
        return inside
    near = np.flatnonzero(in_rectangle(seen, path.min(0) - radius, path.max(0) + radius))
    if len(near) == 0:
        return inside
    pixels = seen.pixels[near]
    tree = cKDTree(pixels)
    swept = np.zeros(len(near), bool)
    for start, end in zip(path, path[1:] if len(path) > 1 else path, strict=False):
        half = (end - start) / 2
        around = 1.001 * (radius + np.hypot(*half)) + 1e-9  # a little more: what counts is decided below
        some = np.array(tree.query_ball_point(start + half, around, return_sorted=False), np.intp)
        offsets = pixels[some] - start
        share = np.clip(offsets @ (2 * half) / max(4 * half @ half, 1e-300), 0, 1)
        swept[some] |= ((offsets - share[:, None] * (2 * half)) ** 2).sum(1) <= radius**2
    inside[near] = swept
    return inside


def on_surface(seen: Projected, depths: Array, size: tuple[int, int], behind: float = BEHIND) -> Array:
    """Return (N,) bool: in the image and not hidden there.

    The depth of the centre is at most that of the surface in its pixel and `behind` of it more. Where nothing
    is drawn, nothing hides. depths: (H, W) camera z of the surface, world units, 0 where nothing is drawn; it
    may be coarser or finer than the `size` (width, height) of the image that the centres were projected into.
    """
    check_array("depths", depths, ("H", "W"))
    height, width = depths.shape
    columns, rows = np.floor(seen.pixels * (width / size[0], height / size[1])).T
    inside = seen.ahead & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    numbers = np.flatnonzero(inside)
    there = depths[rows[numbers].astype(np.intp), columns[numbers].astype(np.intp)].astype(np.float64)
    inside[numbers] = (there <= 0) | (seen.depths[numbers] <= there * (1 + behind))
    return inside

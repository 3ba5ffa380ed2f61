"""Selections: (N,) bool arrays over Gaussians, by position, along the surface, drawn on an image or by masks.

Growing and shrinking follow links of the surface and never jump to something behind or above. Gaussians too
faint to be on the surface follow the nearest one that is (`Surface.anchors`); those near none never change.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy
from PIL import Image, ImageDraw

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import Regions
from langsplat_core.raster.render import view_of
from langsplat_core.scene import Camera, Scene
from langsplat_core.scene.surface import Surface


def of_rows(rows: Array, count: int) -> Array:
    """Return (count,) bool that is True at (K,) `rows`."""
    selected = np.zeros(count, bool)
    selected[rows] = True
    return selected


def in_sphere(means: Array, centre: Array, radius: float) -> Array:
    """Return (N,) bool: finite points at most `radius` from `centre` (3,), world units."""
    offsets = np.asarray(means, np.float64) - centre
    with np.errstate(invalid="ignore"):
        return np.asarray((offsets**2).sum(1) <= radius**2)


def in_box(means: Array, low: Array, high: Array) -> Array:
    """Return (N,) bool: points between two corners (3,) along the world's axes, faces included."""
    return np.all((means >= np.asarray(low)) & (means <= np.asarray(high)), axis=1)


def at_point(surface: Surface, regions: Regions, level: int, point: Array) -> Array:
    """Return the (N,) bool region, at a level (index into LEVELS), of the surface nearest to `point` (3,)."""
    if len(surface.rows) == 0:
        return np.zeros(len(surface.anchors), bool)
    nearest = int(((surface.positions - point) ** 2).sum(1).argmin())
    return regions.everywhere[level] == regions.everywhere[level, surface.rows[nearest]]


def in_pixel(regions: Regions, level: int, rows: Array, weights: Array) -> Array:
    """Return the (N,) bool region, at a level, with the most weight in a pixel: (M,) rows and weights."""
    of = regions.everywhere[level]
    shares = np.bincount(of[rows] + 1, weights, 1)[1:]
    return np.asarray(of == shares.argmax()) if shares.any() else np.zeros(len(of), bool)


def grow(surface: Surface, selected: Array, distance: float) -> Array:
    """Return `selected` and everything within `distance` of it along the surface, world units."""
    if not 0 <= distance < float("inf"):
        raise InputError(f"a distance of {distance:g} cannot be walked along the surface; give 0 or more")
    reached = selected[surface.rows]
    if not reached.any() or reached.all():
        return _with_reached(surface, selected, reached)
    links = surface.links
    source = np.repeat(np.arange(len(surface.rows)), np.diff(links.indptr))
    gaps = np.linalg.norm(surface.positions[source] - surface.positions[links.indices], axis=1)
    # SciPy takes a stored zero for no link: coincident points get a tiny distance.
    lengths = scipy.sparse.csr_matrix((np.maximum(gaps, 1e-12), links.indices, links.indptr), links.shape)
    seeds = np.flatnonzero(reached)
    walk = scipy.sparse.csgraph.dijkstra
    away = walk(lengths, directed=False, indices=seeds, limit=distance, min_only=True)
    return _with_reached(surface, selected, np.isfinite(away))


def shrink(surface: Surface, selected: Array, distance: float) -> Array:
    """Return `selected` without what is within `distance` of the rest; the surface's own borders stay."""
    return ~grow(surface, ~selected, distance)


def _with_reached(surface: Surface, selected: Array, reached: Array) -> Array:
    """Return `selected` and every Gaussian at a `reached` (M,) point of the surface."""
    if len(reached) == 0:
        return selected.copy()
    return selected | (reached[surface.anchors] & (surface.anchors >= 0))


# Selections drawn on an image: the Gaussians whose centres a camera sees inside an outline or a stroke.
# Positions are in pixels of the camera; the centre of the first is at (0.5, 0.5).

BEHIND = 0.03  # of the surface's depth: a centre this far behind the surface is still on it


class Projected(NamedTuple):
    """The positions of N centres in one image."""

    pixels: Array  # (N, 2) float64
    depths: Array  # (N,) float64 camera z, world units; -1 for a centre without a position in the image


def project(means: Array, camera: Camera) -> Projected:
    """Return the positions of (N, 3) world points in the image of `camera`."""
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(np.asarray(means, np.float64))
        known = (depths > 0) & np.isfinite(depths) & np.isfinite(pixels).all(1)
    return Projected(np.where(known[:, None], pixels, -1.0), np.where(known, depths, -1.0))


def in_rectangle(seen: Projected, corner: Array, opposite: Array) -> Array:
    """Return (N,) bool: centres between two opposite corners (2,), pixels, borders included."""
    low, high = np.sort([corner, opposite], axis=0)
    return (seen.depths > 0) & ((seen.pixels >= low) & (seen.pixels <= high)).all(1)


def in_polygon(seen: Projected, outline: Array, size: tuple[int, int]) -> Array:
    """Return (N,) bool: centres in a pixel inside the closed `outline` (K, 2) px of an image of `size`."""
    check_array("outline", outline, ("K", 2))
    mask = Image.new("1", size)
    if len(outline) >= 3:
        ImageDraw.Draw(mask).polygon([*map(tuple, outline - 0.5)], fill=1)
    return _in_mask(seen, mask)


def in_stroke(seen: Projected, path: Array, radius: float, size: tuple[int, int]) -> Array:
    """Return (N,) bool: centres in a pixel at most `radius` px from the line through `path` (K, 2)."""
    check_array("path", path, ("K", 2))
    mask = Image.new("1", size)
    draw = ImageDraw.Draw(mask)
    draw.line([*map(tuple, path - 0.5)], fill=1, width=round(2 * radius))
    for x, y in path - 0.5:
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=1)
    return _in_mask(seen, mask)


def _in_mask(seen: Projected, mask: Image.Image) -> Array:
    inside, columns, rows = _cells(seen, 1.0, 1.0, mask.width, mask.height)
    inside[inside] = np.asarray(mask)[rows, columns]
    return inside


def _cells(
    seen: Projected, across: float, down: float, width: int, height: int
) -> tuple[Array, Array, Array]:
    """Return (N,) bool, which centres lie in a grid of that size, and their columns and rows."""
    columns, rows = np.floor(seen.pixels * (across, down)).T
    inside = (seen.depths > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return inside, columns[inside].astype(np.intp), rows[inside].astype(np.intp)


def on_surface(seen: Projected, depths: Array, size: tuple[int, int], behind: float = BEHIND) -> Array:
    """Return (N,) bool: centres in the image of `size` that no surface hides.

    A centre is visible if its depth is at most 1 + `behind` times that of the surface in its pixel. depths:
    (H, W) camera z of the surface, world units, 0 where there is none; of any resolution.
    """
    check_array("depths", depths, ("H", "W"))
    height, width = depths.shape
    inside, columns, rows = _cells(seen, width / size[0], height / size[1], width, height)
    there = depths[rows, columns].astype(np.float64)
    inside[inside] = (there <= 0) | (seen.depths[inside] <= there * (1 + behind))
    return inside


SEEN = 1e-3  # total weight over all photographs, pixels, above which a Gaussian was seen


def shares_in_masks(
    scene: Scene, masks_of: Callable[[Camera], Array], progress: Progress = silent
) -> tuple[Array, Array]:
    """Return the (N, P) float64 shares of each Gaussian's splatting weights that lie in P masks.

    That is W^T mask / W^T 1 over all cameras, NaN for Gaussians that none sees. Also returns the (P,) numbers
    of photographs with a mask. masks_of: from a camera to (H, W, P) bool; one photograph is held at a time.
    """
    sums, outlined = np.zeros((len(scene.gaussians), 1)), np.zeros(0, int)
    for index, camera in enumerate(scene.cameras):
        progress("asking photographs", index / len(scene.cameras))
        masks = masks_of(camera)
        image = np.concatenate([np.ones_like(masks[..., :1]), masks], -1).astype(np.float32)
        sums = sums + view_of(scene, camera).gather(image)
        outlined = outlined + masks.any((0, 1)) if index else masks.any((0, 1)).astype(int)
    progress("asking photographs", 1.0)
    seen, inside = sums[:, :1], sums[:, 1:]
    return np.where(seen > SEEN, inside / np.maximum(seen, SEEN), np.nan), outlined

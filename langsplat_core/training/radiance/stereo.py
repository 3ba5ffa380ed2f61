"""Depths by plane sweeping (Collins 1996) between photographs with known cameras.

Structure from motion finds some hundred points in nine photographs. Training then overfits what lies between
them: each photograph gets Gaussians of its own, anywhere along its rays. Depths are the remedy: Gaussians
begin at the surfaces, and none stay before one.

A view is compared with each neighbour as that would look if the scene were a plane parallel to the view. Of
all planes, uniform in inverse depth, a pixel takes the one at which windows correlate best. A depth is kept
where another view's agrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import minimum_filter

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.datasets.capture import TELLING_POINTS, Capture, look_distance
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import Camera

STAGE = "finding depths"
PLANES = 96
RADIUS = 3  # px, of the windows that are compared
BEST = 2  # scores of neighbours that count: others may see something before a pixel
NEAR_QUANTILE = 0.02  # of depths, which passes for the nearest
BEFORE = 0.05  # of the depth, from which on something lies before a surface
ALIKE = 0.03  # of the depth, up to which another pixel shares it
LEAST_ALIKE = 0.4  # of the pixels of a window, that share a depth which frees space
AROUND = 1 / 16  # of the image's longer side: how far from a pixel a depth tells of its surface ...
NEARER = 0.15  # ... which is nearer than all those by this share of them at most
NEARER_THAN_ALL = 0.5  # the same where there are none around, against the nearest of the image


@dataclass(frozen=True)
class DepthMap:
    """Depths of a view's pixels, world units along the camera's z axis."""

    camera: Camera
    depth: Array  # (H, W); NaN where none is known
    free: Array  # (H, W) depth up to which space is free
    score: Array  # (H, W) mean of the best `BEST` correlations, at most 1
    colours: Array  # (H, W, 3) uint8

    def points(self) -> tuple[Array, Array]:
        """Return the (N, 3) points of the pixels whose depth is known, and their (N, 3) colours."""
        known = np.isfinite(self.depth)
        points = self.camera.unproject(self.camera.pixel_centres()[known], self.depth[known])
        return points, self.colours[known]


def find_depths(capture: Capture, indices: Sequence[int], progress: Progress = silent) -> list[DepthMap]:
    """Find depths that another photograph confirms, at 320 px, but masked ones and without neighbours."""
    small = capture.shrunk(indices, 320)
    masks = [np.True_ if (mask := small.mask(index)) is None else mask for index in range(len(small))]
    # Windows reach into what is masked: it is the same in all photographs.
    greys = [
        np.where(mask, image.mean(2, dtype=np.float32) / 255, np.float32(0))
        for image, mask in zip(small.images, masks, strict=True)
    ]
    maps: list[DepthMap] = []
    for index, others in enumerate(neighbouring_views(small.cameras, capture.points)):
        if others:
            depth, score = sweep(index, others, small.cameras, greys, capture.points)
            depth = np.where(masks[index], depth, np.nan)
            free = np.zeros_like(depth)
            maps.append(DepthMap(small.cameras[index], depth, free, score, small.images[index]))
        progress(STAGE, (index + 1) / len(small))
    found: list[DepthMap] = []
    for index, one in enumerate(maps):
        progress(f"{STAGE} that agree", index / len(maps))
        depth = _confirmed(one, [other for other in maps if other is not one])
        free = free_depths(one.camera, shared_depths(depth), capture.points)
        found.append(replace(one, depth=depth, free=free))
    return found


def neighbouring_views(cameras: Sequence[Camera], known: Array) -> list[list[int]]:
    """Return each view's at most four best partners: they see its middle from about 12 degrees aside."""
    distance, positions = look_distance(cameras), np.stack([camera.position for camera in cameras])
    found = []
    for index, camera in enumerate(cameras):
        seen = known[camera.in_image(*camera.project(known))]
        ahead = camera.position + distance * camera.rotation[2]
        middle = np.median(seen, axis=0) if len(seen) >= TELLING_POINTS else ahead
        rays = unit(middle - positions, 1e-12)
        angles = np.degrees(np.arccos(np.clip(rays @ rays[index], -1, 1)))
        usable = [
            other
            for other, at in enumerate(cameras)
            if 2 < angles[other] < 35 and at.in_image(*at.project(middle[None]))[0]
        ]
        found.append(sorted(usable, key=lambda other: abs(angles[other] - 12))[:4])
    return found


def inverse_depths(camera: Camera, cameras: Sequence[Camera], known: Array) -> Array:
    """Return the (PLANES,) ascending inverse depths at which a view looks for surfaces."""
    pixels, depths = camera.project(known)
    depths = depths[camera.in_image(pixels, depths)]
    if len(depths) >= TELLING_POINTS // 2:
        near, far = np.quantile(depths, (NEAR_QUANTILE, 1 - NEAR_QUANTILE)) * (0.75, 1.5)
    else:
        near, far = look_distance(cameras) * np.array((0.3, 3.0))
    return np.linspace(1 / far, 1 / near, PLANES)


def warp(camera: Camera, other: Camera) -> tuple[Array, Array]:
    """Return the (3, 3) `turn` and (3,) `shift` that take pixels to another view.

    A pixel (x, y) at depth 1/w lies in the `other` view at (p[0] / p[2], p[1] / p[2]), p = turn @ (x, y, 1) +
    w shift.
    """
    rotation = other.rotation @ camera.rotation.T
    matrix = np.array([[other.fx, 0, other.cx], [0, other.fy, other.cy], [0, 0, 1]])
    back = np.array(
        [[1 / camera.fx, 0, -camera.cx / camera.fx], [0, 1 / camera.fy, -camera.cy / camera.fy], [0, 0, 1]]
    )
    return matrix @ rotation @ back, matrix @ (other.rotation @ (camera.position - other.position))


def sweep(
    index: int, others: Sequence[int], cameras: Sequence[Camera], greys: Sequence[Array], known: Array
) -> tuple[Array, Array]:
    """Return the (H, W) depths of a view by neighbours, and scores; greys: (H, W) float32 in [0, 1]."""
    camera, grey, run = cameras[index], greys[index], shared_workers().run
    planes = inverse_depths(camera, cameras, known)
    best = np.full((BEST, PLANES, *grey.shape), -1, np.float32)
    for other in others:
        run(score_planes, PLANES, grey, greys[other], *warp(camera, cameras[other]), planes, best)
    at, score = np.empty(grey.shape, np.float32), np.empty(grey.shape, np.float32)
    run(_choose_planes, len(grey), best, min(BEST, len(others)), at, score)
    return 1 / (planes[0] + at.astype(np.float64) * (planes[1] - planes[0])), score


@kernel
def score_planes(
    first: int, last: int, grey: Array, other: Array, turn: Array, shift: Array, planes: Array, best: Array
) -> None:
    """Correlate windows at planes [first, last); `best`: (BEST, P, H, W) scores, descending."""
    height, width = grey.shape
    warped = np.empty((height, width), np.float32)
    moments = np.empty((5, height, width), np.float32)  # sums of x, y, x^2, y^2, x y along rows of windows
    sums = np.empty((5, width), np.float32)
    for plane in range(first, last):
        _warp_image(other, turn, shift, planes[plane], warped)
        for row in range(height):
            _sum_along(grey[row], warped[row], moments, row)
        for row in range(height):
            top, bottom = max(row - RADIUS, 0), min(row + RADIUS + 1, height)
            sums[:] = 0
            for r in range(top, bottom):
                for m in range(5):
                    for x in range(width):
                        sums[m, x] += moments[m, r, x]
            for x in range(width):
                across = min(x + RADIUS + 1, width) - max(x - RADIUS, 0)
                score = _correlation(sums, x, np.float32(1) / np.float32((bottom - top) * across))
                score = score if warped[row, x] >= 0 else np.float32(-1)
                for k in range(BEST):
                    if score > best[k, plane, row, x]:
                        score, best[k, plane, row, x] = best[k, plane, row, x], score


@helper
def _warp_image(other: Array, turn: Array, shift: Array, inverse_depth: float, warped: Array) -> None:
    """Fill `warped` with the other image through the plane, bilinear; -1 outside of it."""
    height, width = other.shape
    for row in range(warped.shape[0]):
        for column in range(warped.shape[1]):
            x, y = column + 0.5, row + 0.5
            z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + inverse_depth * shift[2]
            u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + inverse_depth * shift[0]) / z - 0.5
            v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + inverse_depth * shift[1]) / z - 0.5
            if z > 0 and 0 <= u < width - 1 and 0 <= v < height - 1:
                i, j = int(u), int(v)
                a, b = np.float32(u - i), np.float32(v - j)
                above = other[j, i] + a * (other[j, i + 1] - other[j, i])
                below = other[j + 1, i] + a * (other[j + 1, i + 1] - other[j + 1, i])
                warped[row, column] = above + b * (below - above)
            else:
                warped[row, column] = -1


@helper
def _sum_along(grey: Array, warped: Array, moments: Array, row: int) -> None:
    """Sum along the windows of a row; beside the image there is nothing."""
    width = grey.shape[0]
    for m in range(5):
        moments[m, row] = 0
    for offset in range(-RADIUS, RADIUS + 1):
        for x in range(max(-offset, 0), min(width - offset, width)):
            a, b = grey[x + offset], warped[x + offset]
            moments[0, row, x] += a
            moments[1, row, x] += b
            moments[2, row, x] += a * a
            moments[3, row, x] += b * b
            moments[4, row, x] += a * b


@helper
def _correlation(sums: Array, x: int, share: float) -> float:
    """Zero-mean normalised cross-correlation of a window; what is flat correlates with nothing."""
    flat = np.float32(1e-5)  # added to variances, of grey values in [0, 1]
    mean_a, mean_b = sums[0, x] * share, sums[1, x] * share
    spread_a = max(sums[2, x] * share - mean_a * mean_a, np.float32(0)) + flat
    spread_b = max(sums[3, x] * share - mean_b * mean_b, np.float32(0)) + flat
    return (sums[4, x] * share - mean_a * mean_b) / np.sqrt(spread_a * spread_b)


@kernel
def _choose_planes(first: int, last: int, best: Array, count: int, at: Array, score: Array) -> None:
    """Find the plane of every pixel of rows [first, last), between planes by a parabola, and its score."""
    planes, width = best.shape[1], best.shape[3]
    mean = np.empty(planes, np.float32)
    for row in range(first, last):
        for x in range(width):
            for plane in range(planes):
                total = np.float32(0)
                for k in range(count):
                    total += best[k, plane, row, x]
                mean[plane] = total / np.float32(count)
            top = int(np.argmax(mean))
            inner = min(max(top, 1), planes - 2)
            bend = mean[inner - 1] - 2 * mean[inner] + mean[inner + 1]
            offset = 0.5 * (mean[inner - 1] - mean[inner + 1]) / bend if bend < 0 else 0.0
            at[row, x] = inner + min(max(offset, -0.5), 0.5) if inner == top else top
            score[row, x] = mean[top]


def _confirmed(one: DepthMap, others: Sequence[DepthMap]) -> Array:
    """(H, W) depths of the map, NaN where their score is low or no other map confirms them."""
    depth = np.where(one.score > 0.6, one.depth, np.nan)
    points, _ = replace(one, depth=depth).points()
    kept = np.zeros(len(points), bool)
    for other in others:
        there, pixels, depths = _in_view(other.camera, points)
        agree = np.abs(depths / other.depth[pixels] - 1) < 0.015
        kept[there] |= agree & (other.score[pixels] > 0.5)
    depth[np.isfinite(depth)] = np.where(kept, depth[np.isfinite(depth)], np.nan)
    return depth


def shared_depths(depth: Array) -> Array:
    """Return the (H, W) depths, NaN where too few pixels around share one.

    What two views agree on by chance is alone, and would free a window of space behind the surface.
    """
    size = 2 * RADIUS + 1
    windows = sliding_window_view(np.pad(depth, RADIUS, constant_values=np.nan), (size, size))
    alike = (np.abs(windows / depth[..., None, None] - 1) < ALIKE).sum((2, 3))
    return np.where(alike >= LEAST_ALIKE * size**2, depth, np.nan)


def free_depths(camera: Camera, depth: Array, known: Array) -> Array:
    """Return the (H, W) depths up to which space is free.

    By the surfaces of the (H, W) `depth`, NaN where it is not known, and by the (N, 3) `known` points. What
    no other photograph confirms is mostly flat: it is not much nearer than the surfaces around it.
    """
    told = np.where(np.isfinite(depth), depth, np.inf)
    _, pixels, depths = _in_view(camera, known)
    np.minimum.at(told, pixels, depths)
    if not np.isfinite(told).any():
        return np.zeros_like(told)
    reach = max(round(AROUND * max(told.shape)), 1)
    around = (1 - NEARER) * minimum_filter(told, 2 * reach + 1, mode="nearest")
    anywhere = (1 - NEARER_THAN_ALL) * np.quantile(told[np.isfinite(told)], NEAR_QUANTILE)
    free = np.where(np.isfinite(around), around, anywhere)
    return np.where(np.isfinite(depth), (1 - BEFORE) * depth, free)


def in_free_space(points: Array, maps: Sequence[DepthMap]) -> Array:
    """Return (N,) bool: the points that lie in the free space of more views than at their surfaces."""
    balance = np.zeros(len(points), int)
    for one in maps:
        there, pixels, depths = _in_view(one.camera, points)
        balance[there] += depths < one.free[pixels]
        balance[there] -= np.abs(depths / one.depth[pixels] - 1) < BEFORE / 2
    return balance > 0


def _in_view(camera: Camera, points: Array) -> tuple[Array, tuple[Array, Array], Array]:
    """Numbers of the (N, 3) points that lie in the image, their (rows, columns) and their depths."""
    pixels, depths = camera.project(points)
    there = np.flatnonzero(camera.in_image(pixels, depths))
    columns, rows = pixels[there].astype(int).T
    return there, (rows, columns), depths[there]

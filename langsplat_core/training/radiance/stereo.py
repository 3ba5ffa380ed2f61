"""Depths by plane sweeping (Collins 1996) between photographs with known cameras.

Between the few points of nine photographs each would get Gaussians of its own, anywhere along its rays. With
depths, Gaussians begin at the surfaces, and those in free space before a surface are removed.

A view is compared with each neighbour as that would look if the scene were a plane parallel to the view. Of
all planes, uniform in inverse depth, a pixel takes the one at which windows correlate best. A depth is kept
where another view's agrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import minimum_filter, uniform_filter

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.datasets.capture import TELLING_POINTS, Capture, look_distance
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import Camera

STAGE = "finding depths"
PLANES = 96
RADIUS = 3  # px, of the windows that are compared
BEST = 2  # neighbours whose scores count, the best ones: others may see something before a pixel
NEAR_QUANTILE = 0.02  # quantile of depths that counts as the nearest
BEFORE = 0.05  # share of a depth by which something nearer lies before the surface
ALIKE = 0.03  # share of a depth by which another pixel's may differ to be shared
LEAST_ALIKE = 0.4  # least share of a window's pixels that share a depth which frees space
AROUND = 1 / 16  # radius, over the image's longer side, in which known depths bound that of a pixel
NEARER = 0.15  # share by which the pixel's surface is nearer, at most, than all of these
NEARER_THAN_ALL = 0.5  # the same against the nearest depth of the image, where none is around


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
    """Return depths at 320 px of unmasked pixels that another photograph confirms; views need neighbours."""
    small = capture.shrunk(indices, 320)
    masks = [np.True_ if (mask := small.mask(index)) is None else mask for index in range(len(small))]
    # Windows extend into masked pixels, which are equal in all photographs.
    greys = [
        np.where(mask, image.mean(2, dtype=np.float32) / 255, np.float32(0))
        for image, mask in zip(small.images, masks, strict=True)
    ]
    maps: list[DepthMap] = []
    for index, others in enumerate(neighbouring_views(small.cameras, capture.points)):
        progress(STAGE, index / len(small))  # before the first: else the stage before seems to go on
        if others:
            depth, score = sweep(index, others, small.cameras, greys, capture.points)
            depth = np.where(masks[index], depth, np.nan)
            free = np.zeros_like(depth)
            maps.append(DepthMap(small.cameras[index], depth, free, score, small.images[index]))
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
    planes = inverse_depths(cameras[index], cameras, known)
    scores = plane_scores(cameras[index], greys[index], [(cameras[k], greys[k]) for k in others], planes)
    at, score = np.empty(scores.shape[1:], np.float32), np.empty(scores.shape[1:], np.float32)
    shared_workers().run(_choose_planes, len(at), scores, at, score)
    return 1 / (planes[0] + at.astype(np.float64) * (planes[1] - planes[0])), score


def plane_scores(camera: Camera, grey: Array, others: Sequence[tuple[Camera, Array]], planes: Array) -> Array:
    """Return (P, H, W) float32 means of each pixel's `BEST` correlations with other views at (P,) planes."""
    scores = np.empty((len(planes), *grey.shape), np.float32)
    warps = np.stack([np.column_stack(warp(camera, other)) for other, _ in others])
    sizes, pixels = np.array([image.shape for _, image in others]), [image.ravel() for _, image in others]
    own = np.stack([grey, *window_moments(grey)])
    shared_workers().run(
        _score_planes, len(planes), own, np.concatenate(pixels), sizes, warps, planes, scores
    )
    return scores


def window_moments(grey: Array) -> Array:
    """Return the (3, H, W) float32 means, variances and 1 / pixel counts of windows, cut at the border."""
    size = 2 * RADIUS + 1
    parts = np.ones(grey.shape), grey.astype(np.float64), grey.astype(np.float64) ** 2
    share, mean, squares = (uniform_filter(part, size, mode="constant") for part in parts)
    mean /= share
    moments = mean, (squares / share - mean**2).clip(0), 1 / (size**2 * share)
    return np.stack(moments).astype(np.float32)


@kernel
def _score_planes(
    first: int, last: int, own: Array, pixels: Array, sizes: Array, warps: Array, planes: Array, scores: Array
) -> None:
    """Correlate windows with those of other images at planes [first, last).

    own: (4, H, W) the image and its `window_moments`; pixels: of the others, one after the other, of (K, 2)
    `sizes`; warps: (K, 3, 4) turns and shifts; scores: (P, H, W). Loops are over plain rows, which the
    compiler vectorises.
    """
    _, height, width = own.shape
    warped, second = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    along = np.zeros((3, height + 2 * RADIUS, width), np.float32)  # nothing above and below the image
    places, ways = np.empty(width, np.int32), np.empty((2, width), np.float32)
    padded = np.zeros((3, width + 2 * RADIUS), np.float32)
    for plane in range(first, last):
        best, start = scores[plane], 0
        best[:], second[:] = -1, -1
        for k in range(len(sizes)):
            other = pixels[start : start + sizes[k, 0] * sizes[k, 1]].reshape(sizes[k, 0], sizes[k, 1])
            start += other.size
            step, down = warps[k, :, 0], warps[k, :, 1]
            corner = 0.5 * step + warps[k, :, 2] + planes[plane] * warps[k, :, 3]
            for row in range(height):
                p = corner + (row + 0.5) * down
                _warp_row(other, p.astype(np.float32), step.astype(np.float32), places, ways, warped[row])
                _sum_along(own[0, row], warped[row], padded, along, row)
            for row in range(height):
                _keep_best(own, along, row, warped[row], best[row], second[row])
        if len(sizes) > 1:
            best += second
            best *= np.float32(1 / BEST)


@helper
def _sum_along(grey: Array, warped: Array, padded: Array, along: Array, row: int) -> None:
    """Sum y, y^2 and x y along windows of a row; `padded` (3, W + 2 RADIUS) has zeros at both ends."""
    width = grey.shape[0]
    middle = slice(RADIUS, RADIUS + width)
    y, squares, products = padded[0, middle], padded[1, middle], padded[2, middle]
    for i in range(width):
        y[i] = warped[i]
        squares[i] = warped[i] * warped[i]
        products[i] = grey[i] * warped[i]
    for m in range(3):
        for i in range(width):
            total = padded[m, i]
            for offset in range(1, 2 * RADIUS + 1):
                total += padded[m, i + offset]
            along[m, row + RADIUS, i] = total


@helper
def _warp_row(other: Array, p: Array, d: Array, places: Array, ways: Array, warped: Array) -> None:
    """Fill `warped` with a row of the other image, bilinear; -1 outside of it.

    p, d: (3,) float32 homogeneous pixel that the row's first one falls on, and its step; places, ways:
    buffers for (W,) int32 pixels and for the (2, W) ways to the next ones, found without a branch.
    """
    width, flat = other.shape[1], other.reshape(-1)
    none, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    right, bottom = np.float32(width - 1), np.float32(other.shape[0] - 1)
    for x in range(warped.shape[0]):
        inverse = one / (p[2] + np.float32(x) * d[2])
        u = (p[0] + np.float32(x) * d[0]) * inverse - half
        v = (p[1] + np.float32(x) * d[1]) * inverse - half
        inside = (inverse > none) & (u >= none) & (u < right) & (v >= none) & (v < bottom)
        u, v = u if inside else none, v if inside else none
        i, j = np.int32(u), np.int32(v)
        ways[0, x], ways[1, x] = u - np.float32(i), v - np.float32(j)
        places[x] = j * np.int32(width) + i if inside else np.int32(-1)
    for x in range(warped.shape[0]):
        warped[x] = -1
        if places[x] >= 0:
            at, a, b = np.uint32(places[x]), ways[0, x], ways[1, x]
            above = flat[at] + a * (flat[at + np.uint32(1)] - flat[at])
            at += np.uint32(width)
            below = flat[at] + a * (flat[at + np.uint32(1)] - flat[at])
            warped[x] = above + b * (below - above)


@helper
def _keep_best(own: Array, along: Array, row: int, warped: Array, best: Array, second: Array) -> None:
    """Keep the two best zero-mean normalised cross-correlations of a row's windows; flat ones score 0."""
    flat, none = np.float32(1e-5), np.float32(0)  # added to variances, of grey values in [0, 1]
    for x in range(best.shape[0]):
        total, squares, products = along[0, row, x], along[1, row, x], along[2, row, x]
        for r in range(row + 1, row + 2 * RADIUS + 1):
            total += along[0, r, x]
            squares += along[1, r, x]
            products += along[2, r, x]
        share = own[3, row, x]
        mean = total * share
        spread = squares * share - mean * mean
        spread = (spread if spread > none else none) + flat
        score = (products * share - own[1, row, x] * mean) / np.sqrt((own[2, row, x] + flat) * spread)
        score = score if warped[x] >= none else np.float32(-1)
        worse = score if score < best[x] else best[x]
        best[x] = score if score > best[x] else best[x]
        second[x] = worse if worse > second[x] else second[x]


@kernel
def _choose_planes(first: int, last: int, scores: Array, at: Array, score: Array) -> None:
    """Find the plane of every pixel of rows [first, last), between planes by a parabola, and its score."""
    planes, _, width = scores.shape
    for row in range(first, last):
        for x in range(width):
            mean = scores[:, row, x]
            top = int(np.argmax(mean))
            inner = min(max(top, 1), planes - 2)
            bend = mean[inner - 1] - 2 * mean[inner] + mean[inner + 1]
            offset = 0.5 * (mean[inner - 1] - mean[inner + 1]) / bend if bend < 0 else 0.0
            at[row, x] = inner + min(max(offset, -0.5), 0.5) if inner == top else top
            score[row, x] = mean[top]


def _confirmed(one: DepthMap, others: Sequence[DepthMap]) -> Array:
    """Return (H, W) depths of the map, NaN where their score is low or no other map confirms them."""
    depth = np.where(one.score > 0.6, one.depth, np.nan)
    points, _ = replace(one, depth=depth).points()
    kept = np.zeros(len(points), bool)
    for other in others:
        unsure = np.flatnonzero(~kept)
        there, pixels, depths = _in_view(other.camera, points[unsure])
        agree = np.abs(depths / other.depth[pixels] - 1) < 0.015
        kept[unsure[there]] = agree & (other.score[pixels] > 0.5)
    depth[np.isfinite(depth)] = np.where(kept, depth[np.isfinite(depth)], np.nan)
    return depth


def shared_depths(depth: Array) -> Array:
    """Return the (H, W) depths, NaN where too few pixels around share one.

    A depth that two views share by chance stands alone, and would free a window of space behind the surface.
    """
    alike = np.empty(depth.shape, np.int32)
    shared_workers().run(_count_alike, len(depth), depth, alike)
    return np.where(alike >= LEAST_ALIKE * (2 * RADIUS + 1) ** 2, depth, np.nan)


@kernel
def _count_alike(first: int, last: int, depth: Array, alike: Array) -> None:
    """Count the pixels of the window around each of rows [first, last) that share its depth."""
    height, width = depth.shape
    for row in range(first, last):
        for x in range(width):
            alike[row, x] = 0
            for r in range(max(row - RADIUS, 0), min(row + RADIUS + 1, height)):
                for c in range(max(x - RADIUS, 0), min(x + RADIUS + 1, width)):
                    alike[row, x] += abs(depth[r, c] / depth[row, x] - 1) < ALIKE


def free_depths(camera: Camera, depth: Array, known: Array) -> Array:
    """Return the (H, W) depths up to which space is free.

    They follow from the (H, W) `depth` of surfaces, NaN where unknown, and from the (N, 3) `known` points. A
    surface that no other photograph confirms is mostly flat: not much nearer than the surfaces around it.
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
    """Return (N,) bool: points that lie in free space in more views than they lie at a surface in."""
    balance = np.zeros(len(points), int)
    for one in maps:
        there, pixels, depths = _in_view(one.camera, points)
        balance[there] += depths < one.free[pixels]
        balance[there] -= np.abs(depths / one.depth[pixels] - 1) < BEFORE / 2
    return balance > 0


def _in_view(camera: Camera, points: Array) -> tuple[Array, tuple[Array, Array], Array]:
    """Return the numbers of the (N, 3) points in the image, their (rows, columns) and their depths."""
    pixels, depths = camera.project(points)
    there = np.flatnonzero(camera.in_image(pixels, depths))
    columns, rows = pixels[there].astype(int).T
    return there, (rows, columns), depths[there]

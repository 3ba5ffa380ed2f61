"""Overlays as plain maths in float64: labels, lines and ground grid. No window."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import NO_ORIGIN, Camera
from langsplat_viewer.camera.controls import Extent, frame_of, weighted_quantile


@dataclass(frozen=True)
class PlacedText:
    """The place of a text in an image, in units of the image, y down."""

    x: float  # left edge, as wanted
    y: float  # upper edge
    width: float
    height: float

    def covers(self, other: "PlacedText") -> bool:
        """Return whether the two overlap; edges that touch do not."""
        beside = self.x + self.width <= other.x or other.x + other.width <= self.x
        return not (beside or self.y + self.height <= other.y or other.y + other.height <= self.y)


def placed(
    labels: Sequence[PlacedText], size: tuple[float, float], taken: Sequence[PlacedText] = ()
) -> list[PlacedText]:
    """Return the labels, none over another or over what is `taken`, in an image of `size` (width, height).

    Each one goes straight up until it is free of those before it, else straight down, and where there is no
    room it stays. So it moves with its thing, and jumps only where it meets another or parts from it.
    """
    found = [*taken]
    for label in labels:
        x, last = max(min(label.x, size[0] - label.width), 0.0), size[1] - label.height
        inside = replace(label, x=x, y=max(min(label.y, last), 0.0))
        beside = (y for one in found for y in (one.y - label.height, one.y + one.height) if 0 <= y <= last)
        ways = sorted((inside.y, *beside), key=lambda y: (y > inside.y, abs(y - inside.y)))
        free = (replace(inside, y=y) for y in ways)
        found.append(next((way for way in free if not any(map(way.covers, found))), inside))
    return found[len(taken) :]


# Lines: where they are in the world, and where on screen.

LEAST_DEPTH = 1e-3  # of the scene's radius: lines end this far in front of the eye
FRUSTUM_DEPTH = 0.12  # of the scene's radius: how deep a camera is drawn
GROUND_SHARE = 0.02  # of the scene's weight that lies below the ground
GRID_LINES = 10  # about as many across the scene
GRID_REACH = 1.2  # of the scene's radius, from its middle to the edge of the grid
FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))  # of eye and corners


def clip_segments(camera: Camera, segments: Array, least_depth: float) -> tuple[Array, Array]:
    """Return the visible parts of (M, 2, 3) segments between world points, and the rows they come from.

    (K, 2, 2) pixels of `camera`, and (K,) in rising order. A segment is cut where its camera z is
    `least_depth` (world units, > 0) and at the four planes of the image's borders. All are linear in camera
    space, so that nothing is divided before the cut and no coordinate on screen is beyond the image.
    """
    points = segments.astype(np.float64) @ camera.rotation.T + camera.world_to_camera[:3, 3]
    start, step = points[:, 0], points[:, 1] - points[:, 0]
    planes = np.array(
        [
            [camera.fx, 0, camera.cx, 0],
            [-camera.fx, 0, camera.width - camera.cx, 0],
            [0, camera.fy, camera.cy, 0],
            [0, -camera.fy, camera.height - camera.cy, 0],
            [0, 0, 1, -least_depth],
        ]
    )
    if camera.orthographic:  # the borders' planes are parallel: in place of z stands 1
        planes[:4] = planes[:4, [0, 1, 3, 2]]
    planes, offsets = planes[:, :3], planes[:, 3]
    inside, slope = start @ planes.T + offsets, step @ planes.T  # >= 0 is inside
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = -inside / slope
    enters = np.where(slope > 0, crossing, np.where((slope == 0) & (inside < 0), np.inf, 0)).max(1)
    leaves = np.where(slope < 0, crossing, 1).min(1)
    enters, leaves = np.maximum(enters, 0), np.minimum(leaves, 1)
    rows = np.flatnonzero(enters <= leaves)
    ends = start[rows, None] + np.stack([enters[rows], leaves[rows]], 1)[..., None] * step[rows, None]
    # Rounding must not take an end behind the plane.
    depth = 1.0 if camera.orthographic else np.maximum(ends[..., 2:], least_depth)
    return ends[..., :2] / depth * (camera.fx, camera.fy) + (camera.cx, camera.cy), rows


@lru_cache(maxsize=1)  # asked in every frame
def frusta(cameras: tuple[Camera, ...], depth: float) -> Array:
    """Return the (C, 8, 2, 3) edges of the pyramids from each camera's eye to its image at `depth`.

    World units. The four from the eye come first.
    """
    made = np.zeros((len(cameras), 5, 3))
    for row, camera in zip(made, cameras, strict=True):
        w, h = camera.width, camera.height
        row[0] = camera.position
        row[1:] = camera.unproject([(0, 0), (w, 0), (w, h), (0, h)], depth)
    edges: Array = made[:, np.array(FRUSTUM_EDGES)]
    return edges


def box_edges(corners: Array) -> Array:
    """Return the (12, 2, 3) edges of (8, 3) corners, in the order of `query.instances.OrientedBox`."""
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    edges: Array = corners[np.array(pairs)]
    return edges


def nearest_segment(segments: Array, point: tuple[float, float]) -> tuple[int, float]:
    """Return the row of (K, 2, 2) segments nearest to a point, and its distance; (-1, inf) for none."""
    if not len(segments):
        return -1, math.inf
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    length = np.maximum((step**2).sum(1), 1e-12)
    along = np.clip(((np.asarray(point) - start) * step).sum(1) / length, 0, 1)
    distances = np.linalg.norm(start + along[:, None] * step - point, axis=1)
    row = int(distances.argmin())
    return row, float(distances[row])


def round_length(length: float) -> float:
    """Return the nearest of 1, 2 and 5 times a power of ten; `length` > 0."""
    power = 10.0 ** math.floor(math.log10(length))
    return min((factor * power for factor in (1, 2, 5, 10)), key=lambda value: abs(math.log(value / length)))


def measured(units: float, metres_per_unit: float | None) -> str:
    """Return as text a length in world units, and in metres where the scene has a scale."""
    text = f"{units:.4g} units"
    return text if metres_per_unit is None else f"{units * metres_per_unit:.4g} m ({text})"


def ground_grid(
    extent: Extent, up: Array, metres_per_unit: float | None, origin: Array = NO_ORIGIN
) -> tuple[Array, float]:
    """Return (M, 2, 3) lines, and their spacing, of a level grid below almost all of a scene.

    They are round lengths apart and at round distances from the world's zero, `origin` (3,) away: in metres
    where the scene has a scale, else in world units.
    """
    scale = metres_per_unit or 1.0
    frame = frame_of(up)
    spacing = round_length(2 * GRID_REACH * extent.radius / GRID_LINES * scale) / scale
    shift = frame @ origin
    right, height, front = frame @ extent.centre
    height -= extent.radius
    if len(extent.sample.points):
        height = weighted_quantile(extent.sample.points @ up, extent.sample.weights, GROUND_SHARE)
    reach = GRID_REACH * extent.radius
    middles = right + shift[0], front + shift[2]
    ends = (((middle - reach) / spacing, (middle + reach) / spacing) for middle in middles)
    across, ahead = (spacing * np.arange(math.floor(low), math.ceil(high) + 1) for low, high in ends)

    def point(x: float, z: float) -> Array:
        return np.array([x - shift[0], height, z - shift[2]]) @ frame

    lines = [(point(x, ahead[0]), point(x, ahead[-1])) for x in across]
    lines += [(point(across[0], z), point(across[-1], z)) for z in ahead]
    return np.array(lines), spacing

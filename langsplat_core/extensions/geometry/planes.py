"""Floor and walls of a scene: planes in its surface, by RANSAC (Open3D), and what they say about up."""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.extensions.geometry.points import cloud, sample_surface
from langsplat_core.scene import Scene

SAMPLES = 30_000  # points of the surface
NEAR = 0.02  # of the scene's radius: how far from a plane its points lie
MOST = 8  # planes that are looked for
LEAST = 0.02  # of the surface: what is less is no plane of a room
ITERATIONS = 1_000  # of RANSAC, a plane
LEVEL, UPRIGHT = 0.9, 0.5  # cosine with up of the normals of a floor, at least, and of a wall, at most
STRETCH = 20.0  # of heights, while walls are looked for: a level slab through furniture has few points then
BELOW = 0.05  # of the surface, that may lie below the floor: what shines through it, and floaters
APART = 0.15  # of the scene's radius: nearer than this, two parallel walls are one that is not sharp


@dataclass(frozen=True, eq=False)
class Plane:
    """The points x with normal . x = offset."""

    normal: Array  # (3,) unit, float64
    offset: float  # world units
    share: float  # of the scene's surface that lies in it

    def heights(self, points: Array) -> Array:
        """(P,) signed distances of (P, 3) points, world units, positive where the normal points."""
        return np.asarray(points @ self.normal - self.offset)


@dataclass(frozen=True, eq=False)
class Room:
    """The planes of a scene that matter to whoever stands in it."""

    up: Array  # (3,) unit: the floor's normal; the scene's own up where there is no floor
    ground: float  # height of the floor along `up`, world units; without one of nearly the lowest surface
    floor: Plane | None  # its normal points up
    walls: tuple[Plane, ...]  # the largest first; their normals point to the middle of the scene


def find_planes(points: Array, near: float, least: float, seed: int = 0) -> list[Plane]:
    """Return the planes with the most of (P, 3) points, the largest first.

    They are found one after the other, each among the points that the ones before it left over. near: how far
    from a plane its points lie; least: points of a plane. Shares are of these points.
    """
    import open3d

    found: list[Plane] = []
    left = points
    open3d.utility.random.seed(seed)
    while len(found) < MOST and len(left) >= max(least, 3):
        (*normal, d), inside = cloud(left).segment_plane(near, 3, ITERATIONS, 1.0)
        if len(inside) < least:
            break
        length = float(np.linalg.norm(normal))
        found.append(Plane(np.array(normal) / length, -d / length, len(inside) / len(points)))
        left = np.delete(left, inside, axis=0)
    return found


def find_room(scene: Scene, seed: int = 0) -> Room:
    """Floor, walls and up of a scene.

    The floor is the largest level plane with hardly any surface below it. Raises InputError for a scene
    without a surface.
    """
    points, normals = sample_surface(scene.gaussians, SAMPLES, seed)
    centre, radius = scene.bounds()
    up, near, least = scene.up(), NEAR * radius, LEAST * len(points)
    along = np.abs(normals @ up)
    level = [_facing(plane, up) for plane in find_planes(points[along >= LEVEL], near, least, seed)]
    floor = next((one for one in level if (one.heights(points) < -2 * near).mean() <= BELOW), None)
    if floor is not None:
        up = floor.normal
        floor = replace(floor, share=floor.share * float((along >= LEVEL).mean()))
    ground = floor.offset if floor is not None else float(np.quantile(points @ up, BELOW))
    stretch = np.eye(3) + (STRETCH - 1) * np.outer(up, up)
    upright = points[along <= UPRIGHT]
    walls: list[Plane] = []
    for plane in find_planes(upright @ stretch, near, least, seed):
        normal = plane.normal - (plane.normal @ up) * up
        length, share = float(np.linalg.norm(normal)), plane.share * len(upright) / len(points)
        inner = _facing(Plane(normal / length, plane.offset / length, share), centre, plane.offset / length)
        if not any(
            one.normal @ inner.normal > LEVEL and abs(one.offset - inner.offset) < APART * radius
            for one in walls
        ):
            walls.append(inner)
    return Room(up, ground, floor, tuple(walls))


def _facing(plane: Plane, towards: Array, offset: float = 0.0) -> Plane:
    """Return the plane with its normal on the side of `towards`, a (3,) direction.

    `towards` may also be a point with the plane's own offset.
    """
    if towards @ plane.normal >= offset:
        return plane
    return Plane(-plane.normal, -plane.offset, plane.share)

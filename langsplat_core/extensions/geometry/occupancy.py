"""Maps for robots: the floor, voxels, a map of the floor, and free poses in front of instances.

The floor is a plane of points sampled evenly from the surface, found by RANSAC (Open3D).
Space along a ray of a training camera is free up to the depth of half transmittance and occupied there. Space
that no ray reaches is unknown.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import ndimage

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel
from langsplat_core.errors import InputError
from langsplat_core.extensions.geometry.mesh import watertight
from langsplat_core.extensions.geometry.registration import cloud, sample_surface
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.render import view_of
from langsplat_core.scene import NO_ORIGIN, Scene
from langsplat_core.scene.transform import Similarity, turned_origin

MOST_CELLS = 60_000_000  # of a grid
SIDE = 240  # pixels of the longer side of the depth images
HIT = 0.1  # least share of a voxel's rays that end in it if it is occupied
OUTSIDE = 0.02  # share of the seen surface outside the grid at each end of each axis: floaters, far surfaces
MARGIN = 5  # voxels around the seen surface
MOST_LOOKS = 20_000  # positions, at most, that are tested for a free line to an instance
MOST_PAIRS = 4_000_000  # distances, at most, between positions and cells of an instance
STAGE = "measuring what is free"
# Of the floor.
FLOOR_POINTS = 30_000  # of the surface
IN_PLANE = 0.02  # largest distance of a plane's points, as a share of the scene's radius
LEAST = 0.02  # least share of the surface in a plane of a room
MOST = 8  # planes that are tried
LEVEL = 0.9  # least cosine of a floor's normals with up
BELOW = 0.05  # largest share of the surface below the floor: reflections and floaters


@dataclass(frozen=True, eq=False)
class Room:
    """Up direction and floor of a scene."""

    up: Array  # (3,) unit: the floor's normal; the scene's own up without a floor
    ground: float  # height of the floor along `up`, world units; without one, of nearly the lowest surface
    has_floor: bool


def find_room(scene: Scene) -> Room:
    """Return up and floor: the largest level plane with little below it; InputError without a surface.

    Planes are found one by one, each among the level points that are in none of the planes before it.
    """
    import open3d

    points, normals = sample_surface(scene.gaussians, FLOOR_POINTS)
    up, near, least = scene.up(), IN_PLANE * scene.bounds()[1], max(LEAST * len(points), 3)
    left = points[np.abs(normals @ up) >= LEVEL]
    open3d.utility.random.seed(0)
    for _ in range(MOST):
        if len(left) < least:
            break
        (*direction, offset), inside = cloud(left).segment_plane(near, 3, 1_000, 1.0)
        if len(inside) < least:
            break
        normal, length = np.array(direction), np.linalg.norm(direction)
        sign = 1 if normal @ up >= 0 else -1
        normal, ground = sign * normal / length, -sign * float(offset / length)
        if (points @ normal - ground < -2 * near).mean() <= BELOW:
            return Room(normal, ground, has_floor=True)
        left = np.delete(left, inside, axis=0)
    return Room(up, float(np.quantile(points @ up, BELOW)), has_floor=False)


@dataclass(frozen=True, eq=False)
class Occupancy:
    """X x Y x Z voxels in map axes: metres, z up, the ground at z = 0."""

    to_map: Similarity  # from the scene to the map's metres
    origin: Array  # (3,) lower corner of the first voxel, metres
    resolution: float  # metres
    hits: Array  # (X, Y, Z) uint16 rays that end in each voxel
    passes: Array  # (X, Y, Z) uint16 rays that go through it

    @property
    def occupied(self) -> Array:
        """The (X, Y, Z) bool voxels in which enough of the rays end."""
        return np.asarray((self.hits > 0) & (self.hits >= HIT * (self.hits + self.passes.astype(np.float64))))

    @property
    def seen(self) -> Array:
        """The (X, Y, Z) bool voxels that a ray reaches."""
        return np.asarray((self.hits > 0) | (self.passes > 0))


@dataclass(frozen=True, eq=False)
class FloorMap:
    """The map of the floor, X x Y cells."""

    origin: Array  # (2,) lower left corner of the first cell, metres
    resolution: float
    occupied: Array  # (X, Y) bool: occupied between the step and the robot's height
    free: Array  # (X, Y) bool: seen and not occupied

    def centres(self, cells: Array) -> Array:
        """Return the (P, 2) centres of cells, metres."""
        return np.asarray(self.origin + (cells + 0.5) * self.resolution)


@dataclass(frozen=True)
class Goal:
    """A pose in front of an instance."""

    x: float  # metres
    y: float
    yaw: float  # radians from the map's x axis, towards the instance
    distance: float  # metres from the robot's centre to the instance's nearest point


def map_axes(room: Room, metres: float, origin: Array = NO_ORIGIN) -> Similarity:
    """Return the similarity from a scene with an `origin` (3,) to map axes.

    z is up, the ground at 0, and x the level axis nearest to the world's x axis, or to its y axis if x is
    nearly up. metres: per unit.
    """
    first = np.eye(3)[0 if abs(room.up[0]) < 0.9 else 1]
    first = first - (first @ room.up) * room.up
    first /= np.linalg.norm(first)
    rotation = np.stack([first, np.cross(room.up, first), room.up])
    moved = metres * turned_origin(rotation, origin)
    moved[2] = -metres * room.ground
    return Similarity(rotation, moved, metres)


def find_occupancy(
    scene: Scene, to_map: Similarity, resolution: float, progress: Progress = silent
) -> Occupancy:
    """Return voxels of `resolution` metres, from depth images of the scene's cameras.

    Raises InputError without cameras or surfaces, and for more than `MOST_CELLS` voxels.
    """
    if not scene.cameras:
        raise InputError("the scene has no cameras, so nothing says what is free; map a trained scene")
    rays = []
    for number, camera in enumerate(scene.cameras):
        progress(STAGE, number / (2 * len(scene.cameras)))
        small = camera.within(SIDE)
        depth = view_of(scene, small).median_depth()
        points = small.unproject(small.pixel_centres()[depth > 0], depth[depth > 0])
        rays.append((to_map.points(small.position), to_map.points(points)))
    ends = np.concatenate([points for _, points in rays])
    if len(ends) == 0:
        raise InputError("the scene's cameras see nothing in it; a map needs surfaces")
    low, high = np.quantile(ends, [OUTSIDE, 1 - OUTSIDE], axis=0)
    low, high = low - MARGIN * resolution, high + MARGIN * resolution
    with np.errstate(over="ignore"):
        sides = np.ceil((high - low) / resolution)
    if not np.prod(sides) <= MOST_CELLS:
        raise InputError(
            f"{sides[0]:g} x {sides[1]:g} x {sides[2]:g} voxels of {resolution:g} m are too many; "
            "take a coarser --resolution, or see that the scene's scale is right"
        )
    shape = sides.astype(np.int64)
    hits, passes = (np.zeros(shape, np.uint16) for _ in range(2))
    for number, (eye, points) in enumerate(rays):
        progress(STAGE, 0.5 + number / (2 * len(rays)))
        trace((eye - low) / resolution, (points - low) / resolution, hits, passes)
    progress(STAGE, 1.0)
    return Occupancy(to_map, low, resolution, hits, passes)


@kernel
def trace(eye: Array, ends: Array, hits: Array, passes: Array) -> None:
    """Count the voxels along rays from `eye` (3,) to `ends` (P, 3) (Amanatides and Woo 1987), saturating."""
    most = np.iinfo(np.uint16).max
    shape = hits.shape
    cell, last, step = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64)
    until, every = np.zeros(3), np.zeros(3)
    for i in range(len(ends)):
        total = 0
        for a in range(3):
            way = ends[i, a] - eye[a]
            cell[a], last[a] = np.int64(np.floor(eye[a])), np.int64(np.floor(ends[i, a]))
            step[a] = 1 if way > 0 else -1
            every[a] = np.inf if way == 0 else abs(1 / way)
            border = cell[a] + 1 - eye[a] if way > 0 else eye[a] - cell[a]
            until[a] = np.inf if way == 0 else border * every[a]
            total += abs(last[a] - cell[a])
        for _ in range(total):
            inside = 0 <= cell[0] < shape[0] and 0 <= cell[1] < shape[1] and 0 <= cell[2] < shape[2]
            if inside and passes[cell[0], cell[1], cell[2]] < most:
                passes[cell[0], cell[1], cell[2]] += 1
            a = 0
            if until[1] < until[a]:
                a = 1
            if until[2] < until[a]:
                a = 2
            cell[a] += step[a]
            until[a] += every[a]
        inside = 0 <= last[0] < shape[0] and 0 <= last[1] < shape[1] and 0 <= last[2] < shape[2]
        if inside and hits[last[0], last[1], last[2]] < most:
            hits[last[0], last[1], last[2]] += 1


def floor_map(occupancy: Occupancy, step: float, height: float) -> FloorMap:
    """Return the map for a robot of a height that drives over obstacles lower than `step`, metres."""
    floors = occupancy.origin[2] + np.arange(occupancy.hits.shape[2]) * occupancy.resolution
    band = (floors + occupancy.resolution / 2 >= step) & (floors <= height)
    if not band.any():
        raise InputError(
            f"no voxel lies between a step of {step:g} m and a height of {height:g} m; "
            "take a finer --resolution"
        )
    occupied = np.asarray(occupancy.occupied[:, :, band].any(2))
    free = np.asarray(occupancy.seen[:, :, band].any(2) & ~occupied)
    return FloorMap(occupancy.origin[:2], occupancy.resolution, occupied, free)


def reachable(plan: FloorMap, radius: float, start: tuple[float, float] | None = None) -> Array:
    """Return the (X, Y) bool cells in which the centre of a robot may be.

    They are at least its radius, metres, from obstacles, and connected with `start`, by default the largest
    such region. Raises InputError if there are none.
    """
    blocked = np.pad(~plan.free, 1, constant_values=True)
    clear = (ndimage.distance_transform_edt(~blocked)[1:-1, 1:-1] - 0.5) * plan.resolution >= radius
    labels, count = ndimage.label(clear)
    if count == 0:
        raise InputError(f"a robot of {radius:g} m radius fits nowhere; give a smaller --robot-radius")
    if start is None:
        return np.asarray(labels == 1 + np.bincount(labels[labels > 0] - 1).argmax())
    cell = np.floor((np.array(start) - plan.origin) / plan.resolution).astype(int)
    if (cell < 0).any() or (cell >= plan.free.shape).any() or labels[tuple(cell)] == 0:
        raise InputError(f"--start {start[0]:g} {start[1]:g}: the robot does not fit there, or nobody saw it")
    return np.asarray(labels == labels[tuple(cell)])


def find_goal(plan: FloorMap, where: Array, points: Array, least: float = 0.0) -> Goal | None:
    """Return the pose in `where` (X, Y) bool nearest to an instance, facing it, with a free line, or None.

    points: (P, 2) metres, of the instance seen from above, P >= 1; least: least distance to it, metres.
    """
    cells = np.argwhere(where)
    centres = plan.centres(cells)
    thing = np.unique(np.floor((points - plan.origin) / plan.resolution).astype(int), axis=0)
    spots = plan.centres(thing)
    spots = spots[:: max(len(spots) * len(cells) // MOST_PAIRS, 1)]
    gaps = np.sqrt(((centres[:, None] - spots[None]) ** 2).sum(2))
    nearest = gaps.min(1)
    own = np.zeros(plan.free.shape, bool)
    inside = ((thing >= 0) & (thing < own.shape)).all(1)
    own[tuple(thing[inside].T)] = True
    blocked = plan.occupied & ~ndimage.binary_dilation(own, iterations=2)  # all but the instance itself
    middle = np.median(points, axis=0)
    # Of equally near cells, the one nearest to the centre of the instance.
    aside = ((centres - middle) ** 2).sum(1)
    for best in np.lexsort((aside, np.round(nearest / plan.resolution)))[:MOST_LOOKS]:
        if nearest[best] >= least and not _between(plan, blocked, centres[best], spots[gaps[best].argmin()]):
            break
    else:
        return None
    ahead = middle - centres[best]
    x, y = centres[best]
    return Goal(float(x), float(y), float(np.arctan2(ahead[1], ahead[0])), float(nearest[best]))


def _between(plan: FloorMap, blocked: Array, start: Array, end: Array) -> bool:
    """Return True if the line between two positions (2,), metres, crosses a cell of `blocked` (X, Y) bool."""
    count = 2 * int(np.linalg.norm(end - start) / plan.resolution) + 2
    along = start + np.linspace(0, 1, count)[:, None] * (end - start)
    cells = np.floor((along - plan.origin) / plan.resolution).astype(int)
    cells = cells[((cells >= 0) & (cells < blocked.shape)).all(1)]
    return bool(blocked[tuple(cells.T)].any())


def collider(occupancy: Occupancy) -> tuple[Array, Array]:
    """Return watertight triangles around all occupied voxels: (V, 3) vertices, m, and (T, 3)."""
    solid = np.pad(occupancy.occupied, 1)
    loop = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])  # counterclockwise from above
    corners = []
    for axis, side in product(range(3), (0, 1)):
        cells = np.argwhere(solid & ~np.roll(solid, 1 - 2 * side, axis)) - 1
        square = np.repeat(cells[:, None], 4, axis=1)
        square[:, :, axis] += side
        square[:, :, [(axis + 1) % 3, (axis + 2) % 3]] += loop if side else loop[:, ::-1]
        corners.append(square.reshape(-1, 3))
    every = np.concatenate(corners).astype(np.float64)
    squares = np.arange(len(every)).reshape(-1, 4)
    points, triangles = watertight(every, squares[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), 1e-3)
    return occupancy.origin + points * occupancy.resolution, triangles

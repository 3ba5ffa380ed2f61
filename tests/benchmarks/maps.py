"""Maps of rooms against the room's own surfaces: voxels, floor plan, up and ground."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from assets.making.dataset import photographed_room
from assets.making.objects.furniture import TABLE_HEIGHT
from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.geometry.occupancy import find_occupancy, floor_map, map_axes
from langsplat_core.geometry.planes import find_room
from langsplat_core.progress import TerminalProgress
from langsplat_core.scene import Scene
from tests.benchmarks.room import InRooms, Room, publish
from tests.benchmarks.verdicts import spread

DENSITY = 4_000  # true points per square metre
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Maps(InRooms):
    """Occupied and free cells of `langsplat map` in rooms whose surfaces are known."""

    resolution: float = 0.05  # metres
    step: float = 0.12
    robot_height: float = 0.5

    def run(self) -> None:
        with TerminalProgress() as progress:
            rows = [row for room in self.rooms(progress) for row in [self._measure(room)]]
        names = list(vars(rows[0]))[1:]
        cells = [spread(np.array([getattr(row, name) for row in rows], float)) for name in names]
        head = [name.replace("_", " ") for name in names]
        publish(self, "maps", "Maps for robots", markdown(tuple(head), [tuple(cells)]), rows)

    def _measure(self, room: Room) -> "MapRow":
        scene = Scene(room.gaussians, cameras=tuple(room.capture.cameras))
        planes = find_room(scene)
        occupancy = find_occupancy(scene, map_axes(planes, 1.0), self.resolution)
        true = _moved(true_points(room), occupancy.to_map)
        seen = _taken(occupancy.seen, occupancy.voxels(true_points(room)))
        near = 1.5 * self.resolution
        solid = occupancy.origin + (np.argwhere(occupancy.occupied) + 0.5) * self.resolution
        low = (solid[:, 2] >= self.step) & (solid[:, 2] <= self.robot_height)
        precision = cKDTree(true).query(solid)[0] <= near
        recall = cKDTree(solid).query(true[seen])[0] <= near
        plan = floor_map(occupancy, self.step, self.robot_height)
        band = true[(true[:, 2] >= self.step) & (true[:, 2] <= self.robot_height)]
        cells = np.floor((band[:, :2] - plan.origin) / self.resolution).astype(int)
        inside = ((cells >= 0) & (cells < plan.free.shape)).all(1)
        stands = np.zeros(plan.free.shape, bool)
        stands[tuple(cells[inside].T)] = True
        ground = abs(planes.ground + TABLE_HEIGHT)
        return MapRow(
            seed=room.seed,
            voxels_right=100 * float(precision.mean()),
            low_voxels_right=100 * float(precision[low].mean()),
            surface_found=100 * float(recall.mean()),
            free_but_true=100 * float((stands & plan.free).sum() / max(stands.sum(), 1)),
            ground_mm=1000 * float(ground),
            up_degrees=float(np.degrees(np.arccos(np.clip(planes.up @ UP, -1, 1)))),
        )


@dataclass(frozen=True)
class MapRow:
    """One room; shares in percent."""

    seed: int
    voxels_right: float  # of the occupied ones: a true surface within one and a half cells
    low_voxels_right: float  # of those between the step and the robot's height
    surface_found: float  # of the true surface in voxels that were seen: an occupied one as near
    free_but_true: float  # of the cells of the floor in which something truly stands: said to be free
    ground_mm: float  # error of the floor's height
    up_degrees: float


def true_points(room: Room) -> Array:
    """(P, 3) points spread evenly over the room's true surfaces, world units, which are metres."""
    world, rng = photographed_room(room.seed, room.tier), np.random.default_rng(0)
    a, b, c = (world.vertices[world.triangles[:, corner]].astype(np.float64) for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    which = rng.choice(len(areas), int(DENSITY * areas.sum()), p=areas / areas.sum())
    u, v = rng.random((2, len(which), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a[which] + u * (b - a)[which] + v * (c - a)[which])


def _moved(points: Array, transform: Array) -> Array:
    return np.asarray(points @ transform[:3, :3].T + transform[:3, 3])


def _taken(grid: Array, cells: Array) -> Array:
    inside = ((cells >= 0) & (cells < grid.shape)).all(1)
    found = np.zeros(len(cells), bool)
    found[inside] = grid[tuple(cells[inside].T)]
    return found

"""Meshes of rooms against the room's own surfaces: error, and how much of the surface is there."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from assets.making.dataset import photographed_room
from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.geometry.mesh import Mesh, fuse
from langsplat_core.progress import TerminalProgress
from langsplat_core.scene import Scene
from tests.benchmarks.maps import true_points
from tests.benchmarks.room import InRooms, Room, publish
from tests.benchmarks.verdicts import spread

SAMPLES = 200_000  # points of a mesh
FOUND = 0.01  # metres: a true point as near to the mesh is there
TABLE, TOP = (
    0.75,
    -0.03,
)  # metres from the middle, and from the table's top upwards: what the photographs are of


@dataclass(frozen=True)
class Meshes(InRooms):
    """Error of `langsplat mesh` in rooms whose surfaces are known, by how many images must agree."""

    agreeing: tuple[int, ...] = (1, 2, 4)
    resolution: float | None = None  # metres; the default of `langsplat mesh`

    def run(self) -> None:
        with TerminalProgress() as progress:
            rows = [row for room in self.rooms(progress) for row in self._measure(room)]
        names, cells = list(vars(rows[0]))[2:], []
        for views in self.agreeing:
            chosen = [row for row in rows if row.views == views]
            cells.append(
                (str(views), *(spread(np.array([getattr(row, name) for row in chosen])) for name in names))
            )
        head = ("views", *(name.replace("_", " ") for name in names))
        publish(self, "meshes", "Meshes", markdown(head, cells), rows)

    def _measure(self, room: Room) -> "list[MeshRow]":
        scene, true = Scene(room.gaussians, cameras=tuple(room.capture.cameras)), true_points(room)
        world, rows = photographed_room(room.seed, room.tier), []
        to_truth = distances_to(world.vertices, world.triangles)
        for views in self.agreeing:
            mesh, side = fuse(scene, self.resolution, views, progress=room.progress)
            points = sampled(mesh, SAMPLES)
            off, near = 1000 * to_truth(points), _on_table(points)
            there = distances_to(mesh.vertices, mesh.triangles)(true[_on_table(true)]) <= FOUND
            middle, most = np.quantile(off[near], [0.5, 0.9])
            found, all_of_it = 100 * float(there.mean()), float(np.median(off))
            rows.append(MeshRow(room.seed, views, float(middle), float(most), found, all_of_it, 1000 * side))
        return rows


@dataclass(frozen=True)
class MeshRow:
    """One room. The table stands for it and for what stands on it."""

    seed: int
    views: int  # that must agree
    table_median_mm: float  # from the mesh to the nearest true surface
    table_ninetieth_mm: float
    table_found: float  # percent of the true surface, undersides included
    room_median_mm: float  # with floor and walls, which few photographs see and from afar
    voxel_mm: float


def _on_table(points: Array) -> Array:
    return np.asarray((np.abs(points[:, :2]).max(1) < TABLE) & (points[:, 2] > TOP))


def distances_to(vertices: Array, triangles: Array) -> Callable[[Array], Array]:
    """Distances of (P, 3) points to the nearest place of a mesh (Open3D)."""
    from open3d import core
    from open3d.t.geometry import RaycastingScene

    scene = RaycastingScene()
    scene.add_triangles(core.Tensor(vertices.astype(np.float32)), core.Tensor(triangles.astype(np.uint32)))
    return lambda points: np.asarray(
        scene.compute_distance(core.Tensor(points.astype(np.float32))).numpy(), np.float64
    )


def sampled(mesh: Mesh, count: int) -> Array:
    """(count, 3) points spread evenly over a mesh."""
    rng, areas = np.random.default_rng(0), mesh.areas()
    a, b, c = mesh.vertices[mesh.triangles[rng.choice(len(areas), count, p=areas / areas.sum())].T]
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a + u * (b - a) + v * (c - a))

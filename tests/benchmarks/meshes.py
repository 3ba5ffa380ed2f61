"""Meshes of rooms against the room's own surfaces: error, and how much of the surface is there."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.geometry.mesh import Mesh, fuse
from langsplat_core.progress import TerminalProgress
from langsplat_core.scene import Scene
from tests.benchmarks.maps import true_points
from tests.benchmarks.room import InRooms, Room, publish
from tests.benchmarks.verdicts import spread

SAMPLES = 100_000  # points of a mesh
FOUND = 0.02  # metres: a true point as near to the mesh is there


@dataclass(frozen=True)
class Meshes(InRooms):
    """Error of `langsplat mesh` in rooms whose surfaces are known, by how many images must agree."""

    agreeing: tuple[int, ...] = (1, 2, 4)

    def run(self) -> None:
        with TerminalProgress() as progress:
            rows = [row for room in self.rooms(progress) for row in self._measure(room)]
        cells = []
        for views in self.agreeing:
            chosen = [row for row in rows if row.views == views]
            names = list(vars(rows[0]))[2:]
            cells.append(
                (str(views), *(spread(np.array([getattr(row, n) for row in chosen])) for n in names))
            )
        head = tuple(name.replace("_", " ") for name in list(vars(rows[0]))[1:])
        publish(self, "meshes", "Meshes", markdown(head, cells), rows)

    def _measure(self, room: Room) -> "list[MeshRow]":
        scene, true = Scene(room.gaussians, cameras=tuple(room.capture.cameras)), true_points(room)
        nearest, rows = cKDTree(true), []
        for views in self.agreeing:
            mesh, side = fuse(scene, views=views, progress=room.progress)
            points = sampled(mesh, SAMPLES)
            off = nearest.query(points, workers=-1)[0]
            there = cKDTree(points).query(true, workers=-1)[0] <= FOUND
            middle, most = 1000 * np.quantile(off, [0.5, 0.9])
            found = 100 * float(there.mean())
            rows.append(MeshRow(room.seed, views, float(middle), float(most), found, 1000 * side))
        return rows


@dataclass(frozen=True)
class MeshRow:
    """One room."""

    seed: int
    views: int  # that must agree
    median_mm: float  # from the mesh to the nearest of the true points, which are 8 mm apart
    ninetieth_mm: float
    surface_found: float  # percent of all true surface, that which no camera sees included
    voxel_mm: float


def sampled(mesh: Mesh, count: int) -> Array:
    """(count, 3) points spread evenly over a mesh."""
    rng, areas = np.random.default_rng(0), mesh.areas()
    a, b, c = mesh.vertices[mesh.triangles[rng.choice(len(areas), count, p=areas / areas.sum())].T]
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a + u * (b - a) + v * (c - a))

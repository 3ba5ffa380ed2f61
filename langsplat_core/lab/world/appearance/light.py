"""Light that reaches the surfaces of a `World`, gathered once, so that all views see the same shadows.

A soft lamp, a sky, and one bounce between surfaces. Light is kept at the vertices and, where it changes
within a triangle, on a finer lattice of that triangle ("mesh colours", Yuksel et al. 2010). All points use
the same set of rays, so there is no noise; steps of a shadow are far below what a display shows.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.appearance.materials import mean_reflectance
from langsplat_core.lab.world.assembly import World

SKY, KEY = np.array([0.33, 0.37, 0.43]), np.array([1.50, 1.36, 1.14])  # linear light
_SECOND_BOUNCE = 0.12  # light from everywhere that the one computed bounce leaves out
_CONTRAST = 0.09  # a triangle whose corners differ by more in light gets a lattice
_FINEST = 6  # cells along a triangle's edge, at most


@dataclass(frozen=True, eq=False)
class Light:
    """A square lamp above the table, and how much sky there is."""

    position: Array  # (3,) metres
    size: float = 0.42  # side of the lamp, metres
    key: float = 1.0  # strength of the lamp
    sky: float = 1.0  # strength of the sky


@dataclass(frozen=True, eq=False)
class LightMap:
    """Four numbers per place: linear sky and bounced light (3), and the lamp's share times cosine (1).

    The lattice of a triangle with n cells per edge holds (n + 1)(n + 2) / 2 places: barycentrics
    (i / n, j / n) of the second and third corner, j the faster index.
    """

    vertices: Array  # (V, 4) float32
    lattice: Array  # (M, 4) float32
    start: Array  # (T,) int64 first row of a triangle's lattice
    cells: Array  # (T,) int32 cells per edge; 0 where the vertices suffice


class Tracer:
    """Ray queries against a world's triangles, on one thread."""

    def __init__(self, world: World) -> None:
        import open3d

        o3d: Any = open3d  # its type stubs do not know that a tensor can be made of an array alone
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene(1)
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(world.vertices)),
            self._tensor(np.ascontiguousarray(world.triangles.astype(np.uint32))),
        )

    def first_hit(self, origins: Array, directions: Array) -> tuple[Array, Array, Array, Array]:
        """(N,) distance in lengths of the direction (inf: none), triangle, (N, 2) barycentrics, normals."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        hit = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        names = ("t_hit", "primitive_ids", "primitive_uvs", "primitive_normals")
        distance, triangle, uv, normal = (hit[name].numpy() for name in names)
        return distance, triangle, uv, normal

    def blocked(self, origins: Array, directions: Array, far: float) -> Array:
        """(N,) whether anything lies between 0 and `far` along unit directions."""
        rays = np.concatenate([origins, directions], 1).astype(np.float32)
        return np.asarray(self._scene.test_occlusions(self._tensor(rays), tfar=far, nthreads=1).numpy())


def bake(tracer: Tracer, world: World, light: Light, samples: int, cell: float) -> LightMap:
    """`samples`: rays towards the lamp and again all around, per place; `cell`: spacing of the finest
    lattice in metres, 0 for vertices only."""
    lamp = _lamp_light(tracer, light, world.vertices, world.normals, samples)
    triangles = world.triangles
    corner = lamp[triangles].mean(1, keepdims=True)
    radiance = mean_reflectance(world.materials)[world.piece_of] * (
        corner * KEY * light.key + _SECOND_BOUNCE * light.sky
    )
    radiance = radiance.astype(np.float32)
    around = _gathered(tracer, light, world.vertices, world.normals, (radiance, samples))
    vertices = np.column_stack([around, lamp]).astype(np.float32)
    cells = _lattice_cells(world, vertices, cell)
    counts = (cells + 1) * (cells + 2) // 2 * (cells > 0)
    start = np.cumsum(counts) - counts
    points, normals = _lattice_points(world, cells, start, int(counts.sum()))
    fine = np.zeros((len(points), 4), np.float32)
    if len(points):
        fine[:, 3] = _lamp_light(tracer, light, points, normals, samples)
        fine[:, :3] = _gathered(tracer, light, points, normals, (radiance, samples))
    return LightMap(vertices, fine, start, cells)


def _lattice_cells(world: World, vertices: Array, cell: float) -> Array:
    """(T,) cells per edge: where light varies, as many as the longest edge needs."""
    if cell <= 0:
        return np.zeros(len(world.triangles), np.int32)
    value = (vertices @ np.array([0.3, 0.4, 0.1, 0.8], np.float32))[world.triangles]
    varies = np.ptp(value, axis=1) > _CONTRAST
    varies &= np.abs(world.vertices[world.triangles[:, 0], :2]).max(1) < 1.3  # the far walls need none
    corners = world.vertices[world.triangles]
    edge = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(1)
    cells = np.clip(np.round(edge / cell), 1, _FINEST).astype(np.int32)
    return np.where(varies & (cells > 1), cells, 0).astype(np.int32)


def _lattice_points(world: World, cells: Array, start: Array, count: int) -> tuple[Array, Array]:
    """(M, 3) points and unit normals of all lattices."""
    points, normals = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    for n in np.unique(cells[cells > 0]):
        rows = np.flatnonzero(cells == n)
        weights = [((n - i - j) / n, i / n, j / n) for i in range(n + 1) for j in range(n + 1 - i)]
        mix = np.array(weights, np.float32)
        at = (start[rows][:, None] + np.arange(len(mix))).ravel()
        corners = world.triangles[rows]
        points[at] = np.einsum("wc,tcx->twx", mix, world.vertices[corners]).reshape(-1, 3)
        normals[at] = np.einsum("wc,tcx->twx", mix, world.normals[corners]).reshape(-1, 3)
    return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def _lamp_light(tracer: Tracer, light: Light, points: Array, normals: Array, samples: int) -> Array:
    """(N,) share of the lamp seen from each point, times cosine and fall-off (1 at the table's middle)."""
    rng = np.random.default_rng(5)
    total = np.zeros(len(points), np.float32)
    # Off the surface, and where it faces the lamp a little towards it, so that places in a corner are not
    # inside a wall. A surface that faces away would be pushed into its own object: it would be black.
    inwards = light.position - points
    distance = np.linalg.norm(inwards, axis=1, keepdims=True)
    facing = np.clip((inwards / distance * normals).sum(1, keepdims=True), 0, 1)
    origins = (points + 1.5e-3 * normals + 2.5e-3 * facing * inwards / distance).astype(np.float32)
    fall_off = np.clip((light.position @ light.position) / distance[:, 0] ** 2, 0.3, 1.6)
    grid = (np.arange(samples) + rng.random(samples)) / samples
    for u, v in zip(grid, rng.permutation(grid), strict=True):
        spot = light.position + light.size * np.array([u - 0.5, v - 0.5, 0])
        towards = (spot - origins).astype(np.float32)
        length = np.linalg.norm(towards, axis=1)
        towards /= length[:, None]
        cosine = (towards * normals).sum(1)
        lit = np.flatnonzero(cosine > 0)
        blocked = tracer.blocked(origins[lit], towards[lit], float(length.max()) * 0.98)
        total[lit] += cosine[lit] * ~blocked
    return (total / samples * fall_off).astype(np.float32)


def _gathered(
    tracer: Tracer, light: Light, points: Array, normals: Array, bounce: tuple[Array, int]
) -> Array:
    """(N, 3) mean light over a cosine-weighted half space; bounce: (T, 3) radiance, number of rays."""
    radiance, samples = bounce
    rng = np.random.default_rng(6)
    total = np.zeros((len(points), 3), np.float32)
    origins = (points + 2e-3 * normals).astype(np.float32)
    sky = (SKY * light.sky).astype(np.float32)
    for z, angle in zip((np.arange(samples) + 0.5) / samples, rng.permutation(samples), strict=True):
        turn = 2 * np.pi * (angle + rng.random()) / samples
        height = 2 * z - 1
        r = np.sqrt(1 - height * height)
        # Normal plus a point of the unit sphere is cosine-distributed about the normal.
        sphere = np.array([r * np.cos(turn), r * np.sin(turn), height], np.float32)
        directions = (normals + 0.98 * sphere).astype(np.float32)
        distance, triangle, _, face = tracer.first_hit(origins, directions)
        hit = np.flatnonzero(np.isfinite(distance))
        # A back face is the inside of a solid: points beneath an object, where no light is.
        front = hit[(directions[hit] * face[hit]).sum(1) < 0]
        total[front] += radiance[triangle[front]]
        total[np.isinf(distance)] += sky
    return total / samples

"""Photographs of a `World` by ray casting: patterns, baked light, and highlights.

Only highlights depend on the view. Patterns are functions of the point in the object's own frame, so every
view agrees. Light is a soft lamp, a sky, and one bounce between surfaces, gathered once, so that all views
see the same shadows. It is kept at the vertices and, where it changes within a triangle, on a finer lattice
of that triangle ("mesh colours", Yuksel et al. 2010). All points use the same set of rays, so there is no
noise; steps of a shadow are far below what a display shows. Patterns and shading are compiled, one point at a
time: a photograph asks for about a million points, twice where there is relief.
"""

import math
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from assets.making.kit import material_table, mean_reflectance, to_display, to_linear
from assets.making.world import World
from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel
from langsplat_core.scene import Camera

_SIDE = 64  # samples along one period of the noise
SKY, KEY = np.array([0.33, 0.37, 0.43]), np.array([1.50, 1.36, 1.14])  # linear light
_SECOND_BOUNCE = 0.12  # light from everywhere that the one computed bounce leaves out
_CONTRAST = 0.09  # a triangle whose corners differ by more in light gets a lattice
_FINEST = 6  # cells along a triangle's edge, at most
_compiled = partial(kernel, fastmath=True)
_inlined = partial(helper, fastmath=True)
_STEP = 0.0015  # metres between the two points whose heights make relief


@cache
def noise_volume() -> Array:
    """Return (64, 64, 64) float32 periodic fractal noise, about standard normal."""
    rng = np.random.default_rng(20240624)
    total = np.zeros((_SIDE,) * 3)
    for sigma, weight in ((6, 1.0), (3, 0.6), (1.5, 0.4), (0.7, 0.25)):
        octave = gaussian_filter(rng.standard_normal((_SIDE,) * 3), sigma, mode="wrap")
        total += weight * octave / octave.std()
    return (total / total.std()).astype(np.float32)


@_compiled
def noise_at(volume, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear look-up; x, y, z in periods."""
    x, y, z = x * _SIDE, y * _SIDE, z * _SIDE
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - fx, y - fy, z - fz
    i, j, k = int(fx) & 63, int(fy) & 63, int(fz) & 63
    p, q, r = (i + 1) & 63, (j + 1) & 63, (k + 1) & 63
    near = (volume[i, j, k] * (1 - w) + volume[i, j, r] * w) * (1 - v)
    near += (volume[i, q, k] * (1 - w) + volume[i, q, r] * w) * v
    far = (volume[p, j, k] * (1 - w) + volume[p, j, r] * w) * (1 - v)
    far += (volume[p, q, k] * (1 - w) + volume[p, q, r] * w) * v
    return near * (1 - u) + far * u


@_compiled
def _noise_many(volume, points, out):  # type: ignore[no-untyped-def]
    for n in range(len(points)):
        out[n] = noise_at(volume, points[n, 0], points[n, 1], points[n, 2])


def noise(points: Array, period: float | tuple[float, float, float]) -> Array:
    """Return (N,) fractal noise, about standard normal, at (N, 3) points; `period` in the points' unit."""
    out = np.empty(len(points))
    _noise_many(noise_volume(), np.ascontiguousarray(points / np.asarray(period)), out)
    return out


@_compiled
def _fraction(value):  # type: ignore[no-untyped-def]
    return value - math.floor(value)


@_compiled
def _scatter(value):  # type: ignore[no-untyped-def]
    """Return a number in [0, 1) that looks random for every whole `value`."""
    return _fraction(math.sin(value * 12.9898) * 43758.5453)


@_compiled
def _wood(v, x, y, z):  # type: ignore[no-untyped-def]
    """Growth rings about an axis far below the board, and fine pores along the grain (x)."""
    bend = noise_at(v, x / 1.3, y / 0.5, z / 0.5)
    ring = _fraction(math.hypot(y + 0.11, z + 0.5) * 62 + 0.9 * bend)
    band = ring * ring * min(1.0, (1 - ring) * 6)
    pores = noise_at(v, x / 1.1, y / 0.05, z / 0.05)
    return 0.75 * band + 0.13 * pores + 0.2 * bend + 0.1


@_compiled
def _planks(v, x, y, z):  # type: ignore[no-untyped-def]
    row = math.floor(y / 0.14)
    shifted = x + 1.3 * _scatter(row)
    column = math.floor(shifted / 0.95)
    side = abs(_fraction(y / 0.14) - 0.5)
    end = abs(_fraction(shifted / 0.95) - 0.5)
    own = _scatter(row * 7 + column * 3.7)
    if side > 0.482 or end > 0.4972:
        return 2.4
    return 0.9 * own - 0.2 + 0.6 * _wood(v, x + 5 * own, (y - row * 0.14) * 0.8 + own, own)


@_compiled
def _tiles(v, x, y, z):  # type: ignore[no-untyped-def]
    joint = max(abs(_fraction(x / 0.3) - 0.5), abs(_fraction(y / 0.3) - 0.5)) > 0.487
    own = _scatter(math.floor(x / 0.3) + 31 * math.floor(y / 0.3))
    return 1.9 if joint else 0.5 * own - 0.1 + 0.28 * noise_at(v, x / 0.55, y / 0.55, own)


@_compiled
def _cloth(v, x, y, z):  # type: ignore[no-untyped-def]
    a, b, c = math.sin(x * 1300), math.sin(y * 1300), math.sin(z * 1300)
    fibres = noise_at(v, x / 0.045, y / 0.045, z / 0.045)
    broad = noise_at(v, x / 0.17, y / 0.17, z / 0.17)
    return 0.45 + 0.05 * (a * b + b * c + c * a) + 0.15 * fibres + 0.16 * broad


@_compiled
def _rug(v, x, y, z):  # type: ignore[no-untyped-def]
    inside = max(abs(x) / 1.15, abs(y) / 0.95)
    a, b = x / 0.3, y / 0.3
    lattice = abs(a - math.floor(a + 0.5)) + abs(b - math.floor(b + 0.5))
    drawn = (0.82 < inside < 0.9) or (inside < 0.78 and 0.38 < lattice < 0.48)
    pile = 0.09 * noise_at(v, x / 0.06, y / 0.06, z / 0.06) + 0.1 * math.sin(x * 500) * math.sin(y * 500)
    return (0.9 if drawn else 0.05) + pile


@_compiled
def _painting(v, x, y, z):  # type: ignore[no-untyped-def]
    hills = 0.25 + 0.06 * noise_at(v, x / 1.3, 0.0, 0.23)
    front = 0.13 + 0.05 * noise_at(v, x / 0.9, 0.4, 0.71)
    sun = math.hypot(x - 0.12, z - 0.38) < 0.055
    strokes = 0.22 * noise_at(v, x / 0.35, y, z / 0.16)
    return (1.0 if (z < hills) != sun else 0.0) - (0.45 if z < front else 0.0) + strokes


@_compiled
def _small(kind, v, x, y, z):  # type: ignore[no-untyped-def]  # noqa: PLR0911  one row of a table each
    """Return the patterns of one line each."""
    if kind == 5:  # metal: brushed
        return 0.4 + 0.4 * noise_at(v, x / 0.02, y / 0.02, z / 0.5) + 0.1 * noise_at(v, x / 0.3, y / 0.3, z)
    if kind == 1:  # speckled
        spot = noise_at(v, x / 0.05, y / 0.05, z / 0.05)
        return 1.0 if spot > 1.45 else 0.1 * noise_at(v, x / 0.3, y / 0.3, z / 0.3)
    if kind == 14:  # peel
        pores = noise_at(v, x / 0.05, y / 0.05, z / 0.05)
        return 0.3 * pores + 0.25 * noise_at(v, x / 0.25, y / 0.25, z / 0.25)
    if kind == 6:  # pages
        return (0.8 if math.sin(z * 1900 + y * 500) > 0.5 else 0.0) + 0.1 * noise_at(v, x / 0.1, y / 0.1, z)
    if kind == 9:  # leaf
        return 0.5 + 0.5 * noise_at(v, x / 0.07, y / 0.07, z / 0.07)
    if kind == 10:  # striped
        return 1.1 if _fraction(y / 0.022) > 0.72 else 0.2 * noise_at(v, x / 0.1, y / 0.1, z / 0.1)
    if kind == 8:  # plaster
        return (
            0.4 + 0.08 * noise_at(v, x / 0.16, y / 0.16, z / 0.16) + 0.14 * noise_at(v, x / 2.9, y / 2.3, z)
        )
    a, b, c = x / 0.034, y / 0.034, z / 0.034
    a, b, c = a - math.floor(a + 0.5), b - math.floor(b + 0.5), c - math.floor(c + 0.5)
    return 1.0 if a * a + b * b + c * c < 0.09 else 0.0  # dotted


@_compiled
def weight_at(kind, v, x, y, z):  # type: ignore[no-untyped-def]  # noqa: PLR0911  a table in effect
    """Weight of a material's second colour at a point, metres; `kind`: row of TEXTURES; `v`: the noise."""
    if kind == 0:
        return 0.16 * noise_at(v, x / 0.25, y / 0.25, z / 0.25)
    if kind == 2:
        return _wood(v, x, y, z)
    if kind == 3:
        return _planks(v, x, y, z)
    if kind == 4:
        return _cloth(v, x, y, z)
    if kind == 7:
        return _tiles(v, x, y, z)
    if kind == 12:
        return _rug(v, x, y, z)
    if kind == 13:
        return _painting(v, x, y, z)
    return _small(kind, v, x, y, z)


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
        """Return (N,) distance in lengths of the direction (inf: none), triangle, barycentrics, normals."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        hit = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        names = ("t_hit", "primitive_ids", "primitive_uvs", "primitive_normals")
        distance, triangle, uv, normal = (hit[name].numpy() for name in names)
        return distance, triangle, uv, normal

    def blocked(self, origins: Array, directions: Array, far: float) -> Array:
        """Return (N,) whether anything lies between 0 and `far` along unit directions."""
        rays = np.concatenate([origins, directions], 1).astype(np.float32)
        return np.asarray(self._scene.test_occlusions(self._tensor(rays), tfar=far, nthreads=1).numpy())


def bake(tracer: Tracer, world: World, light: Light, samples: int, cell: float) -> LightMap:
    """Gather the light of every place.

    samples: rays towards the lamp and again all around, per place; cell: spacing of the finest lattice in
    metres, 0 for vertices only.
    """
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
    """Return (T,) cells per edge: where light varies, as many as the longest edge needs."""
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
    """Return (M, 3) points and unit normals of all lattices."""
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
    """Return (N,) share of the lamp seen, times cosine and fall-off (1 at the table's middle)."""
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
    """Return (N, 3) mean light over a cosine-weighted half space; bounce: (T, 3) radiance, number of rays."""
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


class Surfaces(NamedTuple):
    """Everything shading reads, in the form the compiled code takes."""

    triangles: Array  # (T, 3) int32
    piece_of: Array  # (T,) int32
    points: Array  # (V, 9) float32: world point, unit normal, point in the object's frame
    light: Array  # (V, 4) float32, see LightMap
    lattice: Array  # (M, 4) float32
    start: Array  # (T,) int64
    cells: Array  # (T,) int32
    kinds: Array  # (P,) int32 pattern
    table: Array  # (P, 12) float32, see material_table
    frames: Array  # (P, 3, 3) float32 object to world
    volume: Array  # noise
    linear: Array  # (1024,) float32: sRGB values to linear light
    lamp: Array  # (2, 3) float32: position; colour
    sky: Array  # (3,) float32


def surfaces(world: World, light: Light, baked: LightMap) -> Surfaces:
    """Return a world and its light, as arrays."""
    kinds, table = material_table(world.materials)
    points = np.concatenate([world.vertices, world.normals, world.local], 1).astype(np.float32)
    lamp = np.stack([light.position, KEY * light.key]).astype(np.float32)
    return Surfaces(
        world.triangles, world.piece_of, points, baked.vertices, baked.lattice, baked.start, baked.cells,
        kinds, table, world.frames.astype(np.float32), noise_volume(),
        to_linear(np.linspace(0, 1, 1024)).astype(np.float32), lamp, (SKY * light.sky).astype(np.float32),
    )  # fmt: skip


@_inlined
def _lattice_light(s, triangle, n, u, v, light):  # type: ignore[no-untyped-def]
    """Light between the three nearest places of a triangle's lattice."""
    x, y = min(u * n, n - 1e-4), min(v * n, n - 1e-4)
    i, j = int(x), int(y)
    if i + j >= n:  # on the long edge, by rounding
        i -= 1
    i = max(i, 0)
    fx, fy = x - i, y - j
    row = s.start[triangle] + i * (n + 1) - i * (i - 1) // 2 + j
    above = row + n + 1 - i  # the same j, one i further
    for c in range(4):
        if fx + fy <= 1 or i + j + 2 > n:
            value = (1 - fx - fy) * s.lattice[row, c] + fx * s.lattice[above, c] + fy * s.lattice[row + 1, c]
        else:
            value = (fx + fy - 1) * s.lattice[above + 1, c]
            value += (1 - fy) * s.lattice[above, c] + (1 - fx) * s.lattice[row + 1, c]
        light[c] = max(value, 0.0)


@_inlined
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    scale = 1 / math.sqrt(max(x * x + y * y + z * z, 1e-20))
    return x * scale, y * scale, z * scale


@_inlined
def _relief(s, piece, weight, q, n):  # type: ignore[no-untyped-def]
    """Factor on the lamp's light: the pattern's dark parts are low, slopes towards the lamp are brighter."""
    strength = s.table[piece, 10]
    if strength == 0:
        return 1.0
    ax, ay, az = s.lamp[0, 0] - q[0], s.lamp[0, 1] - q[1], s.lamp[0, 2] - q[2]
    along = ax * n[0] + ay * n[1] + az * n[2]
    ax, ay, az = _unit(ax - along * n[0], ay - along * n[1], az - along * n[2])
    f = s.frames
    x = q[6] + _STEP * (f[piece, 0, 0] * ax + f[piece, 1, 0] * ay + f[piece, 2, 0] * az)
    y = q[7] + _STEP * (f[piece, 0, 1] * ax + f[piece, 1, 1] * ay + f[piece, 2, 1] * az)
    z = q[8] + _STEP * (f[piece, 0, 2] * ax + f[piece, 1, 2] * ay + f[piece, 2, 2] * az)
    rise = weight - weight_at(s.kinds[piece], s.volume, x, y, z)
    return min(max(1 - strength * rise, 0.55), 1.35)


@_inlined
def _highlight(s, piece, q, n, eye, light):  # type: ignore[no-untyped-def]
    """Reflected lamp and reflected sky, as factors: (lamp, sky). Schlick's and Blinn's formulas."""
    mirror, sharp = s.table[piece, 6], s.table[piece, 7]
    vx, vy, vz = _unit(eye[0] - q[0], eye[1] - q[1], eye[2] - q[2])
    lx, ly, lz = _unit(s.lamp[0, 0] - q[0], s.lamp[0, 1] - q[1], s.lamp[0, 2] - q[2])
    hx, hy, hz = _unit(vx + lx, vy + ly, vz + lz)
    facing = vx * n[0] + vy * n[1] + vz * n[2]
    missing = 1 - min(max(facing, 0.0), 1.0)
    grazing = missing * missing * missing * missing * missing
    share = mirror + (0.3 - 0.3 * mirror) * grazing * min(sharp / 150, 1.0) * min(mirror * 30, 1.0)
    cosine = max(hx * n[0] + hy * n[1] + hz * n[2], 1e-6)
    shine = math.exp(sharp * math.log(cosine)) * (sharp + 8) / 25.13 * min(light[3] * 3, 1.0)
    up = 2 * facing * n[2] - vz  # of the reflected direction
    open_sky = min(max((up + 0.25) / 0.9, 0.0), 1.0) * min((light[0] + light[1] + light[2]) * 0.8, 1.0)
    return mirror * min(shine, 4.0), share * (0.2 + 0.8 * open_sky)


@_compiled
def shade(s, triangle, uv, eye, out):  # type: ignore[no-untyped-def]
    """Fill `out` (N, 3) with linear light towards `eye` (3,) from points on triangles; -1: nothing, 0."""
    q, n, light = np.empty(9, np.float32), np.empty(3, np.float32), np.empty(4, np.float32)
    for k in range(len(triangle)):
        t = triangle[k]
        if t < 0:
            out[k] = 0
            continue
        u, v = uv[k, 0], uv[k, 1]
        a, b, c = s.triangles[t, 0], s.triangles[t, 1], s.triangles[t, 2]
        piece = s.piece_of[t]
        for i in range(9):
            q[i] = (1 - u - v) * s.points[a, i] + u * s.points[b, i] + v * s.points[c, i]
        n[0], n[1], n[2] = _unit(q[3], q[4], q[5])
        if s.cells[t] > 0:
            _lattice_light(s, t, s.cells[t], u, v, light)
        else:
            for i in range(4):
                light[i] = (1 - u - v) * s.light[a, i] + u * s.light[b, i] + v * s.light[c, i]
        weight = weight_at(s.kinds[piece], s.volume, q[6], q[7], q[8])
        relief = _relief(s, piece, weight, q, n)
        weight = min(max(weight, -0.4), 1.6)
        lamp, sky = 0.0, 0.0
        if s.table[piece, 6] > 0:
            lamp, sky = _highlight(s, piece, q, n, eye, light)
        for i in range(3):
            first = s.table[piece, i]
            shown = min(max(first + weight * (s.table[piece, 3 + i] - first), 0.0), 1.0)
            colour = s.linear[int(shown * 1023 + 0.5)]
            falling = relief * light[3] * s.lamp[1, i] + (0.5 + 0.5 * relief) * light[i]
            tint = 1 + s.table[piece, 9] * (colour - 1)
            shine = lamp * s.lamp[1, i] + sky * s.sky[i]
            out[k, i] = colour * s.table[piece, 8] * falling + tint * shine


@dataclass(frozen=True, eq=False)
class RenderedView:
    """The image that one camera takes of a drawn room, and what lies at each pixel."""

    image: Array  # (H, W, 3) uint8 sRGB
    pieces: Array  # (H, W) int32 row of `World.ids` at each pixel's centre, -1 where no surface is
    depth: Array  # (H, W) float32 metres along the camera's z axis, inf where no surface is


class Renderer:
    """Holds the ray tracer and the light that reaches every surface."""

    def __init__(self, world: World, light: Light, samples: int = 32, cell: float = 0.0) -> None:
        """Bake the light; `samples` and `cell` as of `bake`."""
        self._world = world
        self._tracer = Tracer(world)
        self._surfaces = surfaces(world, light, bake(self._tracer, world, light, samples, cell))

    def render(self, camera: Camera, oversample: int = 2) -> RenderedView:
        """Render a view with `oversample` rays per pixel and axis; labels are those of pixel centres."""
        fine = camera.resized(camera.width * oversample, camera.height * oversample)
        triangle, uv, depth = self._cast(fine)
        linear = self._shade(triangle, uv, camera.position)
        blocks = linear.reshape(camera.height, oversample, camera.width, oversample, 3).mean((1, 3))
        image = _developed(blocks)
        if oversample > 1:
            triangle, _, depth = self._cast(camera)
        pieces = np.where(triangle >= 0, self._world.piece_of[triangle], -1).astype(np.int32)
        shape = (camera.height, camera.width)
        return RenderedView(image, pieces.reshape(shape), depth.reshape(shape))

    def _cast(self, camera: Camera) -> tuple[Array, Array, Array]:
        """First surface at pixel centres: (H*W,) triangle or -1, (H*W, 2) barycentrics, (H*W,) depth."""
        origin, directions = _rays(camera)
        depth, triangle, uv, _ = self._tracer.first_hit(origin, directions)
        return np.where(np.isfinite(depth), triangle.astype(np.int64), -1), uv, depth

    def colours_at(self, triangle: Array, uv: Array, eye: Array) -> Array:
        """Return (N, 3) uint8 colours as seen from `eye`, given by triangle and barycentrics."""
        return _developed(self._shade(triangle, uv, eye))

    def _shade(self, triangle: Array, uv: Array, eye: Array) -> Array:
        """Return (N, 3) linear light leaving points towards `eye` (3,)."""
        out = np.empty((len(triangle), 3), np.float32)
        shade(self._surfaces, triangle, uv.astype(np.float32), eye.astype(np.float32), out)
        return out


def _developed(linear: Array) -> Array:
    """Linear light -> uint8 sRGB. A soft shoulder, so that highlights do not clip."""
    soft = np.where(linear < 0.65, linear, 0.65 + 0.35 * np.tanh((linear - 0.65) / 0.55))
    return np.asarray((to_display(soft) * 255 + 0.5).astype(np.uint8))


def _rays(camera: Camera) -> tuple[Array, Array]:
    """Origin (3,) and (H*W, 3) directions through the pixel centres; length 1 along the camera's z axis."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    r = camera.rotation
    across, down = x[:, None] * r[0], y[:, None] * r[1] + r[2]
    return camera.position, (down[:, None] + across[None]).reshape(-1, 3)

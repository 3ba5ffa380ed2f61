"""Light leaving surface points, compiled: pattern, relief, baked light, a weak highlight."""

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel
from langsplat_core.lab.world.appearance.colours import to_linear
from langsplat_core.lab.world.appearance.light import KEY, SKY, Light, LightMap
from langsplat_core.lab.world.appearance.materials import material_table
from langsplat_core.lab.world.appearance.textures import noise_volume, weight_at
from langsplat_core.lab.world.assembly import World

_compiled = partial(kernel, fastmath=True)
_inlined = partial(helper, fastmath=True)
_STEP = 0.0015  # metres between the two points whose heights make relief


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
    """A world and its light, as arrays."""
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

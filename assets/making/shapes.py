"""Triangle meshes of simple solids, as plain arrays. Lengths in metres, z points up.

Every builder returns a `TriMesh` whose triangles face outwards (counter-clockwise seen from outside).
"""

import itertools
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array

Point = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class TriMesh:
    """Vertices and triangles of one surface."""

    vertices: Array  # (V, 3) float64, metres
    triangles: Array  # (T, 3) int64 rows of `vertices`
    normals: Array  # (V, 3) float64, outward, unit length

    def moved(self, offset: tuple[float, float, float] | Array) -> "TriMesh":
        """Return the mesh shifted by `offset` (3,) metres."""
        return TriMesh(self.vertices + np.asarray(offset, np.float64), self.triangles, self.normals)

    def turned(self, rotation: Array) -> "TriMesh":
        """Return the mesh turned about the origin by a (3, 3) rotation."""
        return TriMesh(self.vertices @ rotation.T, self.triangles, self.normals @ rotation.T)

    def spun(self, axis: str, degrees: float) -> "TriMesh":
        """Return the mesh turned about a coordinate axis, right-handed."""
        return self.turned(rotation_about(axis, degrees))

    def stretched(self, factors: tuple[float, float, float]) -> "TriMesh":
        """Return the mesh scaled per axis by positive `factors`."""
        normals = self.normals / np.asarray(factors)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return TriMesh(self.vertices * np.asarray(factors), self.triangles, normals)


def rotation_about(axis: str, degrees: float) -> Array:
    """(3, 3) rotation about the named coordinate axis, right-handed."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def _grid_triangles(rows: int, columns: int) -> Array:
    """Two triangles per cell of a (rows, columns) lattice of vertices in row-major order."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + columns, corner + columns + 1
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def _vertex_normals(vertices: Array, triangles: Array) -> Array:
    """Area-weighted vertex normals, unit length."""
    p = vertices[triangles]
    face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    total = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, triangles[:, corner], face)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-15)


def sheet(width: float, height: float, cell: float) -> TriMesh:
    """Return a rectangle in the plane z = 0, centred, facing +z, in cells of about `cell` metres."""
    nx, ny = max(int(np.ceil(width / cell)), 1) + 1, max(int(np.ceil(height / cell)), 1) + 1
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, nx), np.linspace(-height / 2, height / 2, ny))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(nx * ny)], 1)
    return TriMesh(vertices, _grid_triangles(ny, nx), np.tile([0.0, 0.0, 1.0], (nx * ny, 1)))


def join(meshes: list[TriMesh]) -> TriMesh:
    """Several surfaces as one."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return TriMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + o for mesh, o in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
    )


def box(width: float, depth: float, height: float, cell: float = 0.02) -> TriMesh:
    """Return a cuboid along x, y, z standing on z = 0, centred in x and y."""
    w, d, h = width, depth, height
    sides = []
    for (a, b, distance), turn in (
        ((w, d, h / 2), np.eye(3)),
        ((w, d, h / 2), rotation_about("x", 180)),
        ((w, h, d / 2), rotation_about("x", 90)),
        ((w, h, d / 2), rotation_about("x", -90)),
        ((h, d, w / 2), rotation_about("y", 90)),
        ((h, d, w / 2), rotation_about("y", -90)),
    ):
        sides.append(sheet(a, b, cell).moved((0, 0, distance)).turned(turn))
    return join(sides).moved((0, 0, h / 2))


def lathe(profile: list[tuple[float, float]], around: int = 32, cell: float = 0.01) -> TriMesh:
    """Return a surface of revolution about z through (radius, z) points, listed from bottom to top.

    Going up with positive radius the surface faces outwards; going down it faces the axis (a vessel's
    inside). Points closer than `cell` are left as they are, longer stretches are subdivided.
    """
    fine: list[tuple[float, float]] = [profile[0]]
    for (r0, z0), (r1, z1) in itertools.pairwise(profile):
        count = max(int(np.ceil(np.hypot(r1 - r0, z1 - z0) / cell)), 1)
        fine += [(r0 + (r1 - r0) * i / count, z0 + (z1 - z0) * i / count) for i in range(1, count + 1)]
    line = np.array(fine)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    r, z = line[:, :1], line[:, 1:]
    vertices = np.stack([r * np.cos(angle), r * np.sin(angle), z + 0 * angle], -1)
    tangent = np.gradient(line, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    out, up = tangent[:, 1:], -tangent[:, :1]  # the tangent turned by -90 degrees
    normals = np.stack([out * np.cos(angle), out * np.sin(angle), up + 0 * angle], -1)
    return TriMesh(vertices.reshape(-1, 3), _grid_triangles(len(line), around + 1), normals.reshape(-1, 3))


def ball(radius: float, around: int = 28) -> TriMesh:
    """Return a sphere centred at the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, around // 2 + 1)
    profile = [(radius * max(float(np.cos(a)), 0.0), radius * float(np.sin(a))) for a in angle]
    mesh = lathe(profile, around, cell=1.0)
    return TriMesh(mesh.vertices, mesh.triangles, mesh.vertices / radius)


def cylinder(radius: float, height: float, around: int = 28, cell: float = 0.015) -> TriMesh:
    """Return a closed cylinder standing on z = 0; its edges are sharp."""
    top = lathe([(radius, height), (0.0, height)], around, cell)
    side = lathe([(radius, 0.0), (radius, height)], around, cell)
    bottom = lathe([(0.0, 0.0), (radius, 0.0)], around, cell)
    return join([bottom, side, top])


def tube(path: Array, radius: float | Array, around: int = 12) -> TriMesh:
    """Return a pipe along `path` (N, 3) with one radius or (N,) radii; closed when the radii end at zero."""
    path = np.asarray(path, np.float64)
    radii = np.broadcast_to(np.asarray(radius, np.float64), (len(path),))
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent[0], np.eye(3)[int(np.argmin(np.abs(tangent[0])))])
    rings = []
    angle = np.linspace(0, 2 * np.pi, around + 1)
    for point, direction, r in zip(path, tangent, radii, strict=True):
        side = side - direction * (side @ direction)  # parallel transport: the frame does not twist
        side /= np.linalg.norm(side)
        other = np.cross(direction, side)
        rings.append(point + r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other))
    vertices = np.concatenate(rings)
    triangles = _grid_triangles(len(path), around + 1)
    return TriMesh(vertices, triangles, _vertex_normals(vertices, triangles))


def arc(centre: tuple[float, float], radius: float, start: float, stop: float, count: int = 14) -> Array:
    """(count, 3) points of an arc in the x-z plane; angles in degrees from +x towards +z."""
    angle = np.radians(np.linspace(start, stop, count))
    return np.stack(
        [centre[0] + radius * np.cos(angle), np.zeros(count), centre[1] + radius * np.sin(angle)], 1
    )


def slab(outline: list[tuple[float, float]], thickness: float, cell: float = 0.02) -> TriMesh:
    """Return a convex polygon (counter-clockwise, x and z) extruded along y by `thickness`, centred in y."""
    points = np.array(outline)
    n = len(points)
    fan = np.array([[0, i, i + 1] for i in range(1, n - 1)])
    front = np.stack([points[:, 0], np.full(n, -thickness / 2), points[:, 1]], 1)
    back = front + (0, thickness, 0)
    faces = [
        TriMesh(front, fan, np.tile([0.0, -1.0, 0.0], (n, 1))),
        TriMesh(back, fan[:, ::-1], np.tile([0.0, 1.0, 0.0], (n, 1))),
    ]
    for i in range(n):
        j = (i + 1) % n
        vertices = np.stack([front[i], front[j], back[j], back[i]])
        triangles = np.array([[0, 2, 1], [0, 3, 2]])
        faces.append(TriMesh(vertices, triangles, _vertex_normals(vertices, triangles)))
    return _refined(join(faces), cell)


def _refined(mesh: TriMesh, cell: float) -> TriMesh:
    """Cut flat faces into triangles with edges of at most `cell`, since light is kept per vertex."""
    corners, normals = mesh.vertices[mesh.triangles], mesh.normals[mesh.triangles]
    while True:
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        longest = edges.argmax(1)
        split = edges.max(1) > cell
        if not split.any():
            break
        turn = (longest[split, None] + np.arange(3)) % 3  # the longest edge first
        a, b, c = np.moveaxis(np.take_along_axis(corners[split], turn[..., None], 1), 1, 0)
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)]
        corners = np.concatenate([corners[~split], *halves])
        normals = np.concatenate([normals[~split], normals[split], normals[split]])
    count = len(corners)
    return TriMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), normals.reshape(-1, 3))


def rod(
    start: Point | Array, stop: Point | Array, radius: float, end: float = 0.0, around: int = 14
) -> TriMesh:
    """Return a straight limb with round ends; `end`: radius at `stop`, 0 for the same."""
    a, b = np.asarray(start, np.float64), np.asarray(stop, np.float64)
    last = end or radius
    axis = (b - a) / np.linalg.norm(b - a)
    bend = np.radians(np.array([90.0, 80, 60, 35, 0]))
    heads = [a - axis * radius * s for s in np.sin(bend)] + [b + axis * last * s for s in np.sin(bend[::-1])]
    radii = [radius * c + 1e-6 for c in np.cos(bend)] + [last * c + 1e-6 for c in np.cos(bend[::-1])]
    mesh = tube(np.stack(heads), np.array(radii), around)
    # About the nearer end's centre: means of faces of unequal size would make the side lean.
    centre = np.where((np.arange(len(heads)) < 5)[:, None], a, b).repeat(around + 1, axis=0)
    normals = mesh.vertices - centre
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return TriMesh(mesh.vertices, mesh.triangles, normals)


def ring(radius: float, thick: float, around: int = 32, sides: int = 14) -> TriMesh:
    """Return a torus in the plane z = 0: `radius` of its centre line, `thick` of its tube."""
    turn = np.linspace(-np.pi, np.pi, sides + 1)
    line = [(radius + thick * float(np.cos(t)), thick * float(np.sin(t))) for t in turn]
    mesh = lathe(line, around, cell=1.0)
    flat = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1])[:, None]
    centre = mesh.vertices * (1, 1, 0) * (radius / flat)
    return TriMesh(mesh.vertices, mesh.triangles, (mesh.vertices - centre) / thick)


def cone(radius: float, height: float, top: float = 0.0, around: int = 28) -> TriMesh:
    """Return a closed (cut) cone standing on z = 0."""
    cap = [lathe([(top, height), (0.0, height)], around, 0.02)] if top > 0 else []
    side = lathe([(radius, 0.0), (top, height)], around, 0.02)
    return join([lathe([(0.0, 0.0), (radius, 0.0)], around, 0.02), side, *cap])


def pillow(width: float, depth: float, height: float, power: float = 5.0, around: int = 32) -> TriMesh:
    """Return a box with rounded edges standing on z = 0; `power` 2 is an ellipsoid, 8 nearly a box.

    A superellipsoid |x|^p + |y|^p + |z|^p = 1, stretched (Barr 1981).
    """
    unit = ball(1.0, around).vertices
    point = unit / (np.abs(unit) ** power).sum(1, keepdims=True) ** (1 / power)
    half = np.array([width, depth, height]) / 2
    normals = np.sign(point) * np.abs(point) ** (power - 1) / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = ball(1.0, around).triangles
    return TriMesh(point * half + (0, 0, half[2]), triangles, normals)


def plate_of(outline: Array, thickness: float, centre: tuple[float, float] = (0.0, 0.0)) -> TriMesh:
    """Return a board lying on z = 0 with a star-shaped outline.

    outline: (N, 2) x and y, counter-clockwise, every point visible from `centre`. Corners of more than
    40 degrees stay sharp, the others are smooth.
    """
    points = np.asarray(outline, np.float64)
    n = len(points)
    after = np.roll(np.arange(n), -1)
    rim = np.concatenate([points, [centre]])
    fan = np.stack([np.full(n, n), np.arange(n), after], 1)
    top = np.column_stack([rim, np.full(n + 1, thickness)])
    up = np.tile([0.0, 0.0, 1.0], (n + 1, 1))
    faces = [TriMesh(top, fan, up), TriMesh(top - (0, 0, thickness), fan[:, ::-1], -up)]
    edge = points[after] - points
    out = np.stack([edge[:, 1], -edge[:, 0]], 1) / np.linalg.norm(edge, axis=1, keepdims=True)
    for i in range(n):
        j, before = after[i], i - 1
        first = out[i] + out[before] if out[i] @ out[before] > 0.77 else out[i]
        second = out[i] + out[j] if out[i] @ out[j] > 0.77 else out[i]
        side = np.stack([points[i], points[j], points[j], points[i]])
        corners = np.column_stack([side, [0, 0, thickness, thickness]])
        lean = np.column_stack([np.stack([first, second, second, first]), np.zeros(4)])
        lean /= np.linalg.norm(lean, axis=1, keepdims=True)
        faces.append(TriMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), lean))
    return join(faces)


def smooth_outline(points: list[tuple[float, float]], count: int = 48) -> Array:
    """(count, 2) closed Catmull-Rom curve through points, in their order."""
    knots = np.array(points, np.float64)
    n = len(knots)
    place = np.arange(count) * n / count
    k, t = place.astype(int), (place % 1)[:, None]
    a, b, c, d = (knots[(k + shift) % n] for shift in (-1, 0, 1, 2))
    square, cube = 2 * a - 5 * b + 4 * c - d, 3 * b - a - 3 * c + d
    curve: Array = 0.5 * (2 * b + (c - a) * t + square * t**2 + cube * t**3)
    return curve

"""More solids: rods, rings, cones, rounded boxes, cut-out boards. Metres, z up, triangles face outwards."""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.geometry.shapes import Mesh, ball, join, lathe, tube

Point = tuple[float, float, float]


def rod(start: Point | Array, stop: Point | Array, radius: float, end: float = 0.0, around: int = 14) -> Mesh:
    """A straight limb with round ends from one point to another; `end`: radius at `stop`, 0 for the same."""
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
    return Mesh(mesh.vertices, mesh.triangles, normals)


def ring(radius: float, thick: float, around: int = 32, sides: int = 14) -> Mesh:
    """A torus in the plane z = 0: `radius` of its centre line, `thick` of its tube."""
    turn = np.linspace(-np.pi, np.pi, sides + 1)
    line = [(radius + thick * float(np.cos(t)), thick * float(np.sin(t))) for t in turn]
    mesh = lathe(line, around, cell=1.0)
    flat = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1])[:, None]
    centre = mesh.vertices * (1, 1, 0) * (radius / flat)
    return Mesh(mesh.vertices, mesh.triangles, (mesh.vertices - centre) / thick)


def cone(radius: float, height: float, top: float = 0.0, around: int = 28) -> Mesh:
    """A closed (cut) cone standing on z = 0."""
    cap = [lathe([(top, height), (0.0, height)], around, 0.02)] if top > 0 else []
    side = lathe([(radius, 0.0), (top, height)], around, 0.02)
    return join([lathe([(0.0, 0.0), (radius, 0.0)], around, 0.02), side, *cap])


def pillow(width: float, depth: float, height: float, power: float = 5.0, around: int = 32) -> Mesh:
    """A box with rounded edges standing on z = 0; `power` 2 is an ellipsoid, 8 nearly a box.

    A superellipsoid |x|^p + |y|^p + |z|^p = 1, stretched (Barr 1981).
    """
    unit = ball(1.0, around).vertices
    point = unit / (np.abs(unit) ** power).sum(1, keepdims=True) ** (1 / power)
    half = np.array([width, depth, height]) / 2
    normals = np.sign(point) * np.abs(point) ** (power - 1) / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = ball(1.0, around).triangles
    return Mesh(point * half + (0, 0, half[2]), triangles, normals)


def plate_of(outline: Array, thickness: float, centre: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    """A board lying on z = 0 with a star-shaped outline.

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
    faces = [Mesh(top, fan, up), Mesh(top - (0, 0, thickness), fan[:, ::-1], -up)]
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
        faces.append(Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), lean))
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

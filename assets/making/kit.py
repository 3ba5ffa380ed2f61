"""What builders work with: solids, colours and their words, materials, labelled pieces, and a kit.

Solids are plain arrays; lengths in metres, z points up. Every builder of one returns a `TriMesh` whose
triangles face outwards (counterclockwise seen from outside). Colour words are judged in CIE LCh (lightness,
chroma, hue of CIE L*a*b*, D65). The borders follow where English speakers change words in naming experiments
(Berlin and Kay's eleven basic terms, beige and turquoise added); near a border a colour has no certain word,
and `colour_word` then answers None.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Literal, TypeVar, get_args

import numpy as np

from langsplat_core.arrays import Array, linear_light

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
    """Return (3, 3) rotation about the named coordinate axis, right-handed."""
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


def slab(outline: list[tuple[float, float]], thickness: float) -> TriMesh:
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
    return _refined(join(faces), 0.02)


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


# Colours, materials and pieces.

Texture = Literal[
    "plain", "speckled", "wood", "planks", "cloth", "metal", "pages", "tiles", "plaster", "leaf", "striped",
    "dotted", "rug", "painting", "peel",
]  # fmt: skip
TEXTURES = get_args(Texture)

# Decides highlight, relief and fine mottling.
Substance = Literal[
    "plastic", "ceramic", "glass", "metal", "wood", "cloth", "paper", "plaster", "leaf", "skin", "rubber",
    "wax",
]  # fmt: skip
Word = TypeVar("Word", bound=str)
COLOUR_SYNONYMS = {
    "gray": ("gray", "grey"),
    "turquoise": ("turquoise", "cyan"),
    "beige": ("beige", "tan"),
    "purple": ("purple", "violet"),
}
_WHITE = np.array([0.95047, 1.0, 1.08883])
_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
# word -> (lightness from, to, chroma from, to, hue from, to in degrees); hues may run past 360
_BOXES: dict[str, tuple[float, float, float, float, float, float]] = {
    "red": (28, 56, 52, 120, 16, 44),
    "orange": (58, 80, 56, 120, 52, 74),
    "yellow": (72, 97, 54, 120, 82, 104),
    "green": (28, 85, 28, 120, 118, 166),
    "turquoise": (52, 88, 24, 80, 182, 220),
    "blue": (20, 64, 30, 130, 254, 298),
    "purple": (20, 56, 32, 120, 307, 334),
    "pink": (66, 86, 24, 70, -14, 18),
    "brown": (20, 46, 18, 44, 44, 76),
    "beige": (72, 88, 12, 26, 70, 94),
    "black": (2, 17, 0, 5, 0, 360),
    "gray": (36, 68, 0, 5, 0, 360),
    "white": (90, 99, 0, 5, 0, 360),
}
COLOURS = tuple(_BOXES)


def to_linear(display: Array) -> Array:
    """Return linear light of sRGB display values in [0, 1]."""
    return linear_light(np.asarray(display, np.float64))


def to_display(linear: Array) -> Array:
    """Linear light (clipped to [0, 1]) -> sRGB display values."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def to_lch(display: Array) -> Array:
    """Return (..., 3) CIE lightness [0, 100], chroma, hue [0, 360) degrees of (..., 3) sRGB in [0, 1]."""
    ratio = to_linear(display) @ _TO_XYZ.T / _WHITE
    f = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    a, b = 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])
    return np.stack([116 * f[..., 1] - 16, np.hypot(a, b), np.degrees(np.arctan2(b, a)) % 360], -1)


def from_lch(lch: Array) -> Array:
    """Inverse of `to_lch`; colours outside sRGB come out beyond [0, 1] in linear light, unclipped."""
    hue = np.radians(lch[..., 2])
    fy = (lch[..., 0] + 16) / 116
    f = np.stack([fy + lch[..., 1] * np.cos(hue) / 500, fy, fy - lch[..., 1] * np.sin(hue) / 200], -1)
    ratio = np.where(f > 6 / 29, f**3, (116 * f - 16) * 27 / 24389)
    linear = (ratio * _WHITE) @ np.linalg.inv(_TO_XYZ).T
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.abs(linear) ** (1 / 2.4) - 0.055)


def colour_word(display: Array) -> str | None:
    """Return the word that certainly fits one sRGB colour (3,), or None near a border between words."""
    lightness, chroma, hue = to_lch(display)
    for word, (l0, l1, c0, c1, h0, h1) in _BOXES.items():
        if l0 <= lightness <= l1 and c0 <= chroma <= c1 and (hue - h0) % 360 <= h1 - h0:
            return word
    return None


def random_colour(word: str, rng: np.random.Generator) -> Array:
    """Return (3,) sRGB display values in [0, 1] that `word` certainly covers."""
    l0, l1, c0, c1, h0, h1 = _BOXES[word]
    for _ in range(1000):
        colour = from_lch(rng.uniform((l0, c0, h0), (l1, min(c1, 95), h1)))
        if colour.min() >= 0 and colour.max() <= 1:
            return colour
    raise ValueError(f"no displayable colour found for {word!r}")


@dataclass(frozen=True, eq=False)
class Material:
    """Appearance of a surface. Textures are functions of the point in the object's own frame."""

    word: str  # the colour word that fits, "" where none does
    colour: Array  # (3,) sRGB in [0, 1]
    second: Array  # (3,) sRGB in [0, 1]: grain, stripes, joints
    texture: Texture
    gloss: float  # strength of the highlight, [0, 1]
    substance: Substance | None = None  # what it is made of; None: no common word fits


@dataclass(frozen=True, eq=False)
class Piece:
    """One surface with its place in the hierarchy whole > part > subpart."""

    part: str  # word of the part, e.g. "handle"
    subpart: str  # word of the finer region, "" where the part has none
    mesh: TriMesh
    material: Material
    instance: int = 0  # tells equal parts of one object apart, e.g. four wheels


@dataclass(frozen=True, eq=False)
class Thing:
    """One object: a word, a main colour word and its pieces, standing on z = 0 around the origin."""

    word: str
    colour: str  # "" where no single colour names the whole
    pieces: tuple[Piece, ...]

    def centred(self) -> "Thing":
        """Return the same thing with the middle of its footprint's bounding box at the origin."""
        points = np.concatenate([p.mesh.vertices[:, :2] for p in self.pieces])
        x, y = -(points.min(0) + points.max(0)) / 2
        return replace(self, pieces=tuple(replace(p, mesh=p.mesh.moved((x, y, 0.0))) for p in self.pieces))


_MADE_OF: dict[str, Substance] = {
    "wood": "wood", "planks": "wood", "cloth": "cloth", "rug": "cloth", "metal": "metal", "pages": "paper",
}  # fmt: skip


class Kit:
    """Random choices and material recipes for one object."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def size(self, low: float, high: float) -> float:
        """Return a length between two bounds."""
        return float(self.rng.uniform(low, high))

    def pick(self, *words: Word) -> Word:
        """Return one of several words, by chance."""
        return words[int(self.rng.integers(len(words)))]

    def other(self, word: str, *words: str) -> str:
        """Return one of `words` that is not `word`."""
        return self.pick(*[candidate for candidate in words if candidate != word])

    def paint(
        self,
        word: str,
        texture: Texture = "plain",
        gloss: float = 0.3,
        shift: float = 14,
        substance: Substance | None = None,
    ) -> Material:
        """Return a material of a named colour; the second colour is the first one `shift` lightness darker.

        Cloth, metal and wooden textures are of those materials unless `substance` says otherwise.
        """
        colour = random_colour(word, self.rng)
        made_of = substance or _MADE_OF.get(texture)
        return Material(word, colour, darker(colour, shift), texture, gloss, made_of)

    def plastic(self, word: str) -> Material:
        """Smooth and shiny, as toys are."""
        return self.paint(word, "plain", 0.5, substance="plastic")

    def glass(self, word: str) -> Material:
        """Coloured, with the strongest highlights; light does not pass."""
        return self.paint(word, "plain", 0.95, 8, substance="glass")

    def cloth(self, word: str) -> Material:
        """Return a woven and dull material."""
        return self.paint(word, "cloth", 0.02)

    def steel(self, word: str) -> Material:
        """Metal of any colour: brushed, with strong highlights."""
        return self.paint(word, "metal", 0.9, 10)

    def pattern(self, word: str, second: str, texture: Texture, gloss: float = 0.2) -> Material:
        """Two named colours; `word` covers most of the surface."""
        colours = random_colour(word, self.rng), random_colour(second, self.rng)
        return Material(word, *colours, texture, gloss, _MADE_OF.get(texture))

    def wood(self, word: str = "brown") -> Material:
        """Wooden surface of a colour."""
        return self.paint(word, "wood", 0.12, 12)

    def wall_paint(self, word: str) -> Material:
        """Return a pale, muted version of a colour; it keeps its word only where it still fits."""
        lch = to_lch(random_colour(word, self.rng))
        colour = np.clip(from_lch(np.array([70 + 0.2 * lch[0], 0.4 * lch[1], lch[2]])), 0, 1)
        return Material(colour_word(colour) or "", colour, darker(colour, 4), "plaster", 0.0)

    def metal(self) -> Material:
        """Return the material of bare metal, which is grey."""
        return self.steel("gray")


def darker(colour: Array, by: float) -> Array:
    """Return the same hue `by` units of CIE lightness darker, clipped to what can be shown."""
    lch = to_lch(colour)
    return np.clip(from_lch(np.array([np.clip(lch[0] - by, 3, 98), lch[1] * 0.95, lch[2]])), 0, 1)


@dataclass(frozen=True)
class Finish:
    """One substance. Highlights stay weak: a scene of few Gaussians cannot follow mirrors."""

    mirror: float  # reflectance straight on, [0, 1]
    sharpness: float  # exponent of the highlight
    diffuse: float = 1.0  # share of the colour that scatters light
    tint: float = 0.0  # share of the highlight that takes the surface's colour


FINISHES: dict[str, Finish] = {
    "plastic": Finish(0.04, 60),
    "ceramic": Finish(0.055, 150),
    "glass": Finish(0.09, 200, 0.9),
    "metal": Finish(0.45, 35, 0.55, 0.7),
    "wood": Finish(0.03, 25),
    "cloth": Finish(0.0, 4),
    "paper": Finish(0.01, 8),
    "plaster": Finish(0.0, 4),
    "leaf": Finish(0.035, 22),
    "skin": Finish(0.04, 28),
    "rubber": Finish(0.02, 10),
    "wax": Finish(0.03, 18),
}
_BY_TEXTURE = {
    "wood": "wood", "planks": "wood", "cloth": "cloth", "rug": "cloth", "metal": "metal", "pages": "paper",
    "painting": "paper", "leaf": "leaf", "peel": "skin", "plaster": "plaster", "tiles": "ceramic",
}  # fmt: skip
# How strongly a pattern is also carved: change of the light per unit of the pattern's weight.
_RELIEF = {
    "wood": 0.1, "planks": 0.2, "cloth": 0.3, "tiles": 0.22, "rug": 0.5, "plaster": 0.12, "leaf": 0.35,
    "peel": 0.5, "pages": 0.15, "striped": 0.2, "painting": 0.1, "metal": 0.05,
}  # fmt: skip


def finish_of(material: Material) -> Finish:
    """Finish of the substance a material is made of, or else of the one its texture and gloss suggest."""
    by_gloss = "glass" if material.gloss >= 0.85 else "ceramic" if material.gloss >= 0.5 else "plastic"
    if material.gloss < 0.2:
        by_gloss = "paper"
    return FINISHES[material.substance or _BY_TEXTURE.get(material.texture, by_gloss)]


def material_table(materials: tuple[Material, ...]) -> tuple[Array, Array]:
    """Return the (P,) int32 pattern of every piece, and a (P, 12) float32 table of numbers.

    Its columns are colour, second colour (sRGB), mirror, sharpness, diffuse, tint, relief, 0.
    """
    kinds = np.array([TEXTURES.index(m.texture) for m in materials], np.int32)
    rows = np.zeros((len(materials), 12), np.float32)
    for row, material in zip(rows, materials, strict=True):
        finish = finish_of(material)
        mirror = finish.mirror * min(1.0, 0.25 + 1.5 * material.gloss)
        row[:3], row[3:6] = material.colour, material.second
        row[6:11] = mirror, finish.sharpness, finish.diffuse, finish.tint, _RELIEF.get(material.texture, 0)
    return kinds, rows


def mean_reflectance(materials: tuple[Material, ...]) -> Array:
    """Return (P, 3) linear reflectance of every piece on average, for light that bounces off it."""
    return np.array([to_linear(0.75 * m.colour + 0.25 * m.second) * finish_of(m).diffuse for m in materials])

"""Changes between two scenes of one place: instances that appeared, are gone, moved or have another colour.

Both scenes are rendered from the training cameras of both. A pixel of one scene is *gone* if the other's
surface is clearly farther away, *hidden* if it is nearer, and else *kept*; a kept pixel may have *another
colour*. The rasterizer's adjoint sums these over Gaussians, and these are summed over the nodes of a tree. A
node has changed if most of its pixels have; hidden ones, and those that one capture missed, do not count.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array, linear_light, unit
from langsplat_core.errors import InputError, report_loss
from langsplat_core.extensions.geometry.registration import some_cameras
from langsplat_core.progress import Progress, silent
from langsplat_core.query.describe import Describer, likely_name
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.inventory import NAMES
from langsplat_core.raster import LiftingView
from langsplat_core.raster.render import splat_colours, view_of
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.surface import surface_areas
from langsplat_core.scene.transform import between_worlds, scaling, similarity
from langsplat_core.semantics.encoders import same_vectors

Kind = Literal["gone", "appeared", "moved", "recoloured"]
KINDS: tuple[Kind, ...] = ("gone", "appeared", "moved", "recoloured")
VIEWS = 24  # cameras of each scene
# Chosen on rooms 201 to 203.
FARTHER = 0.03  # largest difference of depths of equal surfaces, as a share of the depth
PLAINLY = 3  # factor of it above which a pixel is gone whatever its colour
OTHER = 18.0  # distance in CIE L*a*b* above which a kept pixel has another colour
TINT = 5.0  # distance in CIE L*a*b* above which a farther pixel is gone
ABSENT = 0.2  # least share of gone pixels of a node that is gone; below, its colour may have changed
MOST_GONE, MOST_COLOURED = 0.9, 0.6  # least share of changed pixels of a node that is gone, or recoloured
LEAST = 100  # least Gaussians of a node; the shape of smaller ones, at the border of captures, is uncertain
LEAST_PIXELS = 50.0  # least mean pixels of a node per image that shows it
EMPTY = 0.05  # alpha of an empty pixel
SIDE = 400  # pixels of the longer side of images
ALIKE = 0.8  # least cosine of mean-free language features of one instance
SHADE = 25.0  # largest distance of its mean colours, in CIE L*a*b*
GROWN = 1.7  # largest ratio of its sizes
TOUCHING = 0.25  # largest gap of pieces of one instance, as a share of the larger diagonal


@dataclass(frozen=True, eq=False)
class Change:
    """A changed instance. Positions are in the first scene's frame."""

    kind: Kind
    name: str | None  # its best words, "mug or cup"; None if none is likely
    centre: Array  # (3,) world units, its present position, or the former one if it is gone
    box: Array  # (2, 3) corners, world units
    moved: Array | None = None  # (3,) world units, displacement of what moved
    colours: tuple[str, str] | None = None  # before and now, of what was recoloured
    share: float = 0.0  # of its pixels that changed
    pixels: float = 0.0  # gone and kept ones, over all images

    @property
    def distance(self) -> float:
        """Length of the displacement, world units; 0 if it did not move."""
        return 0.0 if self.moved is None else float(np.linalg.norm(self.moved))


@dataclass(frozen=True, eq=False)
class _Piece:
    """Gaussians of one scene that changed together."""

    rows: Array  # (M,) int64
    gone: float  # pixels
    coloured: float
    kept: float
    colour: Array  # (3,) mean rendered L*a*b*
    other: Array  # (3,) that of the other scene at its kept pixels
    meaning: Array  # (D,) unit language feature, less the scene's mean
    points: Array  # (M, 3) in the first scene's frame

    @property
    def is_absent(self) -> bool:
        """True if it is gone and not only recoloured."""
        return self.gone >= ABSENT * (self.gone + self.kept)

    @cached_property
    def box(self) -> Array:
        """Lower and upper corner (2, 3), world units."""
        return axis_aligned_box(self.points)


def changes(
    first: QueryEngine,
    second: QueryEngine,
    placed: Array | None = None,
    describers: tuple[Describer, Describer] | None = None,
    progress: Progress = silent,
) -> tuple[Change, ...]:
    """Return the changes from the first scene to the second, by `KINDS`, the largest first.

    placed: (4, 4) similarity from the second scene's frame to the first one's; None: one world and its units.
    describers: of both, for names. Reports scenes in which most of the other's pixels are gone. InputError if
    neither scene has cameras, if one has no language field, and for a matrix that is no similarity.
    """
    into = _in_one_world(first.scene, second.scene) if placed is None else similarity(placed).matrix
    before, after = _evidence(first.scene, second.scene, into, progress)
    if all(sums[:, 0].sum() > sums[:, 1].sum() for sums in (before, after)):
        report_loss("most of each scene lies elsewhere in the other; align them by --register or --transform")
    home = (first, before, np.eye(4)), (second, after, into)
    gone, appeared = (_pieces(*each) for each in home)
    lost = [piece for piece in gone if piece.is_absent]
    new = [piece for piece in appeared if piece.is_absent]
    found: list[Change] = []
    one_encoder = same_vectors(first.field.canonical, second.field.canonical)
    for old, now in _matched(lost, new, one_encoder):
        lost, new = [p for p in lost if p is not old], [p for p in new if p is not now]
        moved = now.points.mean(0) - old.points.mean(0)
        found.append(replace(_change("moved", now, 1, describers), moved=moved))
    found += [_change("gone", piece, 0, describers) for piece in lost]
    found += [_change("appeared", piece, 1, describers) for piece in new]
    painted = [piece for piece in gone if not piece.is_absent]
    found += [_change("recoloured", piece, 0, describers) for piece in painted]
    for piece in appeared:  # recoloured pieces with a node of their own only in the second scene
        if not piece.is_absent and not any(_meet(piece.box, other.box) for other in painted):
            turned = replace(piece, colour=piece.other, other=piece.colour)
            found.append(_change("recoloured", turned, 1, describers))
    return tuple(sorted(found, key=lambda change: (KINDS.index(change.kind), -change.pixels)))


def _in_one_world(first: Scene, second: Scene) -> Array:
    """Return the (4, 4) similarity from the second scene's frame to the first one's by origins and units."""
    metres = first.metres_per_unit, second.metres_per_unit
    ratio = 1.0 if metres[0] is None or metres[1] is None else metres[1] / metres[0]
    return between_worlds(scaling(ratio), -second.origin, -first.origin).matrix


# Evidence: changed pixels of both scenes, summed over the Gaussians of each.

# Of each Gaussian: pixels gone, kept, recoloured; images; sums of its own colour, and of the other's if kept.
_CHANNELS = 10


@dataclass(frozen=True, eq=False)
class _Seen:
    """A scene from one camera."""

    view: LiftingView
    depth: Array  # (H, W) of the surface, units of the first scene; inf where it is empty, 0: unknown
    look: Array  # (H, W, 3) L*a*b*


def _evidence(first: Scene, second: Scene, into: Array, progress: Progress) -> tuple[Array, Array]:
    """Return (N, `_CHANNELS`) float64 of the Gaussians of both scenes."""
    there = similarity(into)
    back = there.inverse()
    own, others = (some_cameras(scene.cameras, VIEWS, SIDE) for scene in (first, second))
    cameras = own + [there.camera(camera) for camera in others]
    if not cameras:
        raise InputError("neither scene has cameras to look from; keep .cameras.json beside one of them")
    sums = np.zeros((len(first.gaussians), _CHANNELS)), np.zeros((len(second.gaussians), _CHANNELS))
    for done, camera in enumerate(cameras):
        progress("comparing the scenes", done / len(cameras))
        one = _seen(first, camera, 1.0, done < len(own))
        two = _seen(second, back.camera(camera), there.scale, done >= len(own))
        near = np.minimum(one.depth, two.depth)
        kept = (near > 0) & (np.abs(one.depth - two.depth) <= FARTHER * near)
        if kept.any():  # removes a difference in exposure
            two = replace(two, look=two.look - np.median((two.look - one.look)[kept], axis=0))
        sums[0][:] += _changed_pixels(one, two)
        sums[1][:] += _changed_pixels(two, one)
    return sums


def _seen(scene: Scene, camera: Camera, scale: float, is_own: bool) -> _Seen:
    """Return the scene from a camera; empty pixels are empty in its own cameras, in others unknown."""
    view = view_of(scene, camera)
    drawn = splat_colours(view, scene.gaussians)
    depth = scale * view.median_depth()
    if is_own:
        depth = np.where(drawn.alpha < EMPTY, np.inf, depth)
    return _Seen(view, depth, to_lab(np.clip(drawn.colours, 0, 1)))


def _changed_pixels(seen: _Seen, other: _Seen) -> Array:
    """Return (N, `_CHANNELS`) of the Gaussians of a scene in one image, by how the other one looks there."""
    near = np.minimum(seen.depth, other.depth)
    limit, behind = FARTHER * near, other.depth - seen.depth
    apart = np.linalg.norm(other.look - seen.look, axis=-1)
    gone = (near > 0) & ((behind > limit) & (apart > TINT) | (behind > PLAINLY * limit))
    stays = (near > 0) & ~gone & (behind > -limit)
    marks = np.stack([gone, stays, stays & (apart > OTHER)], -1)
    colours = np.concatenate([seen.look * (gone | stays)[..., None], other.look * stays[..., None]], -1)
    lifted = seen.view.gather(np.concatenate([marks, colours], -1).astype(np.float32))
    shown = lifted[:, :2].sum(1, keepdims=True) > 0
    return np.concatenate([lifted[:, :3], shown, lifted[:, 3:]], 1)


def to_lab(colours: Array) -> Array:
    """Return CIE L*a*b*, for D65, of (..., 3) sRGB in [0, 1]."""
    mixed = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.moveaxis(linear_light(colours) @ mixed.T / (0.9505, 1.0, 1.089), -1, 0)
    x, y, z = (np.where(v > 216 / 24389, np.cbrt(v), (24389 / 27 * v + 16) / 116) for v in (x, y, z))
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


# The basic colours of assets/vocabulary at typical sRGB values.
_TERMS = {
    "red": (190, 35, 40), "orange": (235, 130, 40), "yellow": (240, 215, 60), "green": (60, 150, 60),
    "turquoise": (50, 180, 180), "blue": (45, 85, 180), "purple": (120, 50, 140), "pink": (235, 150, 180),
    "brown": (110, 70, 40), "beige": (215, 195, 160), "black": (20, 20, 20), "grey": (125, 125, 125),
    "white": (240, 240, 240),
}  # fmt: skip


def colour_term(lab: Array) -> str:
    """Return the basic colour term nearest to a colour (3,) in CIE L*a*b*, by hue more than by lightness.

    Chroma is compressed, else shaded and pale colours would be grey; constants chosen on 63 named shades.
    """
    shades = np.concatenate([lab[None], to_lab(np.array(list(_TERMS.values())) / 255)])
    chroma = np.linalg.norm(shades[:, 1:], axis=1)
    hues = shades[:, 1:] * (60 * np.tanh(chroma / 15) / np.maximum(chroma, 1e-9))[:, None]
    placed = np.concatenate([0.35 * shades[:, :1], hues], 1)
    return list(_TERMS)[int(((placed[1:] - placed[0]) ** 2).sum(1).argmin())]


# Pieces: the largest nodes that changed, merged if they are of one instance.


def _pieces(engine: QueryEngine, evidence: Array, into: Array) -> list[_Piece]:
    """Return the changed pieces; those that meet, with similar features and changes, are merged."""
    tree, members = engine.tree, engine.tree.gaussians()
    features = _codewords_seen(engine)
    made: list[_Piece] = []
    images, leaves = np.zeros(tree.count), tree.leaves >= 0
    np.maximum.at(images, tree.leaves[leaves], evidence[leaves, 3])
    for node, parent in enumerate(tree.parents):
        if parent >= 0:
            images[parent] = max(images[parent], images[node])
    changed = _changed(members.sizes, members.sums(evidence[:, :3]), images)
    for node in range(tree.count - 1, -1, -1):  # parents first
        parent = tree.parents[node]
        if parent >= 0 and changed[parent]:
            changed[node] = True
        elif changed[node]:
            made.append(_piece(engine, evidence, into, members[node], features))
    kept: list[_Piece] = []
    for piece in sorted(made, key=lambda piece: -len(piece.rows)):
        for place, other in enumerate(kept):
            alike = float(piece.meaning @ other.meaning) >= ALIKE and piece.is_absent == other.is_absent
            if alike and _meet(piece.box, other.box):
                rows = np.union1d(piece.rows, other.rows)
                kept[place] = _piece(engine, evidence, into, rows, features)
                break
        else:
            kept.append(piece)
    return kept


def _changed(sizes: Array, sums: Array, images: Array) -> Array:
    """Return (K,) bool: the nodes that changed, by their Gaussians, pixels and images."""
    gone, kept, coloured = sums.T
    enough = (sizes >= LEAST) & (gone + kept >= LEAST_PIXELS * np.maximum(images, 1))
    least = np.where(gone >= ABSENT * (gone + kept), MOST_GONE, MOST_COLOURED)
    return np.asarray(enough & (gone + coloured >= least * (gone + kept)))


def _codewords_seen(engine: QueryEngine) -> tuple[Array, Array, Array]:
    """Return (U, D) features less their mean, their (N,) numbers at level whole, -1: none, and (N,) areas."""
    field, level = engine.field, len(LEVELS) - 1
    number, areas = np.full(len(field), -1), surface_areas(engine.scene.gaussians)
    known = field.known[level]
    latents, number[known] = field.codec.unique(field.latents[level, known])
    vectors = field.codec.decode(latents)
    weights = np.bincount(number[known], areas[known], minlength=len(vectors))
    return vectors - weights @ vectors / max(weights.sum(), 1e-12), number, areas


def _piece(
    engine: QueryEngine, evidence: Array, into: Array, rows: Array, features: tuple[Array, Array, Array]
) -> _Piece:
    vectors, number, areas = features
    known = rows[number[rows] >= 0]
    mean = np.bincount(number[known], areas[known], minlength=len(vectors)) @ vectors
    gone, kept, coloured, _, *looks = evidence[rows].sum(0)
    colour, other = np.array(looks[:3]) / max(gone + kept, 1e-9), np.array(looks[3:]) / max(kept, 1e-9)
    means = engine.scene.gaussians.means[rows].astype(np.float64)
    return _Piece(
        rows=rows,
        gone=float(gone),
        coloured=float(coloured),
        kept=float(kept),
        colour=colour,
        other=other,
        meaning=unit(mean[None])[0] if len(known) else np.zeros(vectors.shape[1]),
        points=means @ into[:3, :3].T + into[:3, 3],
    )


def _meet(one: Array, other: Array) -> bool:
    """Return True if two boxes (2, 3) overlap or nearly touch."""
    room = TOUCHING * max(np.linalg.norm(one[1] - one[0]), np.linalg.norm(other[1] - other[0]))
    return bool(((one[0] - room <= other[1]) & (other[0] - room <= one[1])).all())


def _matched(lost: list[_Piece], new: list[_Piece], comparable: bool) -> list[tuple[_Piece, _Piece]]:
    """Return pairs of gone and appeared pieces of one instance, the most similar first; each in one pair."""
    pairs = []
    for old in lost:
        for now in new:
            alike = float(old.meaning @ now.meaning) if comparable else 1.0
            shade = float(np.linalg.norm((old.colour - now.colour) * (0.5, 1, 1)))
            small, large = sorted(float(np.linalg.norm(np.ptp(each.box, axis=0))) for each in (old, now))
            if alike >= ALIKE and shade <= SHADE and large <= GROWN * max(small, 1e-9):
                pairs.append((alike - shade / SHADE, old, now))
    found: list[tuple[_Piece, _Piece]] = []
    for _, old, now in sorted(pairs, key=lambda pair: -pair[0]):
        if not any(old is one or now is other for one, other in found):
            found.append((old, now))
    return found


def _change(kind: Kind, piece: _Piece, scene: int, describers: tuple[Describer, Describer] | None) -> Change:
    name = None
    if describers is not None:
        name = likely_name(describers[scene].at_gaussians(piece.rows, top=NAMES)[-1].words)
    colours = (colour_term(piece.colour), colour_term(piece.other)) if kind == "recoloured" else None
    pixels = piece.gone + piece.kept
    return Change(
        kind=kind,
        name=None if name is None else name.phrase,
        centre=piece.points.mean(0),
        box=piece.box,
        colours=colours,
        share=(piece.gone + piece.coloured) / max(pixels, 1e-9),
        pixels=pixels,
    )

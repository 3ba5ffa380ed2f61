"""Photographs of a procedural room with cameras, points and ground truth, read again; the bundled scene.

The bundled scene's room is photographed by our renderer and trained by our pipeline, which sees photographs,
cameras, noisy points and, in place of SAM, the outlines of things and parts. Their names and colours it never
sees: those come from the encoder.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from PIL import Image
from scipy.ndimage import binary_fill_holes, find_objects
from scipy.ndimage import label as connected

from assets.making.render import Light, RenderedView, Renderer
from assets.making.world import (
    CATEGORIES,
    RegionLabel,
    Tier,
    World,
    build_room,
    object_words,
    part_words,
)
from langsplat_core.arrays import Array
from langsplat_core.config import (
    ClipConfig,
    DatasetConfig,
    MaskConfig,
    RadianceConfig,
    Range,
    TrainConfig,
)
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import InputError
from langsplat_core.io.files import atomic_path, write_json
from langsplat_core.io.ply import write_table
from langsplat_core.io.scenes import load_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.query.grammar import is_part, singular
from langsplat_core.raster.render import view_of
from langsplat_core.scene import LEVELS, Camera, Scene, look_at
from langsplat_core.semantics.masks import LevelMasks, MaskSource

LabelLayout = Literal["plain", "lerf-ovs", "3d-ovs"]  # how a rendered room's truth is written
Pixels = Annotated[int, Range(1, 65_536)]
Size = tuple[Pixels, Pixels]  # width and height of an image

# The truth, read again: regions, the phrases that are right for them, and masks.

PHRASE_KINDS = ("object", "colour+object", "part", "subpart")  # of phrases, in the order of tables
MIN_REGION = 16  # px: of a smaller region not even an oracle's crop shows anything


@dataclass(frozen=True)
class Region:
    """One region as in `truth/labels.json`; empty words where none fits."""

    level: str  # one of LEVELS
    word: str  # its own: the object's at level whole, else the part's
    thing: str  # the word of the object it belongs to
    colour: str = ""
    phrase: str = ""  # the one that says most about it
    words: tuple[str, ...] = ()  # every phrase that is right for it

    @property
    def is_part(self) -> bool:
        """True for a part with a word of its own."""
        return self.level != "whole" and self.word not in ("", self.thing, "body")


@dataclass(frozen=True)
class Phrase:
    """A phrase and what it is true for."""

    text: str
    kind: str  # one of PHRASE_KINDS
    ids: tuple[int, ...]  # truth ids, of any level


@dataclass(frozen=True, eq=False)
class Truth:
    """Everything known about the photographs of a room."""

    folder: Path
    phrases: tuple[Phrase, ...]
    regions: Mapping[int, Region] = field(default_factory=dict)  # by truth id

    @cached_property
    def words(self) -> frozenset[str]:
        """Every phrase that is right for anything in the room."""
        return frozenset(word for region in self.regions.values() for word in region.words)

    def labels(self, name: str) -> Array:
        """Return (3, H, W) ids of the photograph with this stem, -1 where nothing is."""
        with np.load(self.folder / f"{name}.npz", allow_pickle=False) as stored:
            return np.asarray(stored["ids"]).astype(np.int64)

    def absent(self, things: Iterable[str]) -> list[str]:
        """Words of `things` by which or by whose synonyms, in any number, nothing there may be called."""
        called = set(map(singular, self.words))
        return sorted(thing for thing in things if called.isdisjoint(map(singular, object_words(thing))))


def read_truth(dataset: Path) -> Truth:
    """Return the truth beside the photographs; InputError where there is none."""
    folder = dataset / "truth"
    if not (folder / "labels.json").is_file():
        raise InputError(
            f"{dataset}: no truth/labels.json; make one with `python -m assets.making dataset --out DIR`"
        )
    stated = json.loads((folder / "labels.json").read_text(encoding="utf-8"))
    names = {entry.name for entry in fields(Region)}
    regions = {
        int(key): Region(**{n: v for n, v in item.items() if n in names} | {"words": tuple(item["words"])})
        for key, item in stated.items()
    }
    phrases: dict[str, Phrase] = {}
    for region in regions.values():
        for text, kind in _asked(region):
            ids = tuple(key for key, other in regions.items() if text in other.words)
            # A part without finer regions is its own subpart: the coarsest level gives a phrase its kind.
            if text not in phrases or PHRASE_KINDS.index(kind) < PHRASE_KINDS.index(phrases[text].kind):
                phrases[text] = Phrase(text, kind, ids)
    return Truth(folder, tuple(phrases.values()), regions)


def _asked(region: Region) -> Iterator[tuple[str, str]]:
    """Return the phrases that are asked about one region: (text, kind)."""
    if region.level == "whole" and region.thing:
        yield region.thing, "object"
        if region.colour:
            yield f"{region.colour} {region.thing}", "colour+object"
    elif region.is_part:
        yield f"{region.thing} {region.word}", region.level


class TruthMasks(MaskSource):
    """A `MaskSource` that gives the regions of the truth, at its three levels.

    A photograph is recognised by its content, since a mask source is given nothing else.
    """

    name = "truth"
    key = json.dumps(["truth", 1, MIN_REGION])

    def __init__(self, capture: Capture, truth: Truth) -> None:
        self._truth = truth
        pairs = zip(capture.images, capture.cameras, strict=True)
        self._names = {_digest(image): camera.name for image, camera in pairs}

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8 of the capture; InputError for any other."""
        name = self._names.get(_digest(image))
        if name is None:
            raise InputError(f"{self._truth.folder}: has no truth for this photograph; render the room again")
        stacks = []
        for ids in self._truth.labels(name):
            found, pixels = np.unique(ids[ids >= 0], return_counts=True)
            stacks.append(ids == found[pixels >= MIN_REGION][:, None, None])
        progress("reading the truth", 1.0)
        return stacks[0], stacks[1], stacks[2]


def _digest(image: Array) -> str:
    return hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()


# Photographs, cameras, points and truth, written.

POINTS = 20_000  # sparse points, as structure from motion would give
FIRST_ROOM = 2_000_000  # the demo encoder was trained in rooms of lower numbers only
LIGHT_SAMPLES = 40  # rays per vertex towards the lamp, and again towards the sky
LIGHT_CELL = 0.006  # metres between the places where light is gathered, where it varies
_POINT_NOISE = 0.004  # metres, standard deviation
LIGHT = Light(np.array([-1.25, -1.05, 1.55]))
# (share of the views, elevation in degrees, distance in metres, height of the target above the table)
_RINGS = ((0.3, 23.0, 1.5, 0.0), (0.3, 42.0, 1.25, 0.02), (0.25, 36.0, 1.0, 0.05), (0.15, 50.0, 1.75, -0.2))


@dataclass(frozen=True)
class Naming:
    """File names of photographs."""

    stem: str = "view_{:03d}"
    suffix: str = ".png"
    first: int = 0


PLAIN = Naming()


def write_dataset(
    out: Path,
    seed: int,
    views: int,
    size: tuple[int, int],
    progress: Progress,
    tier: Tier = "clutter",
    naming: Naming = PLAIN,
    world: World | None = None,
) -> None:
    """Render the room of `seed` and difficulty `tier` into folder `out`.

    views: number of photographs, >= 4; size: (width, height) in pixels, at least 16 each; naming: of the
    photographs; world: what the cameras and points of `seed` show, in place of its own room. Written are
    images/view_000.png ..., points.ply, truth/view_000.npz (`ids`: (3, H, W) int32 label ids at subpart, part
    and whole level, -1 where there is nothing; `depth`: (H, W) float32 metres along the camera's z),
    truth/labels.json (id -> level, word, thing, colour, phrase, words) and, last, transforms.json in
    nerfstudio's convention (OpenGL camera-to-world), marked as "drawn". A view counts as done when its truth
    file is there, so an interrupted call goes on where it stopped. Raises InputError for a size or number out
    of range.
    """
    if views < 4 or min(size) < 16:
        raise InputError(
            f"demo dataset: {views} views of {size[0]}x{size[1]}: it needs at least 4 views of 16x16"
        )
    world = photographed_room(seed, tier) if world is None else world
    cameras = [
        replace(camera, name=naming.stem.format(naming.first + k))
        for k, camera in enumerate(orbit_cameras(views, size, seed))
    ]
    folder, truth = out / "images", out / "truth"
    folder.mkdir(parents=True, exist_ok=True)
    truth.mkdir(exist_ok=True)
    progress("rendering photographs", 0.0)
    renderer = Renderer(world, LIGHT, samples=LIGHT_SAMPLES, cell=LIGHT_CELL)
    for done, camera in enumerate(cameras):
        if not (truth / f"{camera.name}.npz").exists():
            _write_view(renderer, world, camera, out, naming.suffix)
        progress("rendering photographs", (done + 1) / views)
    write_labels(world, truth / "labels.json")
    _write_points(world, renderer, seed, out / "points.ply")
    write_transforms(cameras, naming.suffix, out / "transforms.json")


def photographed_room(seed: int, tier: Tier = "clutter") -> World:
    """Return the room that `write_dataset` photographs; the demo encoder has never seen one of them."""
    return build_room(FIRST_ROOM + seed, tier)


def truth_ids(world: World, rendered: RenderedView) -> Array:
    """Return (3, H, W) int32 label ids of an image at subpart, part and whole level, -1 where nothing is."""
    ids = np.where(rendered.pieces[..., None] >= 0, world.ids[rendered.pieces], -1)
    return np.moveaxis(ids, -1, 0).astype(np.int32)


def orbit_cameras(views: int, size: tuple[int, int], seed: int) -> list[Camera]:
    """Cameras on four rings around the table, low, high, close and far; jittered by the seed.

    Names are shuffled over the rings, so that every n-th view in name order is a fair sample of them.
    """
    rng = np.random.default_rng((seed, 3))
    cameras: list[Camera] = []
    counts = [round(share * views) for share, *_ in _RINGS[:-1]]
    counts.append(views - sum(counts))
    for (_, elevation, distance, height), count in zip(_RINGS, counts, strict=True):
        for k in range(count):
            azimuth = 2 * np.pi * (k + rng.uniform(-0.2, 0.2) + 0.37 * elevation) / count
            tilt = np.radians(elevation + rng.uniform(-4, 4))
            reach = distance * rng.uniform(0.95, 1.05)
            out = np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)])
            target = np.array([*rng.uniform(-0.12, 0.12, 2), height])
            cameras.append(look_at(target + reach * out, target, np.array([0.0, 0, 1]), size, 46.0))
    order = rng.permutation(views)
    return [replace(cameras[row], name=f"view_{k:03d}") for k, row in enumerate(order)]


def _write_view(renderer: Renderer, world: World, camera: Camera, out: Path, suffix: str) -> None:
    rendered = renderer.render(camera)
    with atomic_path(out / "images" / f"{camera.name}{suffix}") as path:
        Image.fromarray(rendered.image).save(path, quality=95)  # PNG has no quality and does not read it
    with atomic_path(out / "truth" / f"{camera.name}.npz") as path:
        np.savez_compressed(path, ids=truth_ids(world, rendered), depth=rendered.depth)


def write_labels(world: World, path: Path) -> None:
    """Write what every id stands for, as `write_dataset` says."""
    stated = ("word", "thing", "colour", "phrase", "words")
    rows = {
        str(number): {"level": LEVELS[label.level], **{name: getattr(label, name) for name in stated}}
        for number, label in enumerate(world.labels)
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _write_points(world: World, renderer: Renderer, seed: int, path: Path) -> None:
    """Points on the surfaces, denser on the objects than on the room, with noise and colours."""
    rng = np.random.default_rng((seed, 4))
    corners = world.vertices[world.triangles].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    objects = world.solid & (corners[:, :, 2].max(1) > -0.05)
    weight = area * np.where(objects, 8.0, 1.0)
    chosen = rng.choice(len(area), POINTS, p=weight / weight.sum())
    uv = np.sort(rng.random((POINTS, 2)), 1)
    uv = np.stack([uv[:, 0], uv[:, 1] - uv[:, 0]], 1)
    spread = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)
    points = (corners[chosen] * spread[..., None]).sum(1) + rng.normal(0, _POINT_NOISE, (POINTS, 3))
    colours = renderer.colours_at(chosen, uv, np.array([0.0, 0.0, 3.0]))
    columns = dict(zip("xyz", points.astype(np.float32).T, strict=True))
    columns |= zip(("red", "green", "blue"), colours.astype(np.uint8).T, strict=True)
    write_table(path, columns)


def camera_to_world_gl(camera: Camera) -> Array:
    """Return (4, 4) camera-to-world in OpenGL's frame (x right, y up, z backwards), as in transforms.json."""
    return np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])


def write_transforms(cameras: list[Camera], suffix: str, path: Path, points: str = "points.ply") -> None:
    """Write transforms.json, as `write_dataset` says; points: the file of points beside it, "" for none."""
    first = cameras[0]
    content = {
        "camera_model": "PINHOLE",
        "w": first.width,
        "h": first.height,
        "fl_x": first.fx,
        "fl_y": first.fy,
        "cx": first.cx,
        "cy": first.cy,
        "ply_file_path": points,
        "metres_per_unit": 1.0,
        "drawn": True,
        "frames": [
            {
                "file_path": f"images/{camera.name}{suffix}",
                "transform_matrix": camera_to_world_gl(camera).tolist(),
            }
            for camera in cameras
        ],
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


SCENE = "room"  # the benchmark's name for it
LABELLED_EVERY = 8  # views; those that training holds out unless told otherwise
NAMES: dict[LabelLayout, Naming] = {
    "plain": PLAIN,
    "lerf-ovs": Naming("frame_{:05d}", ".jpg", 1),
    "3d-ovs": Naming("{:02d}", ".jpg"),
}
ASKED = ("object", "colour+object", "part")  # kinds of phrases that LERF-OVS's labels are like
MIN_PIXELS = 150  # a thing with fewer visible pixels in a view is not asked for there
PIECES = np.ones((3, 3), int)  # pixels that touch at a corner are of one piece
EDGE = 0.999  # height at which a mask's edge is traced: within a thousandth of the centres of its own pixels


def write_labelled(
    out: Path,
    layout: LabelLayout,
    seed: int,
    views: int,
    size: tuple[int, int],
    progress: Progress,
    tier: Tier = "clutter",
) -> Path:
    """Render a room as `write_dataset` does, and label every eighth view in a benchmark's layout.

    Photographs go into `out` itself or, in a benchmark's layout, into `out`/room; returns their folder.
    Raises as `write_dataset`.
    """
    folder = out if layout == "plain" else out / SCENE
    write_dataset(folder, seed, views, size, progress, tier, NAMES[layout])
    if layout == "plain":
        return folder
    truth = read_truth(folder)
    names = sorted(path.stem for path in (folder / "truth").glob("*.npz"))[::LABELLED_EVERY]
    if layout == "lerf-ovs":
        write_lerf_ovs(folder, out / "label" / SCENE, truth, names)
    else:
        write_3d_ovs(folder, truth, names)
    return folder


def _visible(truth: Truth, name: str, kinds: tuple[str, ...]) -> dict[Phrase, Array]:
    """Return the phrases that are true for enough of a view to be asked there, and where."""
    labels = truth.labels(name)
    masks = {p: np.asarray(np.isin(labels, p.ids).any(axis=0)) for p in truth.phrases if p.kind in kinds}
    return {phrase: mask for phrase, mask in masks.items() if mask.sum() >= MIN_PIXELS}


def write_lerf_ovs(dataset: Path, labels: Path, truth: Truth, names: list[str]) -> None:
    """Write label/<scene>/<frame>.json and .jpg.

    A mask of several pieces, or with holes, becomes several objects of one category, whose polygons joined
    are the mask.
    """
    for name in names:
        photograph = (dataset / "images" / f"{name}.jpg").read_bytes()
        with atomic_path(labels / f"{name}.jpg") as path:
            path.write_bytes(photograph)
        height, width = truth.labels(name).shape[1:]
        objects = [
            {"category": phrase.text, "bbox": box, "segmentation": polygon}
            for phrase, mask in _visible(truth, name, ASKED).items()
            for polygon, box in _objects(mask)
        ]
        info = {"name": f"{name}.jpg", "width": width, "height": height}
        with atomic_path(labels / f"{name}.json") as path:
            path.write_text(json.dumps({"info": info, "objects": objects}) + "\n", encoding="utf-8")


def _objects(mask: Array) -> list[tuple[list[list[int]], list[int]]]:
    """(polygon, box) of every piece of a mask; what a piece is cut into for its holes keeps its box."""
    pieces, _ = connected(mask, PIECES)
    found = []
    for number, (rows, columns) in enumerate(find_objects(pieces), 1):
        box = [columns.start, rows.start, columns.stop - 1, rows.stop - 1]
        found += [(polygon.tolist(), box) for polygon in outlines(pieces == number)]
    return found


def write_3d_ovs(dataset: Path, truth: Truth, names: list[str]) -> None:
    """Write segmentations/<view>/<class>.png and, last, classes.txt; a class is the word of a whole thing."""
    folder = dataset / "segmentations"
    classes: dict[str, None] = {}
    for name in names:
        for phrase, mask in _visible(truth, name, ("object",)).items():
            classes[phrase.text] = None
            with atomic_path(folder / name / f"{phrase.text}.png") as path:
                Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path)
    with atomic_path(folder / "classes.txt") as path:
        path.write_text("\n".join(sorted(classes)) + "\n", encoding="utf-8")


def outlines(mask: Array) -> list[Array]:
    """Trace (H, W) bool as polygons, (K, 2) int x, y each, K >= 3, which filled with their border give it.

    A piece with a hole is cut through it into pieces without one.
    """
    found = []
    pieces, _ = connected(mask, PIECES)
    for number, part in enumerate(find_objects(pieces), 1):
        piece = pieces[part] == number
        corner = np.array([part[1].start, part[0].start])
        holes = binary_fill_holes(piece) & ~piece
        if holes.any():
            column = int(np.flatnonzero(holes.any(0))[0])
            left, right = piece.copy(), piece.copy()
            left[:, column + 1 :], right[:, : column + 1] = False, False
            found += [polygon + corner for polygon in outlines(left) + outlines(right)]
        else:
            found.append(_trace(piece) + corner)
    return found


def _trace(piece: Array) -> Array:
    """Return (K, 2) border of one piece without holes, pixel by pixel."""
    from skimage.measure import find_contours

    contours = find_contours(np.pad(piece.astype(float), 1), EDGE, fully_connected="high")
    longest = max(contours, key=len)
    corners = np.rint(longest - 1).astype(int)[:, ::-1]
    corners = corners[np.r_[True, (np.diff(corners, axis=0) != 0).any(1)]]
    return np.concatenate([corners, np.repeat(corners[-1:], max(0, 3 - len(corners)), 0)])


# The bundled scene.

SEED = 2
VIEWS = 72
SIZE = (640, 480)
MAX_LOSS = 0.25  # dB that compaction may cost


# A low SH degree and a cap on the count keep the file small.
CONFIG = TrainConfig(
    dataset=DatasetConfig(max_side=max(SIZE), test_every=9, hold_out="every"),
    radiance=RadianceConfig(steps=6_000, sh_degree=1, max_gaussians=110_000),
    masks=MaskConfig(source="graph"),
    clip=ClipConfig(model="demo"),
)


NAMED = 0.6  # share of a node's blending weight that one region of the truth has, or the node has no name


def write_names(scene: Scene, truth: Iterable[Array], labels: Sequence[RegionLabel], path: Path) -> None:
    """Write what the wholes and parts of a scene's tree are called, and all words for anything there.

    truth: (3, H, W) ids of every camera, as of `truth_ids`; labels: by id.
    """
    assert scene.language is not None
    assert scene.language.tree is not None
    tree, names = scene.language.tree, {}
    votes: Any = 0  # (N, ids) sparse
    for camera, ids in zip(scene.cameras, truth, strict=True):
        votes = votes + view_of(scene, camera).gather_labels(ids.astype(np.int32), len(labels))
    levels = np.array([label.level for label in labels])
    for node in np.flatnonzero(tree.levels > 0).tolist():
        weights = np.where(levels == tree.levels[node], votes[tree.members(node)].sum(0).A1, 0)
        label = labels[int(weights.argmax())]
        named = label.level == 2 or (is_part(label.word) and label.word not in (label.thing, "body"))
        if label.word and named and weights.max() > NAMED * weights.sum():
            names[node] = (object_words if label.level == 2 else part_words)(label.word)
    words = (
        {*object_words(label.thing), *CATEGORIES.get(label.thing, ()), *part_words(label.word)}
        for label in labels
    )
    write_json(path, {"names": names, "called": sorted(set().union(*words) - {""})})


def build_scene(out: Path, gaussians: Path | None = None, progress: Progress = silent) -> str:
    """Render the room, train a scene, drop what its photographs do not miss, and write what is in it.

    Given `gaussians`, a scene of that room, only its language field is made anew. Returns a line about what
    was made. Photographs and truth stay in `<out>.work/photographs`, the scene as trained in
    `<out>.work/trained.ply`.
    """
    from langsplat_core.extensions.compaction.compact import BudgetConfig, compact_scene
    from langsplat_core.pipeline.train import train_scene

    work = out.with_name(out.stem + ".work")
    photographs, trained = work / "photographs", work / "trained.ply"
    if not (photographs / "transforms.json").exists():
        write_dataset(photographs, SEED, VIEWS, SIZE, progress)
    made = train_scene(
        photographs,
        out if gaussians else trained,
        CONFIG,
        work,
        progress,
        masks_of=lambda capture: TruthMasks(capture, read_truth(photographs)),
        gaussians_from=gaussians,
    )
    if not gaussians:
        report = compact_scene(trained, out, BudgetConfig(max_psnr_loss=MAX_LOSS), photographs, progress)
    scene, truth = load_scene(out), read_truth(photographs)
    labels = photographed_room(SEED).labels
    write_names(scene, (truth.labels(one.name) for one in scene.cameras), labels, out.with_name("names.json"))
    if gaussians:
        return f"{made.gaussians} Gaussians of {gaussians}, {made.codec} of {made.codec_size}"
    kept, before = report.after, report.before.gaussians
    return f"{kept.gaussians} Gaussians of {before} trained, held-out {kept.psnr:.2f} dB"

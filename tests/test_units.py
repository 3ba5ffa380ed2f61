"""What is seen, found, measured and made depends neither on the length of a unit nor on where a scene lies.

A law is a function from a scene to what comes of it: `Same` is equal, `Image`s look alike, `Rows` are
nearly the same Gaussians, `Length`s are times the scale, `Places` move along, a `Surface` lies on itself.
What lies along the axes of its world, such as voxels, is not turned: there a law asks for less, and says so.
"""

import json
import re
import zlib
from base64 import b64decode
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import PIL.Image
import pytest
import yaml
from plyfile import PlyData
from safetensors.numpy import load
from scipy.spatial import cKDTree

from langsplat_core import load_scene, render, view_of
from langsplat_core.arrays import Array, psnr
from langsplat_core.cli.app import parse
from langsplat_core.config import PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.extensions.agents.commands import SceneTools
from langsplat_core.extensions.checkpoints.langsplat_files import write_checkpoint
from langsplat_core.extensions.compaction.clean import CleanConfig, clean
from langsplat_core.extensions.compaction.compact import BudgetConfig, choose_views, find_reduction
from langsplat_core.extensions.library.changes import changes
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.scenes import CORE_FORMATS, save_scene
from langsplat_core.pipeline.webpage import pack_gaussians, views
from langsplat_core.progress import silent
from langsplat_core.query import selection
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.describe import Describer, look_at_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.inventory import scene_inventory, scene_outline
from langsplat_core.scene import Camera, Scene
from langsplat_core.scene.transform import (
    IDENTITY,
    Similarity,
    moving,
    place_scene,
    rotating,
    scaling,
    transform_scene,
)
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.trainer import train_radiance
from langsplat_viewer.camera.controls import default_view, extent_of, fly, frame_all, from_camera
from langsplat_viewer.camera.flight import Flight, Keyframe, pose_of, turntable
from langsplat_viewer.camera.overlays import ground_grid
from langsplat_viewer.options import ViewerOptions, services
from langsplat_viewer.output import cameras_of
from langsplat_viewer.program import draw
from langsplat_viewer.projects import write_flight
from langsplat_viewer.rendering.renderer import open_renderer
from langsplat_viewer.rendering.request import depth_range, image_formation, plain_request
from tests.support.scenes import DEMO, SHORT, capture
from tests.support.windowless import render_image

EVERY = 10  # every so-manyth Gaussian of the bundled scene, as much larger
SCALES = (1e-4, 1e-2, 1.0, 1e2, 1e4)
QUICK = (1e-4, 1e4)  # of them, in the quick suite
PHRASES = (
    "a blue book",
    "mug",
    "the mug nearest to the book",
    "leg of the table",
    "the mug left of the lamp",
)


@dataclass(frozen=True)
class Same:
    value: Any


@dataclass(frozen=True)
class Near:
    value: Any
    by: float = 1e-3


@dataclass(frozen=True)
class Image:
    value: Array
    least: float = 45.0  # dB


@dataclass(frozen=True)
class Rows:
    value: Array  # (N,) bool


@dataclass(frozen=True)
class Length:
    value: Any
    by: float = 1e-3
    power: int = 1  # 2: an area


@dataclass(frozen=True)
class Places:
    value: Any  # (..., 3)
    by: float = 2e-3  # of the scene's radius


@dataclass(frozen=True)
class Surface:
    value: Array  # (P, 3) points of it
    by: float  # scene units before: nine tenths of the points lie no farther from the other's, both ways


Found = Mapping[str, Same | Near | Image | Rows | Length | Places | Surface]
EXACT = 1e-5  # of the radius: what float32 leaves of places


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with what laws ask of it."""

    scene: Scene
    folder: Path
    to: Similarity = IDENTITY  # from the room

    @property
    def scale(self) -> float:
        """Length of what was a unit."""
        return self.to.scale

    @property
    def turned(self) -> bool:
        """True where the scene lies aslant in its world."""
        return bool((self.to.rotation != np.eye(3)).any())

    @cached_property
    def engine(self) -> QueryEngine:
        return QueryEngine(self.scene, load_text_encoder)

    @cached_property
    def path(self) -> Path:
        save_scene(self.folder / "scene.ply", self.scene)
        return self.folder / "scene.ply"

    @cached_property
    def other(self) -> Path:
        """A file of the scene with its table lifted, and about an origin of its own."""
        scene, table = self.scene, run_phrase(self.engine, "table").answer.members
        lifted = scene.gaussians.means + np.outer(table, 0.3 * scene.bounds()[1] * scene.up())
        other = replace(scene, gaussians=replace(scene.gaussians, means=lifted))
        there = scene.origin + self.scale * np.array([0.5, -0.25, 1.0])
        save_scene(self.folder / "other.ply", place_scene(other, origin=there))
        return self.folder / "other.ply"

    def run(self, *words: object) -> str:
        """Return what a command prints."""
        with redirect_stdout(StringIO()) as printed:
            parse([*map(str, words)]).run()
        return printed.getvalue()

    def said(self, *words: object) -> Any:
        """Return what a command prints as JSON."""
        return json.loads(self.run(*words, "--json"))


@cache
def room() -> Scene:
    scene = load_scene(DEMO)
    some = scene.take(np.arange(0, len(scene.gaussians), EVERY))
    larger = some.gaussians.log_scales + np.float32(np.log(EVERY) / 2)
    cameras = tuple(camera.within(160) for camera in scene.cameras[::4])
    return replace(some, gaussians=replace(some.gaussians, log_scales=larger), cameras=cameras)


TURN, SHIFT = rotating(np.array([1.0, 2.0, -0.5]), 37.0), moving(np.array([3.0, -2.0, 5.0]))


# ---- the laws ----


def images(case: Case) -> Found:
    scene, cameras = case.scene, case.scene.cameras
    drawn = {str(at): Image(render(scene, camera).colours) for at, camera in enumerate(cameras[::4])}
    depth = view_of(scene, cameras[0]).median_depth()
    request = plain_request(scene, cameras[1], PictureConfig())
    return {
        **drawn,
        "opengl": Image(render_image(request, "opengl") / 255),
        "depth": Length(np.quantile(depth, (0.3, 0.5, 0.9))),
        "near": Length(scene.near),
    }


def framed(case: Case) -> Found:
    """What lies about a scene; without cameras its up is the world's, whichever way it lies."""
    scene, bare = case.scene, replace(case.scene, cameras=())
    size = (160, 120)
    around = [*scene.spiral_cameras(2, size), scene.framing_camera(size)]
    centre, radius = scene.bounds()
    if not case.turned:
        around += [*bare.spiral_cameras(1, size), bare.framing_camera(size)]
    return {
        **{str(at): Image(render(scene, camera).colours) for at, camera in enumerate(around)},
        "near": Length([scene.near, bare.near]),
        "radius": Length(radius),
        "centre": Places(centre),
        "distance": Length(np.linalg.norm(bare.framing_camera(size).position - centre)),
    }


def window(case: Case) -> Found:
    scene, extent = case.scene, extent_of(case.scene)
    view = default_view(scene, extent, (160, 120))
    camera, close = view.camera(160, 120), replace(view, distance=0.1 * view.distance).camera(160, 120)
    lines, _ = ground_grid(extent, extent.up, scene.metres_per_unit, scene.origin)
    poses = [pose_of(from_camera(one, extent)) for one in scene.cameras[:3]]
    flight = Flight(tuple(Keyframe(2.0 * at, pose) for at, pose in enumerate(poses)))
    paths = {"flight": flight, "turntable": turntable(view, 4.0)}
    filmed = {name: cameras_of(motion, extent, 2.0, (64, 48)) for name, motion in paths.items()}
    drawn = {
        display: Image(render_image(plain_request(scene, camera, PictureConfig(display)), "cpu") / 255)
        for display in ("rgb", "depth", "alpha")
    }
    return {
        **drawn,
        **{name: Places([one.position for one in cameras]) for name, cameras in filmed.items()},
        "close": Image(render(scene, close, profile=image_formation(scene, close)).colours),
        "near": Length([image_formation(scene, one).near for one in (camera, close)]),
        "depths": Length(depth_range(scene.gaussians, camera), by=0.01),
        "distance": Length(view.distance),
        "radius": Length([extent.radius, extent.farthest]),
        "everything": Length(frame_all(view, extent, (160, 120)).distance),
        "clicked": Places(clicked(scene, camera)),
        "lines": Near(len(lines), 2.01),
        "ground": Length((extent.centre - lines.mean((0, 1))) @ extent.up),
        "flown": Places(fly(view, 0.1 * extent.radius, 0, 0.2 * extent.radius).eye),
    }


def clicked(scene: Scene, camera: Camera) -> Array:
    """Return (3,) place under the middle of the window's image."""
    x, y = camera.width / 2, camera.height / 2
    with open_renderer("cpu") as renderer:
        depth = renderer.depth_at(plain_request(scene, camera, PictureConfig()), x, y)
    return camera.unproject([x, y], depth)


def answers(case: Case) -> Found:
    found: dict[str, Any] = {}
    for phrase in PHRASES:
        answer = run_phrase(case.engine, phrase, viewpoint=case.scene.cameras[0]).answer
        found |= {
            f"{phrase}: verdict": Same((answer.verdict, answer.level)),
            f"{phrase}: score": Near(answer.peak),
            f"{phrase}: members": Rows(answer.members),
        }
        if answer.found:
            found[f"{phrase}: place"] = Places(answer.place)
            sizes = [instance.count for instance in case.engine.instances(answer)]
            found[f"{phrase}: things"] = Same(len(sizes))
    return found


def words(case: Case) -> Found:
    describer, camera = Describer(case.engine), case.scene.cameras[1]
    pixel = (camera.width // 2, camera.height // 2)
    pointed = look_at_pixel(describer, camera, pixel)
    inventory = scene_inventory(describer)
    outline = scene_outline(describer)
    return {
        "pointed": Same([level.words[0].phrase if level.words else "" for level in pointed.words]),
        "place": Places(pointed.position),
        "depth": Length(pointed.depth),
        "inventory": Same([(entry.phrase, len(entry.spots)) for entry in inventory]),
        "centres": Places([spot.centre for entry in inventory for spot in entry.spots]),
        "outline": Same([len(outline), [node.word and node.word.phrase for node in outline]]),
    }


def selected(case: Case) -> Found:
    engine, scene, camera = case.engine, case.scene, case.scene.cameras[1]
    seen = selection.project(scene.gaussians.means, camera)
    box = selection.in_rectangle(seen, np.array([40.0, 30.0]), np.array([90.0, 80.0]))
    grown = selection.grow(engine.surface, box, 0.05 * scene.bounds()[1])
    depth = view_of(scene, camera).median_depth()
    engine.teach("that thing", box)
    again = engine.run("that thing")
    return {
        "box": Rows(box),
        "grown": Rows(grown),
        "shrunk": Rows(selection.shrink(engine.surface, grown, 0.03 * scene.bounds()[1])),
        "surface": Rows(selection.on_surface(seen, depth, (camera.width, camera.height))),
        "taught": Same(again.verdict),
        "alike": Rows(again.members),
    }


def smaller(case: Case) -> Found:
    views_ = choose_views(case.scene, None, BudgetConfig(max_psnr_loss=1.0, views=8), silent)
    measured = views_.measured(case.scene)
    kept, degree = find_reduction(case.scene, views_, measured, BudgetConfig(max_psnr_loss=1.0))
    cleaned, report = clean(case.scene, views_, CleanConfig(max_psnr_loss=0.5))
    return {
        "compact": Rows(kept),
        "degree": Same(degree),
        "clean": Rows(cleaned),
        "loss": Near(report.loss, 0.02),
    }


def surfaces(case: Case) -> Found:
    pytest.importorskip("open3d")
    from langsplat_core.extensions.geometry.mesh import close_holes, fuse
    from langsplat_core.extensions.geometry.occupancy import find_room

    mesh, side = fuse(case.scene, 0.02 * case.scene.bounds()[1])
    closed, _ = close_holes(mesh, side)
    ground = find_room(case.scene)
    loose = 0.02 if case.turned else 2e-3
    return {
        "triangles": Near(len(mesh.triangles), (0.05 if case.turned else 2e-3) * len(mesh.triangles)),
        "area": Length(mesh.areas().sum(), by=loose, power=2),
        "voxel": Length(side),
        "where": Surface(mesh.vertices, by=1.0 * side / case.scale),
        "closed": Length(closed.areas().sum(), by=3 * loose, power=2),
        "floor": Same(ground.has_floor),
        "height": Length(np.ptp(case.scene.gaussians.means @ ground.up), by=0.05),
    }


def mapped(case: Case) -> Found:
    """Files of a map, whose places are taken back to the world; cells lie along the axes of its ground."""
    pytest.importorskip("open3d")
    out, metres, cell = case.folder / "map", 1 / case.scale, 0.1
    case.run("map", case.path, out, "--metres-per-unit", metres, "--resolution", cell, "--goal", "table")
    with np.load(out / "voxels.npz") as voxels:
        cells, words, to_map = voxels["cells"], voxels["words"], voxels["to_map"]
        middles = voxels["origin"] + (cells + 0.5) * cell
    grid = yaml.safe_load((out / "map.yaml").read_text())
    lines = [line.split() for line in (out / "collider.obj").read_text().splitlines()]
    (goal,) = json.loads((out / "goals.json").read_text())
    flat = np.array([[*grid["origin"][:2], 0]])
    corners = np.array([line[1:] for line in lines if line[0] == "v"], float)
    back = np.linalg.inv(to_map[:3, :3]).T
    world = [(places - to_map[:3, 3]) @ back for places in (middles, corners, flat)]
    loose = 0.1 if case.turned else 0.01
    return {
        "occupied": Near(len(cells), loose * len(cells)),
        "words": Same(sorted(set(words.tolist()))),
        "voxels": Surface(world[0], by=cell),
        "collider": Surface(world[1], by=cell),
        # of equally near places, which is seen from follows from single cells
        "goal": Near(goal["distance"], cell),
        **({} if case.turned else {"grid": Places(world[2], by=2 * cell / room().bounds()[1])}),
    }


def changed(case: Case) -> Found:
    scene, gaussians = case.scene, case.scene.gaussians
    table, chair = (run_phrase(case.engine, phrase).answer.members for phrase in ("table", "chair"))
    offset = 0.3 * scene.bounds()[1] * scene.up()
    other = replace(
        gaussians,
        means=gaussians.means + np.outer(table, offset),
        sh=np.where(chair[:, None, None], -gaussians.sh, gaussians.sh),
    )
    engine = QueryEngine(replace(scene, gaussians=other), load_text_encoder)
    found = changes(case.engine, engine)
    assert found
    return {
        "kinds": Same([change.kind for change in found]),
        "places": Places([change.centre for change in found], by=0.01),
    }


def page(case: Case) -> Found:
    packed = pack_gaussians(case.scene.gaussians, case.scene.bounds()[0])
    widths = np.ptp(packed["ranges"][:3], axis=2).max(1)
    return {
        "near": Length(asdict(case.scene.raster_settings())["near"]),
        "views": Places([camera.position for camera in views(case.scene)]),
        "ranges": Length(np.linalg.norm(widths), by=1.0),
    }


def printed(case: Case) -> Found:
    """Commands read and print places of the world, with the digits of small lengths."""
    scene, path, folder = case.scene, case.path, case.folder / "scans"
    (answer,) = case.said("query", path, "ball")
    folder.mkdir()
    save_scene(folder / "one.ply", scene, tell=False)
    (hits,) = case.said("find", "ball", folder)
    inventory = case.said("describe", path)["inventory"]
    case.run("teach", path, "--name", "our ball", "--at", "{},{}".format(*answer["pixel"]))
    (taught,) = case.said("query", path, "our ball")
    ball = case.said("select", path, "ball", "--out", case.folder / "ball.ply")
    only = load_scene(case.folder / "ball.ply")
    asked = SceneTools({"room": path}).find("ball")
    found = {
        "verdict": Same([(one["verdict"], one["level"]) for one in (answer, taught)]),
        "pixel": Near(answer["pixel"], 1.01),
        "place": Places([answer["place"], taught["place"], *(hit["place"] for hit in hits["scenes"])]),
        "agent": Places(np.divide(asked["place"], scene.metres_per_unit or 1)),
        "inventory": Same([(entry["phrase"], len(entry["spots"])) for entry in inventory]),
        "spots": Places([spot["centre"] for entry in inventory for spot in entry["spots"]]),
        "things": Places([thing["centre"] for thing in ball["instances"]]),
        "only": Near(ball["written"], 0.01 * ball["written"]),
        "there": Places(only.in_world(only.gaussians.means).mean(0)),
    }
    if not case.turned:
        box, edges = np.array(answer["box"]), map(repr, np.ravel(answer["box"]).tolist())
        case.run("crop", path, case.folder / "crop.ply", "--box", *edges)
        crop = load_scene(case.folder / "crop.ply")
        found |= {
            "box": Places(box),
            "bounds": Places(case.said("inspect", path)["bounds"]),
            "cropped": Near(len(crop.gaussians), 0.01 * len(crop.gaussians)),
        }
    return found


def written(case: Case) -> Found:
    """Every format keeps a scene in any unit, and anywhere, as well as in its own."""
    drawn: dict[str, Any] = {}
    for suffix in (row.suffix for row in CORE_FORMATS):
        path, again = case.folder / f"kept{suffix}", case.scene
        try:
            case.run("convert", case.path, path)
            again = load_scene(path)
        except InputError:  # its own limits are said, not crossed
            assert suffix in (".spz", ".sog")
        least = 35.0 if suffix == ".spz" else 38.0  # it cuts sizes below 4.5e-5 units, and says so
        rounding = EXACT if suffix == ".ply" else 2e-3
        drawn |= {
            suffix: Image(render(again, again.cameras[3]).colours, least),
            f"{suffix}: cameras": Places([camera.position + again.origin for camera in again.cameras], EXACT),
            f"{suffix}: middle": Places(again.in_world(again.gaussians.means).mean(0), rounding),
        }
    return drawn


def trained(case: Case) -> Found:
    """A short training, of a drawn capture of its own."""
    small = capture()
    cameras = tuple(case.to.camera(camera) for camera in small.cameras)
    there = replace(small, cameras=cameras, points=case.to.points(small.points))
    gaussians = train_radiance(there, replace(SHORT, steps=200), range(len(there)))
    scores = evaluate_views(gaussians, there, range(len(there)), "cpu")
    return {
        "Gaussians": Near(len(gaussians), 0.05 * len(gaussians)),
        "psnr": Near(np.mean([score.psnr for score in scores]), 0.7),
        "size": Length(np.exp(np.median(gaussians.log_scales)), by=0.1),
    }


def moved(case: Case) -> Found:
    """A scene that commands turn, turn back and merge; images and films by files of cameras."""
    path, folder, scene = case.path, case.folder, case.scene
    case.run("transform", path, folder / "a.ply", "--rotate", "z", 30, "--scale", 2)
    case.run("transform", folder / "a.ply", folder / "b.ply", "--scale", 0.5)
    case.run("transform", folder / "b.ply", folder / "c.ply", "--rotate", "z", -30)
    back = load_scene(folder / "c.ply")
    case.run("merge", path, case.other, "--out", folder / "both.ply", "--as-is")
    both = load_scene(folder / "both.ply")
    answer = run_phrase(QueryEngine(both, load_text_encoder), "lamp").answer
    extent, origin = extent_of(scene), scene.origin
    keys = (Keyframe(float(at), pose_of(from_camera(scene.cameras[at], extent))) for at in range(2))
    write_flight(folder / "path.json", Flight(tuple(keys)).moved(origin))
    write_cameras(folder / "view.json", [scene.cameras[2].moved(origin)])
    view = ViewerOptions(path, camera=str(folder / "view.json"), out=folder / "view.png", headless=True)
    film = replace(view, camera="", size="160x120", path=folder / "path.json", out=folder / "film", fps=1.0)
    for options in (view, film):
        draw(replace(options, backend="cpu"), path, services(""))
    files_ = [folder / "view.png", *sorted((folder / "film").glob("*.png"))]
    drawn = {file.name: Image(np.asarray(PIL.Image.open(file)) / 255) for file in files_}
    return {
        **drawn,
        "back": Places(back.in_world(back.gaussians.means[::50]), EXACT),
        "cameras": Places([camera.position + back.origin for camera in back.cameras], EXACT),
        "drawn": Image(render(back, back.cameras[0]).colours),
        "both": Image(render(both, both.cameras[0]).colours),
        "end of both": Places(both.in_world(both.gaussians.means[-5:]), EXACT),
        "cameras of both": Places([camera.position + both.origin for camera in both.cameras], EXACT),
        "verdict": Same((answer.verdict, answer.level)),
    }


def exported(case: Case) -> Found:
    """Meshes, pages and checkpoints of other methods."""
    pytest.importorskip("open3d")
    path, folder = case.path, case.folder
    case.run("mesh", path, folder / "mesh.ply", "--resolution", 0.08)
    vertices = PlyData.read(folder / "mesh.ply")["vertex"]
    case.run("export", path, folder / "page.html")
    packed = re.search(r'id="data"[^>]*>([^<]+)<', (folder / "page.html").read_text())[1]
    unpacked = zlib.decompress(b64decode(packed))
    size = int.from_bytes(unpacked[:8], "little")
    meta = json.loads(json.loads(unpacked[8 : 8 + size])["__metadata__"]["page"])
    scene, files_ = load_scene(path), [folder / f"chkpnt30000_langfeat_{level}.pth" for level in (1, 2, 3)]
    for file in files_:
        vectors = np.full((len(scene.gaussians), 512), 512**-0.5, np.float32)
        write_checkpoint(file, scene.gaussians, vectors, scene.origin)
    case.run("convert", *files_, folder / "again.ply", "--encoder", "demo")
    again = load_scene(folder / "again.ply")
    return {
        "mesh": Surface(np.stack([vertices[axis] for axis in "xyz"], 1), by=0.08),
        "page": Places([np.add(meta["origin"], view["position"]) for view in meta["views"]], EXACT),
        "places": Places(load(unpacked)["places"], EXACT),
        "checkpoints": Places(again.in_world(again.gaussians.means[::50]), EXACT),
    }


LAWS: dict[str, Callable[[Case], Found]] = {
    law.__name__: law
    for law in (
        *(images, framed, window, answers, words, selected, smaller, surfaces, mapped, changed),
        *(page, printed, written, trained, moved, exported),
    )
}
FAST = ("images", "framed", "window", "answers", "page")  # in the quick suite
PLACED = ("printed", "written", "mapped", "moved", "exported")  # by files, in the world
TO = {scale: (SHIFT if scale in (1e-2, 1e2) else TURN.then(SHIFT)).then(scaling(scale)) for scale in SCALES}
ORIGINS = {"UTM": (5e5, 4.6e6, 120.0), "ECEF": (4e6, 6e5, 5e6)}


@cache
def wanted(name: str) -> Found:
    with TemporaryDirectory() as folder:
        return LAWS[name](Case(room(), Path(folder)))


def difference(a: Any, one: Any, to: Similarity) -> str:  # noqa: PLR0911  one of each kind
    """Return how `one` that came of the transformed scene differs from `a`; empty where it does not."""
    b = one.value
    match one:
        case Same():
            return "" if a == b else f"{a} became {b}"
        case Near():
            return "" if np.all(np.abs(np.subtract(a, b)) <= one.by) else f"{a} became {b}"
        case Image():
            assert a.max() > 0.05
            return "" if (decibels := psnr(a, b)) >= one.least else f"{decibels:.1f} dB"
        case Rows():
            both, either = np.count_nonzero(a & b), np.count_nonzero(a | b)
            return "" if both >= 0.99 * either else f"{both} of {either} are in both"
        case Length():
            ratio = np.asarray(b) / (to.scale**one.power * np.asarray(a))
            return "" if (np.abs(ratio - 1) <= one.by).all() else f"times {ratio}"
        case Surface():
            there = to.points(a)
            gaps = [cKDTree(x).query(y)[0] / to.scale for x, y in ((there, b), (b, there))]
            far = max(float(np.quantile(gap, 0.9)) for gap in gaps)
            return "" if far <= one.by else f"{far / one.by:g} times too far"
        case _:
            away = np.linalg.norm(np.asarray(b) - to.points(np.asarray(a)), axis=-1).max(initial=0)
            far = away / (to.scale * room().bounds()[1])
            return "" if far <= one.by else f"{far:g} of the radius away"


def check(name: str, case: Case) -> None:
    want, got = wanted(name), LAWS[name](case)
    assert got.keys() <= want.keys()
    differing = {key: difference(want[key].value, one, case.to) for key, one in got.items()}
    assert not any(differing.values()), {key: said for key, said in differing.items() if said}


@pytest.mark.parametrize("scale", QUICK)
@pytest.mark.parametrize("name", FAST)
def test_images_and_answers_have_no_unit(name, scale, tmp_path):
    check(name, Case(transform_scene(room(), TO[scale]), tmp_path, TO[scale]))


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", [name for name in LAWS if name != "exported"])
def test_nothing_depends_on_the_unit(name, scale, tmp_path):
    check(name, Case(transform_scene(room(), TO[scale]), tmp_path, TO[scale]))


def far(place: str, folder: Path) -> Case:
    """The room where float32 has no digits left for it."""
    return Case(replace(room(), origin=np.array(ORIGINS[place])), folder, moving(np.array(ORIGINS[place])))


@pytest.mark.parametrize("name", ["written", pytest.param("printed", marks=pytest.mark.long)])
def test_files_of_far_scenes_are_of_the_world(name, tmp_path):
    check(name, far("UTM", tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("place", ORIGINS)
@pytest.mark.parametrize("name", PLACED)
def test_nothing_depends_on_the_origin(name, place, tmp_path):
    check(name, far(place, tmp_path))

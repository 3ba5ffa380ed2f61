"""What is seen, found, measured and made depends neither on the length of a unit nor on where a scene lies.

A law is a function from a scene to what comes of it: `Same` is equal, `Image`s look alike, `Rows` are
nearly the same Gaussians, `Length`s are times the scale, `Places` move along.
"""

import json
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from importlib.resources import files
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from langsplat_core import load_scene, render, view_of
from langsplat_core.arrays import Array, psnr
from langsplat_core.cli.app import parse
from langsplat_core.config import PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.extensions.compaction.clean import CleanConfig, clean
from langsplat_core.extensions.compaction.compact import BudgetConfig, choose_views, find_reduction
from langsplat_core.extensions.library.changes import changes
from langsplat_core.io.scenes import save_scene, writable_suffixes
from langsplat_core.pipeline.webpage import pack_gaussians, views
from langsplat_core.progress import silent
from langsplat_core.query import selection
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.describe import Describer, look_at_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.inventory import scene_inventory, scene_outline
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import Scene
from langsplat_core.scene.transform import IDENTITY, Similarity, moving, rotating, scaling, transform_scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.trainer import train_radiance
from langsplat_viewer.camera.controls import default_view, extent_of, from_camera
from langsplat_viewer.camera.flight import Flight, Keyframe, Motion, pose_of, turntable
from langsplat_viewer.output import cameras_of
from langsplat_viewer.rendering.request import depth_range, image_formation, plain_request
from tests.support.scenes import SHORT, capture
from tests.support.windowless import render_image

DEMO = Path(str(files("langsplat_assets"))) / "demo" / "scene.ply"
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


Found = Mapping[str, Same | Near | Image | Rows | Length | Places]


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with what laws ask of it."""

    scene: Scene
    folder: Path
    scale: float  # length of what was a unit

    @cached_property
    def engine(self) -> QueryEngine:
        return QueryEngine(self.scene, load_text_encoder)

    @cached_property
    def path(self) -> Path:
        save_scene(self.folder / "scene.ply", self.scene)
        return self.folder / "scene.ply"

    def said(self, *words: str) -> Any:
        """Return what a command prints as JSON."""
        with redirect_stdout(StringIO()) as printed:
            parse([*words, "--json"]).run()
        return json.loads(printed.getvalue())


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
    scene = case.scene
    drawn = {str(at): Image(render(scene, camera).colours) for at, camera in enumerate(scene.cameras[::4])}
    depth = view_of(scene, scene.cameras[0]).median_depth()
    return drawn | {"depth": Length(np.quantile(depth, (0.3, 0.5, 0.9))), "near": Length(scene.near)}


def framed(case: Case) -> Found:
    scene = replace(case.scene, cameras=())
    cameras = [scene.framing_camera((160, 120)), *scene.spiral_cameras(2, (120, 90))]
    drawn = {str(at): Image(render(scene, camera).colours) for at, camera in enumerate(cameras)}
    centre, radius = scene.bounds()
    return drawn | {"near": Length(scene.near), "radius": Length(radius), "centre": Places(centre)}


def window(case: Case) -> Found:
    scene, extent = case.scene, extent_of(case.scene)
    view = default_view(scene, extent, (160, 120))
    camera, close = view.camera(160, 120), replace(view, distance=0.1 * view.distance).camera(160, 120)
    flight = Flight(
        tuple(
            Keyframe(2.0 * at, pose_of(from_camera(one, extent))) for at, one in enumerate(scene.cameras[:3])
        )
    )
    paths: dict[str, Motion] = {"flight": flight, "turntable": turntable(view, 4.0)}
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
        "radius": Length(extent.radius),
    }


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
    pointed = look_at_pixel(load_lifting_rasterizer("cpu"), describer, camera, pixel)
    assert pointed is not None
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
    from langsplat_core.extensions.geometry.planes import find_room

    mesh, side = fuse(case.scene, 0.02 * case.scene.bounds()[1])
    closed, _ = close_holes(mesh, side)
    ground = find_room(case.scene)
    return {
        "triangles": Near(len(mesh.triangles), 0.01 * len(mesh.triangles)),
        "area": Length(mesh.areas().sum(), by=0.01, power=2),
        "voxel": Length(side),
        "middle": Places(mesh.vertices.mean(0), by=0.01),
        "closed": Length(closed.areas().sum(), by=0.03, power=2),
        "floor": Same(ground.floor is not None),
        "height": Length(np.ptp(case.scene.gaussians.means @ ground.up), by=0.05),
    }


def mapped(case: Case) -> Found:
    pytest.importorskip("open3d")
    from langsplat_core.extensions.geometry.occupancy import find_occupancy, floor_map, map_axes
    from langsplat_core.extensions.geometry.planes import find_room

    metres = case.scene.metres_per_unit or 1 / case.scale
    occupancy = find_occupancy(case.scene, map_axes(find_room(case.scene), metres), 0.1)
    plan = floor_map(occupancy, 0.15, 0.6)
    return {
        "occupied": Near(int(occupancy.occupied.sum()), 0.05 * occupancy.occupied.sum()),
        "free": Near(int(plan.free.sum()), 0.05 * plan.free.sum() + 5),
    }


def placed(case: Case) -> Found:
    pytest.importorskip("open3d")
    from langsplat_core.extensions.geometry.registration import register

    away = rotating(np.array([0.0, 1.0, 0.0]), 4.0).then(moving(0.05 * case.scale * np.ones(3)))
    moved = transform_scene(case.scene, away)
    found = register(moved, case.scene)
    wider = register(transform_scene(case.scene, scaling(3.0)), case.scene, scaled=True)
    return {
        "trusted": Same((found.trusted, wider.trusted)),
        "scale": Near(wider.scale, 0.01),
        "back": Length(np.linalg.norm(similarity_error(found.transform, away, case)), by=0.02),
    }


def similarity_error(transform: Array, away: Similarity, case: Case) -> Array:
    """(N, 3) by which points come back; a hundredth of the radius is added, so that lengths compare."""
    points = case.scene.gaussians.means[::50].astype(np.float64)
    back = away.points(points) @ transform[:3, :3].T + transform[:3, 3]
    return np.asarray(np.maximum(np.abs(back - points), 0.02 * case.scene.bounds()[1]))


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
    found = changes(case.engine, engine, load_lifting_rasterizer("cpu"))
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
        "views": Places([np.array(view["position"]) + case.scene.bounds()[0] for view in views(case.scene)]),
        "ranges": Length(np.linalg.norm(widths), by=1.0),
    }


def printed(case: Case) -> Found:
    """What commands print keeps the digits of small lengths."""
    scene, path = case.scene, str(case.path)
    (answer,) = case.said("query", path, "ball")
    summary = case.said("inspect", path)
    folder = case.folder / "scans"
    folder.mkdir()
    save_scene(folder / "one.ply", scene)
    (hits,) = case.said("find", "ball", str(folder))
    return {
        "verdict": Same((answer["verdict"], answer["level"])),
        "pixel": Near(answer["pixel"], 1.01),
        "place": Places(answer["place"]),
        "box": Places(answer["box"]),
        "bounds": Places(summary["bounds"]),
        "hits": Same(len(hits["scenes"])),
        "found at": Places([hit["place"] for hit in hits["scenes"]]),
    }


def written(case: Case) -> Found:
    """Every format keeps a scene in any unit as well as in its own."""
    drawn: dict[str, Any] = {}
    for suffix in writable_suffixes():
        path = case.folder / f"kept{suffix}"
        again = case.scene
        try:
            save_scene(path, replace(case.scene, path=path))
            again = replace(load_scene(path), cameras=case.scene.cameras)
        except InputError:  # its own limits are said, not crossed
            assert suffix in (".spz", ".sog")
        least = 35.0 if suffix == ".spz" else 38.0  # it cuts sizes below 4.5e-5 units, and says so
        drawn[suffix] = Image(render(again, again.cameras[3]).colours, least)
    return drawn


def trained(case: Case) -> Found:
    """A short training, of a drawn capture of its own."""
    to, small = scaling(case.scale), capture()
    cameras = tuple(to.camera(camera) for camera in small.cameras)
    there = replace(small, cameras=cameras, points=to.points(small.points))
    gaussians = train_radiance(there, replace(SHORT, steps=200), range(len(there)))
    scores = evaluate_views(gaussians, there, range(len(there)), "cpu")
    return {
        "Gaussians": Near(len(gaussians), 0.05 * len(gaussians)),
        "psnr": Near(np.mean([score.psnr for score in scores]), 0.7),
        "size": Length(np.exp(np.median(gaussians.log_scales)), by=0.1),
    }


# What stands along the axes of its world, or takes its middle along them, is not turned; voxels lie on a grid
# that begins at the origin, which is not moved.
TURNED: tuple[Callable[[Case], Found], ...] = (images, answers, words, selected, smaller, placed, changed)
UPRIGHT: tuple[Callable[[Case], Found], ...] = (framed, window, mapped, page, printed, written)
SCALED: tuple[Callable[[Case], Found], ...] = (surfaces, trained)
LAWS = {law.__name__: law for law in (*TURNED, *UPRIGHT, *SCALED)}
FAST = ("images", "framed", "window", "answers", "page")  # in the quick suite


def found(name: str, scale: float, folder: Path) -> tuple[Found, Similarity]:
    law = LAWS[name]
    place = TURN.then(SHIFT) if law in TURNED else SHIFT if law in UPRIGHT else IDENTITY
    to = place.then(scaling(scale))
    return LAWS[name](Case(transform_scene(room(), to), folder, scale)), to


@cache
def wanted(name: str) -> Found:
    with TemporaryDirectory() as folder:
        return LAWS[name](Case(room(), Path(folder), 1.0))


def difference(one: Any, b: Any, to: Similarity) -> str:
    """Return how what came of the transformed scene differs; empty where it does not."""
    a = one.value
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
        case _:
            away = np.linalg.norm(np.asarray(b) - to.points(np.asarray(a)), axis=-1).max(initial=0)
            far = away / (to.scale * room().bounds()[1])
            return "" if far <= one.by else f"{far:g} of the radius away"


def check(name: str, scale: float, folder: Path) -> None:
    got, to = found(name, scale, folder)
    want = wanted(name)
    assert want.keys() == got.keys()
    differing = {key: difference(want[key], got[key].value, to) for key in want}
    assert not any(differing.values()), {key: said for key, said in differing.items() if said}


@pytest.mark.parametrize("scale", QUICK)
@pytest.mark.parametrize("name", FAST)
def test_images_and_answers_have_no_unit(name, scale, tmp_path):
    check(name, scale, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", LAWS)
def test_nothing_depends_on_the_unit(name, scale, tmp_path):
    check(name, scale, tmp_path)

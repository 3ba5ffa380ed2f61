"""The bundled scene and encoder, asked as a user would ask, against the truth of the room.

The views are ones that training held out; the truth comes from the room's geometry, which training never
saw. The floors asserted are below the figures in docs/answers.md by a margin for another machine's
rounding.
"""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from assets.making.dataset import LIGHT, orbit_cameras, photographed_room, truth_ids
from assets.making.render import Renderer
from assets.making.scene import SEED, SIZE, VIEWS
from langsplat_core.config import PictureConfig
from langsplat_core.errors import EncoderError
from langsplat_core.evaluation.report import intersection_over_union
from langsplat_core.io.scenes import load_scene
from langsplat_core.query.answers import peak_pixel, splatted_relevancy
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_rasterizer
from langsplat_core.scene import Camera, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from tests.benchmarks.scoring import cut_level, majority

pytestmark = pytest.mark.long

ASSETS = Path(str(files("langsplat_assets")))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(ASSETS / "demo" / "scene.ply")


@pytest.fixture(scope="module")
def engine(scene: Scene) -> QueryEngine:
    return QueryEngine(scene, load_text_encoder)


@pytest.fixture(scope="module")
def held_out(scene: Scene) -> list[tuple[Camera, np.ndarray]]:
    """Three views that training did not see, and their label ids."""
    trained = {camera.name for camera in scene.cameras}
    cameras = [camera for camera in orbit_cameras(VIEWS, SIZE, SEED) if camera.name not in trained][:3]
    world = photographed_room(SEED)
    renderer = Renderer(world, LIGHT, samples=1)  # labels need no light
    return [(camera, truth_ids(world, renderer.picture(camera, oversample=1))) for camera in cameras]


def test_it_is_small_enough_to_ship_and_has_everything_a_query_needs(scene):
    size = sum(path.stat().st_size for path in ASSETS.rglob("*") if path.is_file())
    assert size < 21e6
    assert scene.language is not None
    assert scene.language.encoder_id == "demo"
    assert scene.gaussians.valid().all()
    assert len(scene.cameras) > 40
    assert (scene.language.confidence > 0).mean() > 0.99


def ask(engine: QueryEngine, phrase: str, thing: str, held_out) -> tuple[list[float], list[bool]]:
    """IoU and hits of one phrase in the views where its thing is visible."""
    answer = engine.run(phrase)
    typical = float(np.median(answer.relevancy[answer.level]))
    labels = photographed_room(SEED).labels
    ids = [number for number, label in enumerate(labels) if label.level == 2 and label.thing == thing]
    overlaps, hits = [], []
    for camera, truth in held_out:
        mask = np.isin(truth[2], ids)
        if mask.sum() < 400:
            continue
        view = load_rasterizer("cpu").view(engine.scene.gaussians, camera)
        relevancy = splatted_relevancy(
            view, answer.relevancy[answer.level][:, None], PictureConfig().alpha_gate
        )
        relevancy = relevancy[..., 0]
        found = majority(relevancy > cut_level("median", relevancy, answer.peak, typical))
        overlaps.append(intersection_over_union(found, mask))
        column, row, _ = peak_pixel(relevancy, 20)
        hits.append(bool(mask[row, column]))
    return overlaps, hits


def test_typed_words_find_their_things(engine, held_out):
    things = {
        "blue gift": "gift",
        "teddy bear": "teddy bear",
        "orange airplane": "airplane",
        "burger": "burger",
        "turquoise teapot": "teapot",
        "duck": "duck",
    }
    overlaps, hits = [], []
    for phrase, thing in things.items():
        more, hit = ask(engine, phrase, thing, held_out)
        overlaps += more
        hits += hit
    assert len(hits) >= 16  # of 18
    assert np.mean(hits) >= 0.9  # 1.0 measured
    assert np.mean(overlaps) >= 0.62  # 0.70 measured


def test_place_is_where_the_thing_is(engine):
    """In metres, against the vertices of the gift."""
    world = photographed_room(SEED)
    whole = world.ids[world.piece_of][:, 2]
    gift = [number for number, label in enumerate(world.labels) if label.level == 2 and label.thing == "gift"]
    corners = world.vertices[world.triangles[np.isin(whole, gift)]].reshape(-1, 3)
    answer = engine.run("blue gift")
    assert answer.found
    assert answer.place is not None
    assert np.linalg.norm(corners - answer.place, axis=1).min() < 0.05


def test_an_unknown_word_is_named(engine):
    with pytest.raises(EncoderError, match="'zebra'"):
        engine.run("zebra")

"""What lies under a pixel, against the whole picture of the reference rasterizer."""

import numpy as np
import pytest

from langsplat_core.query.describe import Describer, look_at_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from tests.support.fakes import CENTRES, FakeEncoder, blob_scene


@pytest.fixture(scope="module")
def describer() -> Describer:
    engine = QueryEngine(blob_scene(), lambda encoder_id: FakeEncoder())
    return Describer(engine, ("mug", "book", "plant"))


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("thing", range(3))
def test_place_words_and_relevancy_are_those_of_the_pixel(describer, backend, thing):
    engine, scene = describer.engine, describer.engine.scene
    camera = scene.cameras[0].resized(160, 120)
    (x, y), _ = (part[0] for part in camera.project(CENTRES[thing][None]))
    pixel = (int(x), int(y))
    results = [engine.run(phrase) for phrase in ("mug", "book", "plant")]
    rasterizer = ReferenceRasterizer() if backend == "reference" else load_lifting_rasterizer("cpu")
    found = look_at_pixel(rasterizer, describer, camera, pixel, results)

    view = ReferenceRasterizer().view(scene.gaussians, camera, scene.raster_settings())
    columns = np.stack([result.relevancy[result.level] for result in results], 1)
    total, alpha = view.splat(columns.astype(np.float64))
    expected = total[pixel[1], pixel[0]] / alpha[pixel[1], pixel[0]]
    np.testing.assert_allclose(found.relevancy, expected, atol=2e-4)
    assert int(np.argmax(found.relevancy)) == thing
    assert found.words[2].words[0].phrase == ("mug", "book", "plant")[thing]
    assert np.linalg.norm(found.position - CENTRES[thing]) < 0.6  # on the blob, towards the eye
    np.testing.assert_allclose(camera.project(found.position[None])[0][0], np.add(pixel, 0.5), atol=1e-6)
    assert found.depth == pytest.approx(camera.project(found.position[None])[1][0])


def test_the_surface_is_at_the_median_of_the_weights(describer):
    scene = describer.engine.scene
    camera = scene.cameras[0].resized(160, 120)
    (x, y), _ = (part[0] for part in camera.project(CENTRES[0][None]))
    found = look_at_pixel(ReferenceRasterizer(), describer, camera, (int(x), int(y)))
    view = ReferenceRasterizer().view(scene.gaussians, camera, scene.raster_settings())
    one = np.zeros((120, 160, 1))
    one[int(y), int(x)] = 1
    weights = view.gather(one)[:, 0]
    depths = camera.project(scene.gaussians.means.astype(np.float64))[1]
    in_front = weights[depths < found.depth - 1e-9].sum()
    assert in_front < weights.sum() / 2 <= in_front + weights[np.abs(depths - found.depth) < 1e-6].sum()


def test_where_nothing_is_nothing_is_said(describer):
    camera = describer.engine.scene.cameras[0].resized(160, 120)
    assert look_at_pixel(load_lifting_rasterizer("cpu"), describer, camera, (0, 0)) is None

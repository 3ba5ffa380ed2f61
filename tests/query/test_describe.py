"""Words for Gaussians, for a pixel, for a scene."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.errors import EncoderError, InputError
from langsplat_core.query import describe
from langsplat_core.query.describe import Describer, field_meanings, same_things
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import connected_parts
from langsplat_core.query.surface import surface_areas
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import Gaussians, Scene
from tests.support.blob_words import NAMES, named_field, named_scene
from tests.support.fakes import CENTRES, PER_BLOB, WORDS, FakeEncoder, axis, blob_scene


@pytest.fixture(autouse=True)
def few_attributes(monkeypatch):
    """The bundled lists are real words, of which the fake encoder knows three."""
    lists = {"things": ("mug", "book"), "parts": ("plant", "handle"), "colours": ("red",), "materials": ()}
    monkeypatch.setattr(describe, "bundled_vocabulary", lists.__getitem__)


def describer(scene: Scene, vocabulary=NAMES) -> Describer:
    return Describer(QueryEngine(scene, lambda _: FakeEncoder()), vocabulary)


@pytest.mark.parametrize("codebook", [True, False])
def test_every_blob_is_its_word(codebook):
    asked = describer(named_scene(codebook))
    for number, word in enumerate(WORDS):
        rows = np.arange(number * PER_BLOB, (number + 1) * PER_BLOB)
        subpart, part, whole = asked.at_gaussians(rows)
        assert subpart.words == ()
        assert subpart.known == 0
        assert whole.words[0].phrase == word
        assert whole.words[0].probability > 0.95
        assert whole.known == 1
        assert sum(found.probability for found in whole.words) + whole.other == pytest.approx(1)
        if not codebook:  # at "part" all mean 0.8 of a canonical phrase and 0.6 of "plant"
            assert part.words[0].phrase == "plant"
            assert part.other > part.words[0].probability


def test_a_mask_is_as_good_as_numbers_and_weights_count():
    asked = describer(named_scene())
    mask = np.zeros(3 * PER_BLOB, bool)
    mask[[0, PER_BLOB]] = True
    two = asked.at_gaussians(mask, np.array([3.0, 1.0]))[2]
    assert two == asked.at_gaussians(np.array([0, PER_BLOB]), np.array([3.0, 1.0]))[2]
    assert [word.phrase for word in two.words[:2]] == ["mug", "book"]
    np.testing.assert_allclose([word.probability for word in two.words[:2]], [0.75, 0.25], atol=0.01)
    assert len(asked.at_gaussians(mask, top=1)[2].words) == 1


def test_gaussians_without_a_surface_still_mean_something():
    scene = named_scene()
    shape = scene.gaussians
    flat = Gaussians(shape.means, np.full_like(shape.log_scales, -np.inf), *(
        shape.quats_wxyz, shape.opacity_logits, shape.sh
    ))  # fmt: skip
    asked = describer(replace(scene, gaussians=flat))
    assert asked.at_gaussians(np.array([0]))[2].words[0].phrase == "mug"
    assert asked.at_gaussians(np.zeros(0, int))[2].words == ()


@pytest.mark.parametrize("codebook", [True, False])
def test_a_pixel_blends_probabilities_by_the_rows_of_w(codebook):
    """Against float64: the reference's weights at the pixel, and every Gaussian's own words."""
    scene = named_scene(codebook)
    asked, camera = describer(scene), scene.cameras[1]
    view = load_lifting_rasterizer("reference").view(scene.gaussians, camera)
    for centre in [*CENTRES, (CENTRES[0] + CENTRES[1]) / 2 + (-0.15, 0, 0)]:
        (column, row), _ = camera.project(centre[None])[0].astype(int)[0], None
        image = np.zeros((camera.height, camera.width, 1))
        image[row, column] = 1
        weights = view.gather(image)[:, 0]
        if weights.sum() <= 0.3:
            continue
        words = asked.words[2]
        own = words.probabilities(asked.engine.field.codec, asked.engine.field.latents[2]).astype(np.float64)
        want = weights @ own / weights.sum()
        got = asked.at_pixel(load_lifting_rasterizer("cpu"), camera, (int(column), int(row)), top=4)[2]
        for word in got.words:
            expected = want[words.phrases.index(word.phrase)]
            assert word.probability == pytest.approx(expected, abs=1e-4)


def test_a_pixel_that_shows_nothing_has_no_words():
    scene = named_scene()
    levels = describer(scene).at_pixel(load_lifting_rasterizer("cpu"), scene.cameras[1], (0, 0))
    assert [words.words for words in levels] == [(), (), ()]


@pytest.mark.parametrize("codebook", [True, False])
def test_the_inventory_lists_what_is_there_where_it_is(codebook):
    entries = {entry.phrase: entry for entry in describer(named_scene(codebook)).inventory()}
    assert set(entries) == set(WORDS)
    for centre, word in zip(CENTRES, WORDS, strict=True):
        entry = entries[word]
        assert entry.level == 2
        assert entry.probability > 0.95
        assert entry.share == pytest.approx(1 / 3, abs=0.02)
        (spot,) = entry.spots
        np.testing.assert_allclose(spot.centre, centre, atol=0.1)
        assert (spot.box[0] < spot.centre).all()
        assert (spot.centre < spot.box[1]).all()
        assert len(spot.rows) > 0.95 * PER_BLOB


def test_two_names_of_one_thing_are_one_entry(monkeypatch):
    field = named_field()
    field = replace(field, phrasebook={**field.phrasebook, "cup": axis(0), "beaker": axis(0)})
    asked = describer(replace(named_scene(), language=field), (*NAMES, "cup", "beaker"))
    entries = [entry for entry in asked.inventory() if "mug" in (entry.phrase, *entry.also)]
    assert [{entry.phrase, *entry.also} for entry in entries] == [{"mug", "cup", "beaker"}]
    assert entries[0].probability > 0.95  # of all three together


def test_one_word_in_two_places_has_two_spots():
    field = named_field()
    codes = field.latents.copy()
    codes[2, 2 * PER_BLOB :] = 0  # the third blob is another mug
    asked = describer(replace(named_scene(), language=replace(field, latents=codes)))
    (mug,) = [entry for entry in asked.inventory() if entry.phrase == "mug"]
    assert len(mug.spots) == 2
    assert sorted(float(spot.centre[0]) for spot in mug.spots) == pytest.approx([-1.2, 1.2], abs=0.1)


def test_what_a_query_does_not_find_is_not_listed():
    """The best word of a foreign list may still be wrong: the canonical phrases are nearer."""
    assert describer(named_scene(), ("wall",)).inventory() == []


def test_the_bundled_parts_are_not_offered_for_whole_things():
    asked = describer(named_scene(), None)
    assert asked.words[2].phrases == ("mug", "book")
    assert asked.words[0].phrases == asked.words[1].phrases == ("mug", "book", "plant")
    assert asked.left_out == ("handle",)


def test_vocabularies_that_cannot_be_used():
    with pytest.raises(InputError, match="knows none of the vocabulary's 2 phrases"):
        describer(named_scene(), ("sofa", "lamp"))
    with pytest.raises(InputError, match="no language field"):
        describer(blob_scene(field=False))
    with pytest.raises(EncoderError, match="without a text encoder"):
        Describer(QueryEngine(named_scene()), ("sofa",))


def test_places_that_are_not_there():
    asked = describer(named_scene())
    with pytest.raises(InputError, match="Gaussian 360: the scene has Gaussians 0 to 359"):
        asked.at_gaussians(np.array([0, 360]))
    with pytest.raises(InputError, match="pixel 160 3: the picture has columns 0 to 159 and rows 0 to 119"):
        asked.at_pixel(load_lifting_rasterizer("cpu"), named_scene().cameras[0], (160, 3))


def test_groups_of_words_that_claim_the_same():
    surface = np.array([2.0, 1.0, 1.0, 4.0])
    mug = np.array([0.5, 0.5, 0, 0])
    cup = np.array([0.45, 0.4, 0.1, 0])
    vague = np.array([0.05, 0.1, 0.9, 0.4])  # everywhere a little: a name for neither
    names = np.stack([vague, mug, cup], 1)
    assert same_things(names, surface) == [[0], [1, 2]]
    assert same_things(np.zeros((0, 0)), np.zeros(0)) == []


def test_surface_of_gaussians():
    shape = named_scene().gaussians
    scales = np.log(np.tile([0.3, 0.02, 0.1], (len(shape), 1)))
    logits = np.zeros(len(shape))
    means = shape.means.copy()
    means[0] = np.nan
    scales[1] = np.log(50.0)  # a veil
    areas = surface_areas(Gaussians(means, scales, shape.quats_wxyz, logits, shape.sh))
    np.testing.assert_allclose(areas[2:], 0.5 * 0.3 * 0.1, rtol=1e-5)
    assert areas[0] == 0
    assert areas[1] == pytest.approx(0.015)
    assert len(surface_areas(shape.take(np.zeros(0, int)))) == 0


def test_meanings_of_fields_without_codewords_are_the_gaussians_own():
    made = named_field(codebook=False)
    held = field_meanings(made)
    assert (held.of[0] == -1).all()
    np.testing.assert_array_equal(held.latents[held.of[2]], made.latents[2])


def test_parts_of_nothing_and_of_two_blobs():
    surface = QueryEngine(named_scene()).surface
    assert connected_parts(surface, np.zeros(0, int)).each() == []
    rows = np.concatenate([np.arange(PER_BLOB), np.arange(2 * PER_BLOB, 3 * PER_BLOB)])  # two that are apart
    numbers = np.flatnonzero(np.isin(surface.rows, rows))
    found = connected_parts(surface, numbers).each()
    parts = [surface.rows[part] for part in found if len(part) > 1]
    assert {frozenset((part // PER_BLOB).tolist()) for part in parts} == {frozenset({0}), frozenset({2})}

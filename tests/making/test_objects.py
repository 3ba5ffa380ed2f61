"""Every class of object: builds, stands, nests, has words of its own."""

from collections import defaultdict
from itertools import chain

import numpy as np
import pytest

from assets.making.kit import COLOUR_SYNONYMS, COLOURS, Kit
from assets.making.objects import EVERYTHING, TABLE_TOP
from assets.making.vocabulary import CATEGORIES, MATERIALS, label_region, object_words, part_words
from assets.making.world import bounds
from langsplat_core.scene import CANONICAL_PHRASES

pytestmark = pytest.mark.long

SEEDS = 10
# Words that are right for two things because they are the same thing, or that no phrase can tell apart:
# the fruit and the colour; a room's walls and a house's; the hat that a snowman wears.
SHARED = {"orange", "wall", "floor", "rug", "hat"}


def build(name, seed):
    builder, words = EVERYTHING[name]
    return builder(Kit(np.random.default_rng((seed, 17))), words[seed % len(words)])


def radius_of(thing):
    return max(np.linalg.norm(piece.mesh.vertices[:, :2], axis=1).max() for piece in thing.pieces)


def labels_of(thing, piece):
    return [label_region(level, thing, piece) for level in range(3)]


@pytest.fixture(scope="module")
def things():
    return {name: [build(name, seed) for seed in range(SEEDS)] for name in EVERYTHING}


@pytest.mark.parametrize("name", EVERYTHING)
def test_meshes_are_sound_and_stand_where_they_should(name, things):
    for thing in things[name]:
        assert thing.word == name
        assert thing.colour in ("", *COLOURS)
        for piece in thing.pieces:
            mesh = piece.mesh
            assert len(mesh.triangles) > 0
            assert np.isfinite(mesh.vertices).all()
            np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
            assert mesh.triangles.min() >= 0
            assert mesh.triangles.max() < len(mesh.vertices)
        triangles = sum(len(piece.mesh.triangles) for piece in thing.pieces)
        assert triangles < (6500 if name != "table" else 45_000)  # its top shows fine shadows
        (_, _, lowest), (_, _, height) = bounds(thing)
        radius = radius_of(thing)
        assert -0.006 < lowest < 0.02
        assert (0.04 < radius < 0.26) if name in TABLE_TOP else (0.15 < radius < 1.4)
        assert (0.01 < height < 0.4) if name in TABLE_TOP else (0.4 < height < 1.6)
    thing = things[name][0]
    extent = max(radius_of(thing), bounds(thing)[1][2] / 2)
    for piece in thing.pieces:
        p = piece.mesh.vertices[piece.mesh.triangles]
        face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        against = (face * piece.mesh.normals[piece.mesh.triangles].mean(1)).sum(1) < 0
        area = np.linalg.norm(face, axis=1)
        # A few slivers of round ends and ruffles may disagree.
        assert area[against].sum() < 0.02 * area.sum(), (piece.part, piece.subpart)
        # A region far below a hundredth of its thing would be no use in any picture.
        assert np.ptp(piece.mesh.vertices, axis=0).max() / extent > 0.05, (piece.part, piece.subpart)


@pytest.mark.parametrize("name", EVERYTHING)
def test_parts_are_named_and_nested(name, things):
    names = [{(piece.part, piece.subpart) for piece in thing.pieces} for thing in things[name]]
    assert len(names[0]) >= 2
    assert all(other == names[0] for other in names)  # the same words whatever the seed
    for part, subpart in names[0]:
        assert part not in ("", subpart, name)
        assert part.replace(" ", "").isalpha()
        assert subpart.replace(" ", "").isalpha() or not subpart
    for thing in things[name][:2]:
        for piece in thing.pieces:
            labels = labels_of(thing, piece)
            assert [label.thing for label in labels] == [name] * 3
            assert labels[2].word == name
            assert set(labels[0].hues) <= set(labels[1].hues) <= set(labels[2].hues)
            assert set(labels[0].materials) <= set(labels[1].materials) <= set(labels[2].materials)
            assert all(label.material in ("", *MATERIALS) for label in labels)


def test_no_word_stands_for_two_different_things(things):
    meant = defaultdict(set)
    for name in [*EVERYTHING, "rug", "floor", "wall"]:
        for word in object_words(name):
            meant[word].add(("object", name))
    pieces = [piece for group in things.values() for piece in group[0].pieces]
    regions = {name for piece in pieces for name in (piece.part, piece.subpart)} - {""}
    # Parts of two objects may share a word: both have handles.
    for role, words in {
        "category": set(chain.from_iterable(CATEGORIES.values())),
        "colour": {*COLOURS, *chain.from_iterable(COLOUR_SYNONYMS.values())},
        "material": set(chain.from_iterable(MATERIALS.values())),
        "canonical": set(CANONICAL_PHRASES),
        "part": {word for region in regions for word in part_words(region)},
    }.items():
        for word in words:
            meant[word].add((role, "" if role == "part" else word))
    assert {word for word, roles in meant.items() if len(roles) > 1} <= SHARED


def test_no_phrase_names_a_whole_and_a_part(things):
    """A snowman's hat is a hat; any other phrase for a part must not be one for a thing."""
    wholes, parts = set(), set()
    for group in things.values():
        for thing in group[:3]:
            for piece in thing.pieces:
                subpart, part, whole = labels_of(thing, piece)
                wholes.update(whole.names)
                parts.update(subpart.names, part.names)
    assert {phrase for phrase in wholes & parts if phrase.split()[-1] != "hat"} == set()

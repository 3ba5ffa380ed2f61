"""Every class of the demo world: builds, stands, nests, has words of its own."""

from collections import defaultdict

import numpy as np
import pytest

from assets.making import vocabulary as captions
from assets.making.kit import COLOURS, Kit
from assets.making.kit import SYNONYMS as COLOUR_SYNONYMS
from assets.making.objects import EVERYTHING, FURNITURE, TABLE_TOP
from assets.making.vocabulary import (
    KINDS,
    MATERIALS,
    OBJECT_SYNONYMS,
    label_region,
    object_words,
    part_words,
)
from langsplat_core.lab.world.sheet import contact_sheet, portrait
from langsplat_core.scene import CANONICAL_PHRASES

pytestmark = pytest.mark.long

SEEDS = 10
# Words that are right for two things because they are the same thing, or that no phrase can tell apart:
# the fruit and the colour; a room's walls and a house's; the hat that a snowman wears.
SHARED = {"orange", "wall", "floor", "rug", "hat"}


def build(name, seed):
    builder, words = EVERYTHING[name]
    return builder(Kit(np.random.default_rng((seed, 17))), words[seed % len(words)])


@pytest.fixture(scope="module")
def things():
    return {name: [build(name, seed) for seed in range(SEEDS)] for name in EVERYTHING}


def test_there_are_enough_classes():
    assert len(TABLE_TOP) >= 50
    assert len(EVERYTHING) == len(TABLE_TOP) + len(FURNITURE)
    assert set(OBJECT_SYNONYMS) | set(KINDS) <= set(EVERYTHING) | {"rug", "floor", "wall"}
    assert all(set(colours) <= set(COLOURS) for _, colours in EVERYTHING.values())


@pytest.mark.parametrize("name", EVERYTHING)
def test_meshes_are_sound_and_stand_where_they_should(name, things):
    for thing in things[name]:
        assert thing.word == name
        assert thing.colour in ("", *COLOURS)
        triangles = 0
        for piece in thing.pieces:
            mesh = piece.mesh
            assert len(mesh.triangles) > 0
            assert np.isfinite(mesh.vertices).all()
            np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
            assert mesh.triangles.min() >= 0
            assert mesh.triangles.max() < len(mesh.vertices)
            triangles += len(mesh.triangles)
        assert triangles < (6500 if name != "table" else 45_000)  # its top shows fine shadows
        lowest = min(piece.mesh.vertices[:, 2].min() for piece in thing.pieces)
        assert -0.006 < lowest < 0.02
        if name in TABLE_TOP:
            assert 0.04 < thing.radius < 0.26
            assert 0.01 < thing.height < 0.4
        else:
            assert 0.15 < thing.radius < 1.4
            assert 0.4 < thing.height < 1.6


@pytest.mark.parametrize("name", EVERYTHING)
def test_triangles_face_the_way_their_normals_do(name, things):
    for piece in things[name][0].pieces:
        p = piece.mesh.vertices[piece.mesh.triangles]
        face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        against = (face * piece.mesh.normals[piece.mesh.triangles].mean(1)).sum(1) < 0
        area = np.linalg.norm(face, axis=1)
        # A few slivers of round ends and ruffles may disagree.
        assert area[against].sum() < 0.02 * area.sum(), (piece.part, piece.subpart)


@pytest.mark.parametrize("name", EVERYTHING)
def test_parts_are_named_and_nested(name, things):
    names = [{(piece.part, piece.subpart) for piece in thing.pieces} for thing in things[name]]
    assert len(names[0]) >= 2
    assert all(other == names[0] for other in names)  # the same words whatever the seed
    for part, subpart in names[0]:
        assert part
        assert subpart != part
        assert part != name
        assert part.replace(" ", "").isalpha()
        assert subpart.replace(" ", "").isalpha() or not subpart
    for thing in things[name][:2]:
        for piece in thing.pieces:
            labels = [label_region(level, thing, piece) for level in range(3)]
            assert [label.thing for label in labels] == [name] * 3
            assert labels[2].word == name
            assert set(labels[0].hues) <= set(labels[1].hues) <= set(labels[2].hues)
            assert set(labels[0].materials) <= set(labels[1].materials) <= set(labels[2].materials)
            assert all(label.material in ("", *MATERIALS) for label in labels)


@pytest.mark.parametrize("name", EVERYTHING)
def test_a_seed_always_gives_the_same_thing(name, things):
    again = build(name, 3)
    for one, other in zip(things[name][3].pieces, again.pieces, strict=True):
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
        np.testing.assert_array_equal(one.material.colour, other.material.colour)
    different = things[name][4].pieces
    assert any(
        one.mesh.vertices.shape != other.mesh.vertices.shape
        or not np.allclose(one.mesh.vertices, other.mesh.vertices)
        or not np.allclose(one.material.colour, other.material.colour)
        for one, other in zip(again.pieces, different, strict=False)
    )


def test_every_part_takes_up_room(things):
    """At a thing's own scale: a region far below a hundredth of it would be no use in any picture."""
    for name, (thing, *_) in things.items():
        extent = max(thing.radius, thing.height / 2)
        for piece in thing.pieces:
            size = np.ptp(piece.mesh.vertices, axis=0).max() / extent
            assert size > 0.05, (name, piece.part, piece.subpart)


def test_no_word_stands_for_two_different_things(things):
    meant = defaultdict(set)
    for name in [*EVERYTHING, "rug", "floor", "wall"]:
        for word in object_words(name):
            meant[word].add(("object", name))
    for kind in {kind for kinds in KINDS.values() for kind in kinds}:
        meant[kind].add(("kind", kind))
    for word in [*COLOURS, *(other for words in COLOUR_SYNONYMS.values() for other in words)]:
        meant[word].add(("colour", word))
    for words in MATERIALS.values():
        for word in words:
            meant[word].add(("material", word))
    for word in CANONICAL_PHRASES:
        meant[word].add(("canonical", word))
    pieces = [piece for group in things.values() for piece in group[0].pieces]
    for region in {name for piece in pieces for name in (piece.part, piece.subpart)} - {""}:
        for word in part_words(region):
            meant[word].add(("part", ""))  # parts of two objects may share a word: both have handles
    clashes = {word for word, roles in meant.items() if len(roles) > 1}
    assert clashes <= SHARED


def test_no_phrase_names_a_whole_and_a_part(things):
    """A snowman's hat is a hat; any other phrase for a part must not be one for a thing."""
    wholes, parts = set(), set()
    for group in things.values():
        for thing in group[:3]:
            for piece in thing.pieces:
                labels = [label_region(level, thing, piece) for level in range(3)]
                wholes.update(labels[2].names)
                parts.update(labels[0].names, labels[1].names)
    assert {phrase for phrase in wholes & parts if phrase.split()[-1] != "hat"} == set()


def test_synonym_tables_start_with_their_own_word():
    for table in (captions.OBJECT_SYNONYMS, captions.PART_SYNONYMS):
        assert all(words[0] == word and len(set(words)) == len(words) for word, words in table.items())


def test_materials_are_said():
    thing = build("chair", 0)
    leg = next(piece for piece in thing.pieces if piece.part == "leg")
    label = label_region(1, thing, leg)
    assert label.material == "wood"
    assert {"wooden leg", "wooden chair leg", "chair leg", "leg of the chair", "wood"} <= set(label.words)
    bottle = build("bottle", 0)
    assert "glass bottle" in label_region(2, bottle, bottle.pieces[0]).words
    apple = build("apple", 0)
    assert label_region(2, apple, apple.pieces[0]).material == ""


def test_contact_sheet_shows_things_in_their_colour(monkeypatch):
    red = portrait(EVERYTHING["drum"][0](Kit(np.random.default_rng(1)), "red"), 48, 20.0)
    assert red.shape == (48, 48, 3)
    middle = red[14:34, 14:34].reshape(-1, 3).astype(int)
    assert ((middle[:, 0] > middle[:, 1] + 60) & (middle[:, 0] > middle[:, 2] + 30)).mean() > 0.1
    from langsplat_core.lab.world import sheet

    monkeypatch.setattr(sheet, "EVERYTHING", {name: EVERYTHING[name] for name in ("mug", "snail")})
    picture = contact_sheet(1, 32)
    assert picture.shape == (46, 5 * 38, 3)

"""Phrases with structure on a laid table, where every Gaussian's meaning is known."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.query.compose import (
    Body,
    body,
    combine,
    gap,
    most,
    run_phrase,
    separate,
    stands,
    upright,
    viewpoint,
)
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.surface import build_surface
from langsplat_core.scene import NO_THING, look_at
from tests.support.query_scenes import UP, PlainEncoder, front_camera, laid_table, meaning


@pytest.fixture(scope="module")
def table() -> tuple[QueryEngine, dict[str, Array]]:
    scene, blocks = laid_table()
    return QueryEngine(scene, lambda _: PlainEncoder()), blocks


ANSWERS = {  # phrase -> blocks that answer it
    "handle of the red mug": ["red handle"],
    "blue mug's handle": ["blue handle"],
    "red mug handle": ["red handle"],
    "mug on the table": ["red mug", "red handle", "blue mug", "blue handle"],
    "mug below the table": ["far mug"],
    "mug near the book": ["red mug", "red handle"],
    "book and table": ["book", "table"],
    "mug, not red mug": ["blue mug", "blue handle", "far mug"],
    "mug without its handle": ["red mug", "blue mug", "far mug"],
    "the biggest mug": ["far mug"],
    "the lowest mug": ["far mug"],
    "the mug nearest to the book": ["red mug", "red handle"],
    "handle of the mug near the book": ["red handle"],
    "the smallest mug on the table": ["blue mug", "blue handle"],
}
SAID_BY_VIEWER = {
    "mug left of the book": ["red mug", "red handle"],
    "rightmost mug": ["blue mug", "blue handle"],
    "book behind the red mug": ["book"],
}


def overlap(members: Array, blocks: dict[str, Array], names: list[str]) -> float:
    """Intersection over union."""
    right = np.any([blocks[name] for name in names], axis=0)
    return float((members & right).sum() / (members | right).sum())


@pytest.mark.parametrize("text", [*ANSWERS, *SAID_BY_VIEWER])
def test_every_construction_finds_its_gaussians(table, text):
    engine, blocks = table
    result = run_phrase(engine, text, viewpoint=front_camera())
    answer, names = result.answer, {**ANSWERS, **SAID_BY_VIEWER}[text]
    assert overlap(answer.members, blocks, names) > 0.9
    assert answer.found
    assert answer.relevancy.shape == (3, len(answer.members))
    assert answer.members[answer.even.argmax()]
    low, high = answer.box
    assert ((answer.place >= low - 0.1) & (answer.place <= high + 0.1)).all()
    assert answer.members[np.argmin(((engine.scene.gaussians.means - answer.place) ** 2).sum(1))]


@pytest.mark.parametrize("text", SAID_BY_VIEWER)
def test_what_a_viewer_says_needs_one(table, text):
    with pytest.raises(InputError, match="give a camera"):
        run_phrase(table[0], text)


@pytest.mark.parametrize(
    "text", ["handle of the book", "book on the red mug", "mug in the book", "biggest handle on the book"]
)
def test_what_is_not_so_is_not_found(table, text):
    assert not run_phrase(table[0], text).answer.found


def test_a_phrase_without_structure_is_asked_whole(table):
    engine, _ = table
    got, want = run_phrase(engine, "the red mug!", "part"), engine.run("red mug", "part")
    assert got.reading == "red mug"
    np.testing.assert_array_equal(got.answer.relevancy, want.relevancy)
    np.testing.assert_array_equal(got.answer.members, want.members)
    assert (got.answer.peak, got.answer.level, got.answer.found) == (want.peak, want.level, want.found)


def test_the_reading_and_its_phrases_are_shown(table):
    result = run_phrase(table[0], "handle of the red mug")
    assert result.reading == "handle  inside  red mug"
    assert result.answer.phrase == "handle of the red mug"


def test_alternatives_are_whichever_is_there(table):
    engine, blocks = table
    with pytest.raises(EncoderError, match="spoon"):
        run_phrase(engine, "book or spoon")
    answer = run_phrase(engine, "book or table").answer
    assert overlap(answer.members, blocks, ["book", "table"]) > 0.9


def test_a_phrasebook_that_has_only_the_whole_phrase_is_asked_for_it():
    scene, blocks = laid_table({"handle of the mug": meaning("handle"), "mug": meaning("mug")})
    engine = QueryEngine(scene)
    result = run_phrase(engine, "handle of the mug")
    assert result.reading == "handle of the mug"
    assert overlap(result.answer.members, blocks, ["red handle", "blue handle"]) > 0.9
    with pytest.raises(EncoderError):
        run_phrase(engine, "lid of the mug")


def test_a_part_is_cut_inside_at_the_level_that_is_asked_for(table):
    engine, _ = table
    assert run_phrase(engine, "handle of the red mug").answer.level == 1
    assert run_phrase(engine, "handle of the red mug", "whole").answer.level == 2


# How boxes of points stand to each other, and which things there are.

FRAME = upright(UP)
EYE = viewpoint(look_at(np.array([0.0, -8, 1]), np.zeros(3), UP, (160, 120)), FRAME)


def box(centre: tuple[float, float, float], half: tuple[float, float, float], hollow: bool = False) -> Body:
    """2000 points in a box, or of an open vessel: its floor and sides."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (2000, 3))
    if hollow:
        points = points[(np.abs(points[:, :2]).max(1) > 0.9) | (points[:, 2] < -0.9)]
    return body(points * half + np.array(centre), FRAME)


TABLE = box((0, 0, -0.05), (1, 1, 0.05))
BOWL = box((0.5, 0, 0.2), (0.3, 0.3, 0.2), hollow=True)
CUP = box((-0.5, 0, 0.1), (0.1, 0.1, 0.1))
FRUIT = box((0.5, 0, 0.2), (0.1, 0.1, 0.1))
DOME = body(CUP.points @ FRAME * (1, 1, 0.3), FRAME)  # flat, on the table
LAMP = box((-0.5, 0, 2.0), (0.35, 0.35, 0.2))
WALL = box((0, 2.05, 1), (3, 0.05, 2))
PICTURE = box((0, 1.98, 1.5), (0.4, 0.02, 0.3))
TRUE = {
    "on": [(CUP, TABLE), (BOWL, TABLE), (PICTURE, WALL)],
    "in": [(FRUIT, BOWL)],
    "near": [(FRUIT, BOWL), (CUP, TABLE)],
    "above": [(LAMP, TABLE), (LAMP, CUP)],
    "below": [(TABLE, LAMP), (CUP, LAMP)],
    "left of": [(CUP, BOWL)],
    "right of": [(BOWL, CUP)],
    "behind": [(PICTURE, TABLE)],
    "in front of": [(TABLE, PICTURE)],
}
FALSE = {
    "on": [(TABLE, CUP), (LAMP, TABLE), (CUP, BOWL), (CUP, WALL)],
    "in": [(CUP, BOWL), (BOWL, FRUIT), (CUP, TABLE), (DOME, TABLE)],
    "near": [(CUP, BOWL), (LAMP, CUP)],
    "above": [(TABLE, LAMP), (LAMP, BOWL)],
    "below": [(LAMP, TABLE)],
    "left of": [(BOWL, CUP), (FRUIT, BOWL)],
    "right of": [(CUP, BOWL)],
    "behind": [(TABLE, PICTURE), (CUP, BOWL)],
    "in front of": [(PICTURE, TABLE)],
}


@pytest.mark.parametrize("kind", TRUE)
def test_how_things_stand(kind):
    assert all(stands(kind, what, anchor, EYE) for what, anchor in TRUE[kind])
    assert not any(stands(kind, what, anchor, EYE) for what, anchor in FALSE[kind])


@pytest.mark.parametrize("turn", [0, 90, 211])
def test_what_is_upright_does_not_depend_on_the_world(turn):
    """The same things under another up direction stand the same."""
    angle = np.radians(turn)
    rotation = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])

    def turned(one: Body) -> Body:
        return body((one.points @ FRAME) @ rotation.T, upright(rotation @ UP))

    for kind in ("on", "in", "near", "above", "below"):
        assert all(stands(kind, turned(what), turned(anchor), None) for what, anchor in TRUE[kind])
        assert not any(stands(kind, turned(what), turned(anchor), None) for what, anchor in FALSE[kind])


def test_the_most_extreme_thing():
    things = [CUP, BOWL, LAMP]
    want = {"biggest": 2, "smallest": 0, "highest": 2, "lowest": 0, "rightmost": 1, "farthest": 2}
    assert {kind: most(kind, things, [], EYE) for kind in want} == want
    assert most("nearest", things, [FRUIT], None) == 1


def test_a_gap_is_the_least_distance():
    distances = np.linalg.norm(CUP.points[:, None] - BOWL.points, axis=-1)
    assert gap(CUP, BOWL) == pytest.approx(distances.min())


def test_single_things_are_connected_and_no_specks():
    scene, blocks = laid_table()
    surface = build_surface(scene.gaussians)
    inside: Array = (blocks["far mug"] | blocks["book"])[surface.rows]
    speck = np.flatnonzero(blocks["table"][surface.rows])[:3]
    inside[speck] = True
    parts = separate(surface, inside)
    assert [len(part) for part in parts] == [blocks["far mug"].sum()]  # the book has less than a tenth of it
    assert separate(surface, np.zeros(len(surface.rows), bool)) == []


def test_what_is_known_of_things_tells_apart_what_touches_and_keeps_together_what_is_hidden():
    """A mug and the table under it are one connected surface, and two things; of what is of no thing, the
    surface decides."""
    scene, blocks = laid_table()
    surface = build_surface(scene.gaussians)
    mugs = blocks["far mug"] | blocks["red mug"]
    inside: Array = (mugs | blocks["table"])[surface.rows]
    things = np.full(len(scene.gaussians), NO_THING, np.uint16)
    things[mugs] = 3  # as if one thing, half hidden by what stands before it
    counts = sorted(len(part) for part in separate(surface, inside, things))
    assert counts == sorted([int(mugs.sum()), int(blocks["table"].sum())])
    apart = separate(surface, mugs[surface.rows], np.full(len(things), NO_THING, np.uint16))
    assert [list(part) for part in apart] == [list(part) for part in separate(surface, mugs[surface.rows])]
    assert len(apart) == 2


@pytest.mark.parametrize("how", ["union", "intersection", "difference"])
def test_answers_are_combined_as_their_members_are(table, how):
    engine, _ = table
    mug, red = engine.run("mug", "whole"), engine.run("red mug", "whole")
    want = {
        "union": mug.members | red.members,
        "intersection": mug.members & red.members,
        "difference": mug.members & ~red.members,
    }[how]
    np.testing.assert_array_equal(combine([mug, red], how).members, want)
    assert combine([mug], how) is mug
    if how == "union":
        same = run_phrase(engine, "mug and red mug", "whole").answer
        np.testing.assert_array_equal(same.members, want)
    with pytest.raises(InputError, match="'plant' was not found"):
        combine([mug, replace(red, phrase="plant", found=False)], how)

"""Words taught by showing, in scenes whose regions have the statistics of images: a gap between image and
text, much that no words describe, and things that are alike."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.io.sidecar import Words, read_language, read_words, write_language, write_words
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import NO_NODE, LanguageField, Scene, TaughtWord, Tree
from langsplat_core.scene.codec import CodebookCodec
from langsplat_core.scene.language import LONGEST_NAME, MOST_SHOWN, tree_of_wholes
from tests.support.fakes import FakeEncoder
from tests.support.scenes import unturned_gaussians

DIM, KINDS, SPAN = 96, 40, 32  # vectors; things there are; directions in which words differ
EACH = 40  # Gaussians of a thing
RNG = np.random.default_rng(5)
WALL = KINDS - 1  # of which every scene has several pieces, as rooms have
PIECES = 8
WORDS = unit(RNG.normal(size=(KINDS, SPAN)) @ np.linalg.qr(RNG.normal(size=(DIM, SPAN)))[0].T)
GAP = unit(RNG.normal(size=DIM))


def scene_of(things: list[int], seed: int) -> Scene:
    """A row of things of these kinds and of pieces of a wall, of which there is no mask, apart from each
    other. Their vectors have a cosine of 0.6 and more with each other, whatever they are; most of the rest is
    no matter of words."""
    rng = np.random.default_rng(seed)
    things = things + PIECES * [WALL]
    looks = WORDS[things] + 0.2 * unit(rng.normal(size=(len(things), DIM)))
    vectors = unit(1.6 * GAP + 0.7 * looks + 0.9 * unit(rng.normal(size=(len(things), DIM))))
    codec = CodebookCodec(vectors.astype(np.float32), np.zeros((len(things), 3), np.float32))
    of = np.repeat(np.arange(len(things)), EACH)
    places = np.stack([4.0 * of, 0 * of, 0 * of], 1) + rng.normal(scale=0.15, size=(len(of), 3))
    field = LanguageField(
        latents=np.tile(of.astype(np.uint16)[:, None], (3, 1, 1)),
        confidence=np.ones((3, len(of)), np.float32),
        codec=codec,
        canonical=np.tile(unit(GAP + WORDS[0]).astype(np.float32), (4, 1)),
        encoder_id="images",
        everyday=unit(0.8 * unit(WORDS.mean(0)) + WORDS).astype(np.float32),
        tree=tree_of_wholes(np.where(of < len(things) - PIECES, of, NO_NODE)),
    )
    return Scene(unturned_gaussians(places, np.log(0.08), 2.0), field)


def members(place: int, count: int) -> Array:
    return np.repeat(np.arange(count + PIECES) == place, EACH)


ROOM = list(range(24))
SHOWN = scene_of(ROOM, seed=1)


def taught(kind: int, name: str = "grandma's vase") -> TaughtWord:
    """The word for one thing of `SHOWN`."""
    return QueryEngine(SHOWN).teach(name, members(kind, len(ROOM)))


def asking(scene: Scene, *words: TaughtWord) -> QueryEngine:
    assert scene.language is not None
    return QueryEngine(Scene(scene.gaussians, replace(scene.language, taught=words)))


def test_taught_words_find_their_things_in_other_scenes():
    there = scene_of(list(range(12)) + list(range(24, 36)), seed=2)
    answers = [asking(there, taught(kind)).run("grandma's vase") for kind in ROOM]
    right = [answer.found and answer.members[members(kind, 24)].all() for kind, answer in enumerate(answers)]
    assert np.mean(right[:12]) >= 0.8
    assert np.mean([answer.found for answer in answers[12:]]) <= 0.25
    for answer in answers:
        assert answer.verdict == ("found" if answer.judgement.margin >= 0 else answer.verdict)
        assert answer.probability is None
        assert answer.members.any()
        assert answer.box is not None
        assert 0 <= answer.relevancy.min() <= answer.relevancy.max() <= 1
        assert (answer.peak >= 0.5) == answer.found


def test_taught_word_finds_every_thing_and_places_the_best():
    there = scene_of([*range(6, 24), 3, 30, 3], seed=3)
    answer = asking(there, taught(3)).run("Grandma’s vase")
    assert set(np.flatnonzero(answer.members) // EACH) == {18, 20}
    assert len(QueryEngine(there).instances(answer)) == 2
    assert min(abs(answer.place[0] - 4 * 18), abs(answer.place[0] - 4 * 20)) < 0.5


def test_like_equals_teach_and_run_without_keeping():
    there = scene_of([*range(20), 3], seed=4)
    engine = QueryEngine(there)
    alike = engine.like(members(3, 21))
    assert engine.taught == {}
    found = set(np.flatnonzero(alike.members) // EACH)
    assert found >= {3, 20}
    assert len(found) <= 3  # of 29
    engine.teach("vase", members(3, 21))
    np.testing.assert_array_equal(engine.run("vase").members, alike.members)


def test_further_example_is_found_too():
    engine = QueryEngine(SHOWN)
    engine.teach("both", members(3, 24))
    word = engine.teach("Both!", members(9, 24))
    assert len(word.vectors) == len(word.rivals) == 2
    assert set(np.flatnonzero(engine.run("both").members) // EACH) == {3, 9}
    with pytest.raises(InputError, match="taught at level whole"):
        engine.teach("both", members(3, 24), "part")
    for _ in range(MOST_SHOWN - 2):
        engine.teach("both", members(3, 24))
    with pytest.raises(InputError, match="remove it first"):
        engine.teach("both", members(3, 24))


def test_scenes_and_files_keep_taught_words_exactly(tmp_path):
    words = (taught(3), taught(5, "tür"))
    field, means = replace(SHOWN.language, taught=words), SHOWN.gaussians.means
    write_language(tmp_path / "a.safetensors", field, means)
    write_words(tmp_path / "b.safetensors", Words("images", field.canonical, words))
    kept = read_language(tmp_path / "a.safetensors", means)
    own = read_words(tmp_path / "b.safetensors")
    before, after = QueryEngine(Scene(SHOWN.gaussians, field)), QueryEngine(Scene(SHOWN.gaussians, kept))
    user = QueryEngine(SHOWN, words=own)
    assert list(user.taught) == list(after.taught) == ["grandma's vase", "tür"]
    for engine in (after, user):
        for name in before.taught:
            assert engine.run(name).judgement.margin == before.run(name).judgement.margin
            np.testing.assert_array_equal(engine.run(name).even, before.run(name).even)


def test_words_of_another_encoder_are_refused():
    words = (taught(3),)
    canonical = SHOWN.language.canonical
    QueryEngine(SHOWN, words=Words("the same elsewhere", canonical, words))
    for other in (np.roll(canonical, 1, 1), canonical[:, :-1].copy()):
        with pytest.raises(EncoderError, match=r"taught with clip.* made with images"):
            QueryEngine(SHOWN, words=Words("clip", other, words))


class OneVector(FakeEncoder):
    """Knows every word but "vase", and all as the same."""

    def encode_texts(self, texts):
        return np.tile(SHOWN.language.canonical[:1], (len(texts), 1))

    def unknown_words(self, text):
        return tuple(word for word in text.split() if word == "vase")


def test_taught_name_replaces_text_in_phrases():
    engine = QueryEngine(SHOWN, lambda _: OneVector())
    engine.teach("vase on the left", members(3, 24))
    alone = run_phrase(engine, "the vase on the left")
    assert alone.answer.found
    assert set(np.flatnonzero(alone.answer.members) // EACH) == {3}
    check_phrase(engine, "vase on the left or a table")
    both = run_phrase(engine, "vase on the left and vase on the left")
    np.testing.assert_array_equal(both.answer.members, alone.answer.members)
    many = engine.run_many(["table", "Vase on the left", "chair"])
    assert [answer.phrase for answer in many] == ["table", "vase on the left", "chair"]
    np.testing.assert_array_equal(many[1].members, alone.answer.members)
    np.testing.assert_allclose(many[2].relevancy, engine.run("chair").relevancy, atol=1e-5)
    assert engine.unknown_words("vase on the left") == ()
    assert engine.unknown_words("vase") == ("vase",)


@pytest.mark.parametrize("name", ["", " ?! ", "the", "a; b", "a, b", "x" * (LONGEST_NAME + 1)])
def test_invalid_names_are_refused(name):
    engine = QueryEngine(SHOWN)
    with pytest.raises(InputError, match="cannot be a name"):
        engine.teach(name, members(3, 24))
    assert engine.taught == {}


def test_gaussians_without_features_cannot_be_taught():
    dark = Scene(SHOWN.gaussians, replace(SHOWN.language, confidence=0 * SHOWN.language.confidence))
    for scene, some in ((SHOWN, np.zeros(len(SHOWN.gaussians), bool)), (dark, members(3, 24))):
        with pytest.raises(InputError, match="point at something else"):
            QueryEngine(scene).teach("vase", some)


def test_tiny_scenes_answer_taught_words():
    for things in ([3], [3, 3], [30, 31]):
        scene = scene_of(things, seed=6)
        for everyday in (scene.language.everyday, None):
            field = replace(scene.language, everyday=everyday, taught=(taught(3),))
            answer = QueryEngine(Scene(scene.gaussians, field), rule="peak").run("grandma's vase")
            assert np.isfinite([answer.judgement.margin, *answer.relevancy.ravel()]).all()
            assert answer.members.shape == (len(scene.gaussians),)
    nothing = asking(SHOWN.take(np.zeros(0, int)), taught(3)).run("grandma's vase")
    assert (nothing.found, nothing.place) == (False, None)


def test_teaching_takes_the_level_of_the_marked_region():
    scene = scene_of([*range(8)], seed=7)
    leaves = (np.arange(len(scene.gaussians)) // EACH).astype(np.int32)
    count, pairs = int(leaves.max()) + 1, int(leaves.max()) // 2 + 1  # wholes of two things each
    parents = np.concatenate([count + np.arange(count) // 2, np.full(pairs, NO_NODE)]).astype(np.int32)
    levels = np.repeat(np.array([1, 2], np.uint8), [count, pairs])
    tree = Tree(leaves, parents, levels, np.zeros((count + pairs, 2), np.uint16))
    engine = QueryEngine(Scene(scene.gaussians, replace(scene.language, tree=tree)))
    assert engine.teach("one", members(3, 8)).level == 1
    assert engine.teach("two", members(2, 8) | members(3, 8)).level == 2


@pytest.mark.parametrize(
    "change",
    [
        {"name": ""},
        {"name": '"quoted"'},
        {"name": "a, b"},
        {"level": 3},
        {"vectors": np.zeros((0, DIM), np.float32), "rivals": np.zeros(0, np.float32)},
        {"vectors": np.full((1, DIM), np.nan, np.float32)},
        {"vectors": np.ones((1, DIM), np.float32)},
        {"rivals": np.array([np.nan], np.float32)},
        {"rivals": np.array([1.5], np.float32)},
        {"rivals": np.array([0.5, 0.5], np.float32)},
    ],
)
def test_malformed_taught_word_is_refused(change):
    with pytest.raises(ValueError, match=r"taught word|rivals: expected"):
        replace(taught(3), **change)


def test_taught_names_are_unique_in_a_field():
    with pytest.raises(ValueError, match="two words have one name"):
        replace(SHOWN.language, taught=(taught(3), taught(4, "Grandma’s  vase")))
    short = replace(taught(3), vectors=np.eye(1, 8, dtype=np.float32))
    with pytest.raises(ValueError, match="taught"):
        replace(SHOWN.language, taught=(short,))

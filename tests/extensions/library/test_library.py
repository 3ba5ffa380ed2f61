"""The index of a folder of scenes: its answers are the engine's, it follows its folder, and is refused when
damaged. Two scenes of one place: what appeared, is gone, moved or has another colour, and nothing else."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, FormatError, InputError
from langsplat_core.extensions.library import commands as library_commands
from langsplat_core.extensions.library.changes import Change, changes, colour_term, to_lab
from langsplat_core.extensions.library.index import (
    INDEX,
    SCENES,
    find,
    fits_in,
    read_entry,
    read_library,
    scenes_in,
    update_library,
    write_library,
)
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.progress import Progress, Report
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import named
from langsplat_core.query.rule import judge, scaling_of, triple
from langsplat_core.scene import Calibration, Gaussians, PlattScaling, Scene
from langsplat_core.scene.transform import moving, place_scene, rotating, scaling, transform_scene
from langsplat_core.semantics.encoders import keep_calibration, load_text_encoder
from langsplat_core.semantics.relevancy import bundled_vocabulary
from tests.support.fakes import CENTRES, NAMES, PER_BLOB, FakeEncoder, axis, named_scene
from tests.support.file_kinds import FileKind, few_and_many, in_safetensors
from tests.support.file_samples import FIELDS
from tests.support.processes import refusal, run
from tests.support.scenes import DEMO, unturned_gaussians

MUG, BOOK, PLANT = (slice(k * PER_BLOB, (k + 1) * PER_BLOB) for k in range(3))


def without(scene: Scene, rows: slice) -> Scene:
    return scene.take(np.delete(np.arange(len(scene.gaussians)), rows))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Everything, nothing but mug and book, and a scene without a codebook; another without a field."""
    save_scene(tmp_path / "all.ply", named_scene())
    (tmp_path / "deep").mkdir()
    save_scene(tmp_path / "deep" / "few.ply", without(named_scene(), PLANT))
    save_scene(tmp_path / "linear.spz", named_scene(codebook=False))
    save_scene(tmp_path / "plain.ply", replace(named_scene(), language=None))
    return tmp_path


def load(name: str) -> FakeEncoder:
    return FakeEncoder()


def own(name: str) -> FakeEncoder:
    """The fake for "demo", else what is here."""
    return FakeEncoder() if name == "demo" else load_text_encoder(name)


def test_scenes_with_a_field_are_found_in_all_folders(folder):
    (folder / ".hidden").mkdir()
    save_scene(folder / ".hidden" / "scene.ply", named_scene())
    assert list(scenes_in(folder)) == ["all.ply", "linear.spz", "deep/few.ply"]
    with pytest.raises(InputError, match="no such folder"):
        scenes_in(folder / "elsewhere")


def test_scenes_without_a_codebook_are_not_indexed(folder):
    """What an index says of the others is the engine's answer: on the bundled scene, below."""
    group = update_library(folder, load_encoder=load).groups[0]
    fits, _ = fits_in(group, FakeEncoder().encode_texts(["mug"])[0])
    for scene, found in zip(group.scenes, fits, strict=True):
        assert scene.is_indexed == np.isfinite(found).any() == (scene.path != "linear.spz")
    with pytest.raises(FormatError, match="does not fit"):
        fits_in(group, np.ones(600, np.float32))


def test_own_calibration_counts_before_a_scene_is_opened(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    library = update_library(folder, load_encoder=load)
    assert [hit.probability for hit in find(library, "plant", load)[0].hits] == [None] * 3
    encoder = FakeEncoder()
    encoder.id = library.groups[0].encoder_id
    keep_calibration(encoder, Calibration(*[PlattScaling(0.0, 3.0, 0.0)] * 3))
    answered = find(library, "plant", load)[0]
    assert None not in [hit.probability for hit in answered.hits]
    assert (answered.count("found"), answered.count("not here")) == (2, 1)


def test_the_best_scenes_come_first_and_with_a_place(folder):
    (answered,) = find(update_library(folder, load_encoder=load), "plant", load)
    names = [hit.path.name for hit in answered.hits]
    assert set(names[:2]) == {"all.ply", "linear.spz"}
    assert names[2] == "few.ply"
    assert (answered.count("found"), answered.count("not here")) == (2, 1)
    for hit in answered.hits[:2]:
        assert np.linalg.norm(hit.answer.place - [1.2, 0, 0]) < 0.2
    assert answered.hits[2].answer is None


def test_only_what_has_changed_is_read_again(folder):
    first = update_library(folder, load_encoder=load)
    read: list[str] = []

    def note(report: Report) -> None:
        read.extend([report.note] if report.note else [])

    again = update_library(folder, load_encoder=load, progress=Progress(note))
    assert read == []
    assert [scene.path for scene in again.scenes] == [scene.path for scene in first.scenes]
    save_scene(folder / "all.ply", without(named_scene(), MUG))
    (folder / "linear.spz.langsplat.safetensors").unlink()
    third = update_library(folder, load_encoder=load, progress=Progress(note))
    assert read == ["all.ply"]
    assert [scene.path for scene in third.scenes] == ["all.ply", "deep/few.ply"]
    verdicts = {hit.path.name: hit.verdict for hit in find(third, "mug", load)[0].hits}
    assert verdicts == {"all.ply": "not here", "few.ply": "found"}


def test_an_interrupted_update_keeps_what_was_read(folder):
    def stop(report: object) -> None:
        if getattr(report, "fraction", 0) > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        update_library(folder, load_encoder=load, progress=Progress(stop))
    assert len(read_library(folder / INDEX, folder).scenes) == 2


def test_without_an_encoder_a_phrasebook_of_the_group_answers(folder):
    def none(name: str) -> FakeEncoder:
        raise EncoderError("no weights here")

    library = update_library(folder, load_encoder=none)
    (answered,) = find(library, NAMES[0], none)
    assert answered.count("found") == 3
    (unknown,) = find(library, "teapot", none)
    assert unknown.problem == "no weights here"


def test_a_scene_that_cannot_be_read_is_named(folder):
    (folder / "all.ply").write_bytes(b"ply\n")
    library = update_library(folder, load_encoder=load)
    (unread,) = library.unread
    assert unread.path == "all.ply"
    assert "all.ply" in unread.unread
    assert len(library.scenes) == 2


@pytest.mark.parametrize("name", ["~nosuchuser/x", "x" * 5000, "nobody/nothing-here"])
def test_an_encoder_that_is_not_here_costs_its_own_scenes_alone(tmp_path, name):
    scene = named_scene()
    for file, encoder in (("good", "demo"), ("bad", name)):
        field = replace(scene.language, encoder_id=encoder, phrasebook={})
        save_scene(tmp_path / f"{file}.ply", replace(scene, language=field))
    groups = find(update_library(tmp_path, load_encoder=own), "mug", own)
    assert {each.encoder_id: bool(each.problem) for each in groups} == {"demo": False, name: True}


# Damaged and hostile index files.


def test_folder_that_cannot_be_written_has_its_index_in_the_cache(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != folder)
    found = update_library(folder, load_encoder=load)
    assert not (folder / INDEX).exists()
    (index,) = (tmp_path / "cache").rglob("library-*")
    before = index.stat().st_mtime_ns
    assert len(update_library(folder, load_encoder=load).scenes) == len(found.scenes)
    assert index.stat().st_mtime_ns == before


def test_damaged_index_is_made_again_with_a_warning(folder, caplog):
    update_library(folder, load_encoder=load)
    whole = (folder / INDEX).read_bytes()
    for damaged in (b"", b"LSLIB\x00\x00\x01" + bytes(8), whole[:-8], whole + bytes(8)):
        (folder / INDEX).write_bytes(damaged)
        caplog.clear()
        assert len(update_library(folder, load_encoder=load).scenes) == 3
        assert caplog.text.count(INDEX) == 1


@pytest.mark.parametrize(
    "false",
    [{"path": "../../etc/x.ply"}, {"regions": [2**40, 1, 1]}, {"calibration": {"thing": "x"}},
     "words", "regions", "parents", "steps"],
)  # fmt: skip
def test_index_that_states_what_cannot_be_is_made_again(folder, false, caplog):
    """Of a scene, or by a number of a column that is of nothing there, or is none."""
    update_library(folder, load_encoder=load)
    index = folder / INDEX
    with safe_open(index, "numpy") as file:
        content, tensors = json.loads(file.metadata()[SCENES]), load_file(index)
    if isinstance(false, dict):
        content["groups"][0][1][0].update(false)
    else:
        wrong = tensors[f"0.{false}"]
        wrong[0] = 2**30 if wrong.dtype.kind in "iu" else np.nan
    save_file(tensors, index, {SCENES: json.dumps(content)})
    (answered,) = find(update_library(folder, load_encoder=load), "mug", load)
    assert answered.count("found") == 3
    assert f"{INDEX}: no index of scenes" in caplog.text


# What changed between two scenes.


def indices(folder: Path) -> list[bytes]:
    save_scene(folder / "all.ply", named_scene())
    save_scene(folder / "few.ply", without(named_scene(), PLANT))
    update_library(folder, load_encoder=load)
    return [(folder / INDEX).read_bytes()]


def asked(index: Path) -> float:
    library = read_library(index, index.parent)
    for answered in find(library, "plant", load, at_most=1):
        for hit in answered.hits:
            assert hit.verdict
    return 1.0


KINDS = {"index of find": FileKind(INDEX, indices, asked, in_safetensors, share=0.1)}
test_a_few_mutants_are_read_or_refused, test_many_mutants_are_read_or_refused = few_and_many(KINDS)


def with_gaussians(scene: Scene, **changed: Array) -> Scene:
    return replace(scene, gaussians=replace(scene.gaussians, **changed))


def compared(first: Scene, second: Scene, placed: Array | None = None) -> tuple[Change, ...]:
    engines = [QueryEngine(scene, lambda _: FakeEncoder()) for scene in (first, second)]
    return changes(*engines, placed)


@pytest.fixture
def scene() -> Scene:
    """Three blobs before a wall: what is gone uncovers something."""
    made = named_scene()
    x, y = np.meshgrid(np.linspace(-4, 4, 33), np.linspace(-3, 3, 25))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.6)], 1)
    wall = unturned_gaussians(means, np.log([0.2, 0.2, 0.01]), 6.0, 1.2)
    parts = {name: np.concatenate([getattr(made.gaussians, name), getattr(wall, name)]) for name in FIELDS}
    field, shape = made.language, (3, len(means))
    latents = np.concatenate([field.latents, np.full((*shape, 1), 3, np.uint16)], 1)
    confidence = np.concatenate([field.confidence, np.ones(shape, np.float32)], 1)
    field = replace(field, latents=latents, confidence=confidence, tree=None)
    return replace(made, gaussians=Gaussians(**parts), language=field)


def noisy(scene: Scene, seed: int = 5) -> Scene:
    """The same from another training: every Gaussian a little elsewhere and of a little other colour."""
    rng, g = np.random.default_rng(seed), scene.gaussians
    means = g.means + rng.normal(scale=0.01, size=g.means.shape)
    return with_gaussians(scene, means=means, sh=g.sh + rng.normal(scale=0.05, size=g.sh.shape))


def test_noise_and_exposure_are_no_changes(scene):
    darker = with_gaussians(scene, sh=scene.gaussians.sh - 0.9)
    assert compared(scene, scene) == compared(scene, noisy(scene)) == compared(scene, darker) == ()


@pytest.mark.parametrize("number", range(3))
def test_gone_and_appeared_are_each_other_backwards(scene, number):
    rows = (MUG, BOOK, PLANT)[number]
    fewer = place_scene(noisy(without(scene, rows)), origin=np.array([30.0, 0.0, -8.0]))  # in the same world
    for pair, kind in (((scene, fewer), "gone"), ((fewer, scene), "appeared")):
        (change,) = compared(*pair)
        assert change.kind == kind
        np.testing.assert_allclose(pair[0].in_world(change.centre), CENTRES[number], atol=0.1)
        assert change.share > 0.8


def test_before_nothing_what_is_gone_is_told_by_who_looked_there():
    """The blobs alone: what the second capture did not see may still be there."""
    scene = named_scene()
    fewer = without(scene, BOOK)
    assert [change.kind for change in compared(scene, fewer)] == ["gone"]
    assert compared(scene, replace(fewer, cameras=())) == ()


def test_a_move_is_one_change_and_has_its_length(scene):
    means = scene.gaussians.means.copy()
    means[PLANT] += (0.3, -0.2, -1.0)
    (change,) = compared(scene, with_gaussians(scene, means=means))
    assert change.kind == "moved"
    np.testing.assert_allclose(change.moved, (0.3, -0.2, -1.0), atol=0.05)
    assert change.distance == pytest.approx(np.linalg.norm((0.3, 0.2, 1.0)), abs=0.05)


def test_another_frame_and_scale_change_nothing(scene):
    """The second scene is the first one turned by 90 degrees, moved, and twice as large."""
    there = rotating(np.array([0.0, 1, 0]), 90.0).then(scaling(2.0)).then(moving(np.array([3.0, -1, 2])))
    second, into = replace(transform_scene(scene, there), cameras=()), there.inverse().matrix
    assert compared(scene, second, into) == ()
    twice = replace(transform_scene(scene, scaling(2.0)), metres_per_unit=0.5)
    assert compared(replace(scene, metres_per_unit=1.0), twice) == ()
    (change,) = compared(scene, without(second, MUG), into)
    np.testing.assert_allclose(change.centre, CENTRES[0], atol=0.1)


def test_scenes_with_other_axes_are_reported(scene, caplog):
    tilted = rotating(np.array([1.0, 0, 0]), 30.0).about(np.array([0, 0, 1.6]))
    compared(scene, transform_scene(scene, tilted), tilted.inverse().matrix)
    assert caplog.messages == []
    compared(scene, transform_scene(scene, tilted))
    assert "align them" in "".join(caplog.messages)


def test_scenes_that_cannot_be_compared_are_refused(scene):
    blind = replace(scene, cameras=())
    with pytest.raises(InputError, match="cameras"):
        compared(blind, blind)
    for matrix in (np.eye(3), np.full((4, 4), np.nan), np.diag([1.0, 2, 1, 1]), np.zeros((4, 4))):
        with pytest.raises(InputError, match="matrix"):
            compared(scene, scene, matrix)
    with pytest.raises(InputError, match="language"):
        compared(scene, replace(scene, language=None))


def test_colours_are_those_of_cie():
    white, red = to_lab(np.array([[1.0, 1, 1], [1, 0, 0]]))
    np.testing.assert_allclose(white, (100, 0, 0), atol=0.1)
    np.testing.assert_allclose(red, (53.2, 80.1, 67.2), atol=0.2)  # of sRGB's red, D65
    for colour, term in (
        ((0.1, 0.3, 0.9), "blue"),
        ((0.95, 0.9, 0.3), "yellow"),
        ((0.45, 0.45, 0.47), "grey"),
    ):
        assert colour_term(to_lab(np.array(colour))) == term
    # Means of what is lit and what is in shade, of a painted box in the bundled room: named by their hue.
    measured = {"purple": ((13.9, 35.1, -21.6), (31.8, 20.7, -16.6)), "pink": ((45.2, 13.7, 2.2),)}
    assert all(colour_term(np.array(lab)) == term for term, some in measured.items() for lab in some)


# `langsplat find` and `langsplat changes`.


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder; in "scans" a scene with mug, book and plant, and one without the mug."""
    (tmp_path / "scans" / "<b>&").mkdir(parents=True)
    save_scene(tmp_path / "scans" / "whole.ply", named_scene())
    fewer = named_scene().take(np.arange(PER_BLOB, 3 * PER_BLOB))
    save_scene(tmp_path / "scans" / "<b>&" / "fewer.ply", fewer)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(library_commands, "load_text_encoder", lambda name: FakeEncoder())
    return tmp_path


def test_find_lists_the_scenes_that_have_it(scans, capsys):
    assert run("find", "mug", "book", "scans", "--json") == 0
    mug, book = json.loads(capsys.readouterr().out)
    assert (mug["phrase"], mug["found"], mug["not_here"]) == ("mug", 1, 1)
    assert [scene["scene"] for scene in mug["scenes"]] == ["whole.ply"]
    np.testing.assert_allclose(mug["scenes"][0]["place"], (-1.2, 0, 0), atol=0.2)
    assert book["found"] == 2
    assert run("find", "mug", "scans", "--all") == 0
    text = capsys.readouterr().out
    assert "found in 1 of 2 scenes" in text
    assert "fewer.ply: not here" in text
    for words, said in ((["mug"], "phrases and a folder"), (["the", "scans"], "'the'")):
        assert said in refusal(capsys, "find", *words)


def test_changes_are_said_in_words_and_in_json(scans, capsys):
    pair = "scans/whole.ply", "scans/<b>&/fewer.ply"
    assert run("changes", *pair) == 0
    assert capsys.readouterr().out.startswith("gone: mug at ")
    assert run("changes", pair[0], pair[0]) == 0
    assert capsys.readouterr().out.strip() == "nothing changed"
    scene = named_scene()
    sh = scene.gaussians.sh.copy()
    sh[:PER_BLOB] = sh[2 * PER_BLOB :]
    there = np.array([5e5, 4e6, 120.0])
    painted = place_scene(replace(scene, gaussians=replace(scene.gaussians, sh=sh)), moving(there))
    save_scene(scans / "painted.ply", painted)
    save_scene(scans / "far.ply", place_scene(scene, moving(there)))
    assert run("changes", "far.ply", "painted.ply") == 0
    assert "red to blue" in capsys.readouterr().out
    lost = replace(scene.language, canonical=np.tile(axis(4), (4, 1)), encoder_id="lost")
    save_scene(scans / "lost.ply", replace(scene, language=lost))
    assert run("-q", "changes", "lost.ply", "lost.ply") == 0
    assert capsys.readouterr() == ("nothing changed\n", "")
    (scans / "placed.json").write_text(json.dumps({"matrix": np.eye(4).tolist()}))
    assert run("changes", "painted.ply", "far.ply", "--transform", "placed.json", "--json") == 0
    (change,) = json.loads(capsys.readouterr().out)["changes"]
    assert (change["kind"], change["colours"]) == ("recoloured", ["blue", "red"])
    np.testing.assert_allclose(change["centre"], there + CENTRES[0], atol=0.1)
    both = "--transform", "placed.json", "--register"
    assert "leave one of them out" in refusal(capsys, "changes", pair[0], "painted.ply", *both)


# The rule for answers by the engine and by the index over scans.

EVERY = 8  # every so-manyth Gaussian of the bundled scene
LIKE = 0.1  # spreads and logits within which 8 bits of a codeword may tip a verdict


def index_verdicts(engine: QueryEngine, phrases: list[str], folder: Path) -> Iterator[tuple[Any, Any]]:
    path = folder / "scene.ply"
    save_scene(path, engine.scene)
    write_library(folder / "index", [read_entry(path, path.name, load_text_encoder)])
    group = read_library(folder / "index", folder).groups[0]
    (scene,) = group.scenes
    for phrase in phrases:
        (fits,), (common,) = fits_in(group, engine.texts.of([phrase])[0])
        scaling = scaling_of(scene.calibration, named(phrase), phrase)
        yield fits, judge(triple(fits), named(phrase), "auto", scene.bars, scaling, float(common))


@pytest.mark.long
def test_index_answers_200_phrases_as_the_engine_does(tmp_path):
    scene = load_scene(DEMO)
    engine = QueryEngine(scene.take(np.arange(0, len(scene.gaussians), EVERY)), load_text_encoder)
    known, _ = engine.texts.of_known((*bundled_vocabulary("things"), *bundled_vocabulary("parts")))
    phrases = list(known[:: len(known) // 200][:200])
    assert len(phrases) == 200
    expected = engine.run_many(phrases)
    assert {answer.verdict for answer in expected} == {"found", "weak match", "not here"}
    index = index_verdicts(engine, phrases, tmp_path)
    for want, (fits, verdict) in zip(expected, index, strict=True):
        np.testing.assert_allclose(fits, want.fits, atol=0.05)
        assert verdict.margin == pytest.approx(want.judgement.margin, abs=0.2)
        even = np.log(want.probability) - np.log1p(-want.probability)
        weakest = want.judgement.margin - even  # at which a verdict becomes a weak match: the odds are even
        if min(abs(verdict.margin), abs(verdict.margin - weakest)) > LIKE:
            assert verdict.outcome == want.verdict

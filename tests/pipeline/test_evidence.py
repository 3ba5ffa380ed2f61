"""Evidence: which photographs vote for an answer, and what the phrase says of their masks. Labels."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from langsplat_core.arrays import unit
from langsplat_core.cli import query
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.pipeline.encoder_check import bundled_room
from langsplat_core.pipeline.evidence import Evidence, find_evidence, kept_features, kept_photographs
from langsplat_core.pipeline.train import train_scene
from langsplat_core.query.compose import run_phrase, with_masks
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.inventory import export_labels
from langsplat_core.query.selection import shares_in_masks
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.render import view_of
from langsplat_core.scene import NO_NODE, Scene
from langsplat_core.scene.language import Tree
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.semantics.relevancy import relevancy_of
from tests.support.fakes import (
    CENTRES,
    NAMES,
    PER_BLOB,
    WORDS,
    FakeEncoder,
    as_trained,
    axis,
    blob_scene,
    cameras,
    named_scene,
)
from tests.support.processes import run
from tests.support.scenes import dense_weights, random_camera, random_gaussians
from tests.support.tiny_models import tiny_room, tiny_settings

VIEWS = 8
WRONG, MERGED, BLANK, AWAY = 2, 4, 5, 6  # photographs that are not as the others
MUG = np.arange(3 * PER_BLOB) < PER_BLOB


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Blobs that are seen from `VIEWS` sides; camera `AWAY` looks past them."""
    views = list(cameras(VIEWS))
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ views[AWAY].world_to_camera
    views[AWAY] = replace(views[AWAY], world_to_camera=turned)
    return replace(blob_scene(), cameras=tuple(views))


@pytest.fixture(scope="module")
def shown(scene):
    """(VIEWS, H, W) bool pixels of the mug, and of everything, by the reference in double precision."""
    values, found = np.stack([MUG, ~MUG], 1).astype(np.float64), []
    for camera in scene.cameras:
        image, _ = load_rasterizer("reference").view(scene.gaussians, camera).splat(values)
        found.append((image[..., 0] > 0.5, image.sum(-1) > 0.5))
    return found


@pytest.fixture(scope="module")
def features(shown) -> list[ImageFeatures]:
    """A mask of the mug in every photograph at level whole, less and less like it from one to the next, and a
    larger one at level part. One mask means a book, one photograph has all in one mask, one has no mask."""
    made = []
    for view, (mug, everything) in enumerate(shown):
        labels = np.full((3, *mug.shape), -1, np.int32)
        labels[1][everything] = 1
        labels[2][everything if view == MERGED else mug] = 0
        if view == BLANK:
            labels[:] = -1
        means = axis(1) if view == WRONG else unit(axis(0) + 0.1 * view * axis(4)).astype(np.float32)
        made.append(ImageFeatures(labels, np.stack([means, axis(2)])))
    return made


@pytest.fixture(scope="module")
def engine(scene) -> QueryEngine:
    return QueryEngine(scene, lambda _: FakeEncoder())


@pytest.fixture(scope="module")
def evidence(engine, features) -> Evidence:
    return find_evidence(engine, engine.run("mug"), ["mug"], features)


def test_masks_of_just_the_answer_vote_for_it(evidence, shown):
    np.testing.assert_array_equal(evidence.members, MUG)
    assert [vote.view for vote in evidence.votes] == [0, 1, 3, 7, WRONG]
    assert {vote.view for vote in evidence.others} == {MERGED, BLANK}  # and nobody counts who does not see it
    for vote in (*evidence.votes, *evidence.others):
        mug, everything = shown[vote.view]
        assert vote.photograph == f"photo_{vote.view}"
        assert vote.pixels == pytest.approx(mug.sum(), abs=3)
        inside = 0 if vote.view == BLANK else mug.sum() / (everything if vote.view == MERGED else mug).sum()
        assert vote.overlap == pytest.approx(inside, abs=0.02)
        assert vote.agrees == (inside >= 0.5)


def test_a_wrong_mask_is_the_worst_vote(evidence):
    *right, wrong = evidence.votes
    assert wrong.view == WRONG
    assert evidence.fitting == len(right)
    assert wrong.cosine == pytest.approx(0, abs=1e-6)
    assert wrong.fit < 0 < min(vote.fit for vote in right)


def test_cosines_and_fits_are_those_of_the_masks_own_vectors(engine, evidence, features):
    for vote in evidence.votes:
        vector = features[vote.view].vectors[:1]
        assert vote.cosine == pytest.approx(vector[0, 0], abs=1e-5)
        relevancy = relevancy_of(vector[:, 0], *engine.scale.of(vector @ engine.scale.texts.T))
        assert vote.fit == pytest.approx(engine.scale.fit(relevancy).item(), rel=1e-4)
    blank = next(vote for vote in evidence.others if vote.view == BLANK)
    assert (blank.mask, blank.cosine, blank.fit, blank.overlap) == (-1, None, None, 0.0)


@pytest.mark.parametrize(("votes", "others"), [(0, 0), (0, 3), (5, 2), (30, 0)])
def test_the_share_is_that_of_a_beta_distribution(evidence, votes, others):
    some = replace(evidence, votes=evidence.votes[:1] * votes, others=evidence.others[:1] * others)
    shares = np.linspace(0, 1, 400_001)
    density = shares**votes * (1 - shares) ** others
    below = np.cumsum(density) / density.sum()
    low, high = np.interp([0.05, 0.95], below, shares)
    assert some.share == pytest.approx((shares * density).sum() / density.sum(), abs=1e-4)
    assert some.interval == pytest.approx((low, high), abs=1e-4)


def test_nothing_answers_without_members(engine, features):
    nothing = replace(engine.run("mug"), members=np.zeros(len(MUG), bool))
    assert find_evidence(engine, nothing, ["mug"], features) is None


def test_evidence_of_several_is_of_the_best_region(engine, features):
    both = run_phrase(engine, "mug or plant").answer
    uneven = replace(both, even=np.where(MUG, both.even, 0.5 * both.even))
    found = find_evidence(engine, uneven, ["plant", "mug"], features)
    assert both.members.sum() > MUG.sum()
    np.testing.assert_array_equal(found.members, MUG)
    assert found.phrase == "mug"


@pytest.mark.parametrize("wrong", ["size", "numbers"])
def test_features_of_another_scene_are_refused(engine, features, wrong):
    labels, vectors = features[0].labels, features[0].vectors
    changed = {"size": (labels[..., :-1], vectors), "numbers": (labels, vectors[:, 1:])}
    other = ImageFeatures(*changed[wrong])
    with pytest.raises(FormatError, match="another scene"):
        find_evidence(engine, engine.run("mug"), ["mug"], [other] * VIEWS)


# On the command line, with what a training keeps.


@pytest.fixture
def trained(tmp_path, monkeypatch, scene, features):
    """The blobs as if they had been trained, "a.ply", with photographs in "photographs"."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(query, "load_text_encoder", lambda name: FakeEncoder())
    as_trained(tmp_path / "a.ply", scene, features)
    return tmp_path


def test_query_why_draws_a_sheet(trained, capsys):
    assert run("query", "a.ply", "mug", "book", "--why", "out.png", "--json") == 0
    mug, book = (answer["evidence"] for answer in json.loads(capsys.readouterr().out))
    assert (mug["for"], mug["against"], mug["phrase"]) == (5, 2, "mug")
    assert mug["interval"][0] < mug["share"] < mug["interval"][1]
    assert mug["rows"][4]["photograph"] == f"photo_{WRONG}"
    assert book["for"] == 0
    with Image.open("out.png") as sheet:
        assert sheet.height > 800  # of both
        yellow, blue = ((np.asarray(sheet) == colour).all(-1) for colour in ((255, 210, 0), (0, 200, 255)))
    assert yellow.sum() > 1000
    assert blue.sum() > 200  # of the merged one and the blank one, whose masks lie elsewhere
    (trained / "a.work").rename(trained / "w")
    (trained / "photographs").rename(trained / "p")
    assert run("query", "a.ply", "mug", "--why", "new.png", "--work", "w", "--photographs", "p") == 0
    assert (trained / "new.png").exists()
    assert f"worst photo_{WRONG}" in capsys.readouterr().out


def test_photographs_answer_beside_the_field(trained, capsys, monkeypatch, shown, scene):
    """A segmenter that outlines the mug in all photographs but one, all things as "plant", and no book."""
    seen = iter([(mug & (view != BLANK), every & False, every) for view, (mug, every) in enumerate(shown)])
    stub = SimpleNamespace(segment=lambda image, phrases: np.stack(next(seen), -1))
    monkeypatch.setattr(query, "load_text_segmenter", lambda model: stub)
    assert run("query", "a.ply", "mug", "book", "plant", "--segmenter", "stub", "--json") == 0
    mug, book, plant = json.loads(capsys.readouterr().out)
    counts = [answer["photographs_with_masks"] for answer in (mug, book, plant)]
    assert counts == [sum(one.any() for one, _ in shown) - 1, 0, sum(every.any() for _, every in shown)]
    assert [answer["found_by"] for answer in (mug, book, plant)] == ["both", "the field", "both"]
    things = [{thing["found_by"] for thing in answer["instances"]} for answer in (mug, book, plant)]
    assert things == [{"both"}, {"the field"}, {"the photographs"}]  # of that the field has a third
    np.testing.assert_allclose(mug["place"], CENTRES[0], atol=0.2)


def test_shares_in_masks_are_those_of_the_reference():
    scene = Scene(random_gaussians(30), cameras=tuple(random_camera(n, 24, 18) for n in range(3)))
    masks = dict(zip(scene.cameras, np.random.default_rng(0).random((3, 18, 24, 2)) < 0.5, strict=True))
    masks[scene.cameras[1]][:] = False
    got, counts = shares_in_masks(scene, masks.__getitem__)
    weights = {camera: dense_weights(scene.gaussians, camera) for camera in masks}
    inside = sum(np.einsum("hwn,hwc->nc", weights[camera], 1.0 * masks[camera]) for camera in masks)
    seen = sum(weight.sum((0, 1))[:, None] for weight in weights.values())
    np.testing.assert_allclose(got, np.where(seen > 1e-3, inside / seen, np.nan), atol=1e-4)
    assert counts.tolist() == [2, 2]


@pytest.mark.long
def test_true_masks_lift_to_the_things_that_they_show():
    """Of the bundled scene, whose regions have known names: of these two the field finds the lid, roughly."""
    room = bundled_room()
    scene = replace(room.scene, cameras=tuple(camera.within(320) for camera in room.scene.cameras[::8]))
    engine, members = QueryEngine(scene, load_text_encoder), room.tree.gaussians()
    truth = np.zeros((len(scene.gaussians), 2), np.float32)
    for node, names in room.parts.items():
        truth[members[node]] += [name in names for name in ("lid", "spout")]
    shares, _ = shares_in_masks(scene, lambda camera: view_of(scene, camera).splat(truth)[0] > 0.5)
    spoke = ("lid", "both"), ("spout", "the photographs")
    for (name, who), own, share in zip(spoke, truth.T > 0, shares.T, strict=True):
        masked = with_masks(engine, run_phrase(engine, name).answer, share)
        found = np.stack([masked.field, masked.masks, masked.answer.members])
        field, lifted, both = (found & own).sum(1) / (found | own).sum(1)
        assert min(lifted, both) > max(field + 0.1, 0.95)
        assert (masked.found_by(), masked.answer.found) == (who, True)


@pytest.mark.parametrize("spoil", ["work", "mask", "truncated", "report", "photograph"])
def test_missing_masks_are_one_line(trained, capsys, spoil):
    work, out = trained / "a.work", "out.png"
    mask = work / "features" / "photo_3.features.npz"
    told = {
        "work": ("--work", lambda: work.rename(trained / "elsewhere")),
        "mask": ("photo_3", mask.unlink),
        "truncated": ("photo_3", lambda: mask.write_bytes(mask.read_bytes()[:200])),
        "report": ("--photographs", (work / "report.json").unlink),
        "photograph": ("photo_7", (trained / "photographs" / "photo_7.png").unlink),
    }  # fmt: skip
    names, break_it = told[spoil]
    break_it()
    assert run("query", "a.ply", "mug", "--why", out) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning")]
    assert names in said[-1]
    assert not (trained / out).exists()


def test_changed_photographs_are_refused_before_they_are_located(trained, scene):
    (trained / "a.work" / "sfm-0").mkdir()
    (trained / "photographs" / "transforms.json").rename(trained / "a.work" / "sfm-0" / "matches.json")
    stated = {"dataset": str(trained / "photographs"), "contents": {"photo_3": "another"}}
    (trained / "a.work" / "report.json").write_text(json.dumps(stated))
    with pytest.raises(InputError, match=r"not the files that were trained on.*: photo_3;"):
        kept_photographs(trained / "a.ply", scene)


@pytest.mark.long
def test_a_training_keeps_all_that_is_needed(tmp_path):
    """Also for masks of no segmenter, which agree later."""
    room = tiny_room(tmp_path / "room")
    train_scene(room, tmp_path / "a.ply", tiny_settings(room))
    scene = load_scene(tmp_path / "a.ply")
    engine, seen = QueryEngine(scene), kept_features(tmp_path / "a.ply", scene)
    photographs = kept_photographs(tmp_path / "a.ply", scene)
    assert [image.shape[:2] for image in photographs.values()] == [(48, 64)] * len(scene.cameras)
    whole = engine.tree.at(2)  # the largest, which every training makes large enough to be seen
    answer = replace(engine.run("red mug", "whole"), members=whole == np.bincount(whole[whole >= 0]).argmax())
    found = find_evidence(engine, answer, ["red mug"], seen)
    assert found.votes or found.others
    other = replace(scene, cameras=tuple(replace(one, name=scene.cameras[-1].name) for one in scene.cameras))
    for place, of in ("b.ply", scene), ("a.ply", other):
        with pytest.raises(InputError, match="--work"):
            kept_features(tmp_path / place, of)


def test_a_taught_word_is_compared_with_what_was_shown(engine, features):
    """No text says what it is; the mask of another region is told from those of what was shown."""
    engine.teach("gizmo", MUG, "whole")
    found = find_evidence(engine, engine.run("gizmo"), ["gizmo"], features)
    np.testing.assert_array_equal(found.members, MUG)
    *right, wrong = found.votes
    assert wrong.view == WRONG
    assert wrong.fit < 0 < min(vote.fit for vote in right)
    del engine.taught["gizmo"]


# Labels of Gaussians for other programs.

LOOSE = 7  # Gaussians of the last blob that are in no node
PART = slice(PER_BLOB, PER_BLOB + 40)


def labelled_scene() -> Scene:
    """Wholes 3, 4, 5 with the blobs' names; node 0, some of the second blob, is a part of the first whole."""
    scene = named_scene()
    leaves = np.repeat(np.arange(3, 6, dtype=np.int32), PER_BLOB)
    leaves[PART], leaves[-LOOSE:] = 0, NO_NODE
    parents = np.array([3, 4, 5, NO_NODE, NO_NODE, NO_NODE], np.int32)
    votes = np.ones((6, 2), np.uint16)
    tree = Tree(leaves, parents, np.array([2, 1, 1, 2, 2, 2], np.uint8), votes)
    extras = {"instance": np.zeros(len(leaves), np.uint8), "time": np.ones(len(leaves), np.float32)}
    return replace(scene, language=replace(scene.language, tree=tree), extras=extras)


def describer(scene: Scene) -> Describer:
    return Describer(QueryEngine(scene, lambda _: FakeEncoder()), NAMES)


def test_labels_are_those_of_the_tree_and_its_words(tmp_path):
    beside = export_labels(describer(labelled_scene()), tmp_path / "out.ply")
    assert beside == tmp_path / "out.labels.json"
    got, said = load_scene(tmp_path / "out.ply"), json.loads(beside.read_text())
    assert set(got.extras) == {"instance", "part", "class", "time"}
    assert got.language is not None
    nodes = {node["node"]: node for node in said["nodes"]}
    whole = np.repeat([3, 4, 5], PER_BLOB)
    whole[PART], whole[-LOOSE:] = 3, NO_NODE
    np.testing.assert_array_equal(got.extras["instance"], whole)
    names = [None if number == NO_NODE else said["classes"][number] for number in got.extras["class"]]
    assert names == [None if node == NO_NODE else WORDS[node - 3] for node in whole]
    for blob, node in enumerate((3, 4, 5)):
        low, high = nodes[node]["box"]
        assert (np.less(low, CENTRES[blob]) & np.less(CENTRES[blob], high)).all()
        assert nodes[node]["gaussians"] == (whole == node).sum()
        assert nodes[node]["parent"] == NO_NODE
    np.testing.assert_array_equal(got.extras["part"][PART], 0)
    same = np.delete(np.arange(3 * PER_BLOB), PART)
    np.testing.assert_array_equal(got.extras["part"][same], whole[same])
    assert nodes[0]["parent"] == 3
    assert nodes[0]["word"] == WORDS[1]


def test_no_labels_are_left_where_the_scene_cannot_be_written(tmp_path):
    (tmp_path / "out.labels.json").mkdir()
    with pytest.raises(InputError, match=r"out\.labels\.json: is a folder"):
        export_labels(describer(labelled_scene()), tmp_path / "out.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["out.labels.json"]

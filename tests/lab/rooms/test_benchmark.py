"""The benchmark on procedural rooms: oracles, scores in closed form, and the whole command on a tiny room."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from langsplat_core.arrays import unit
from langsplat_core.cli.evaluate import EvalSynthetic
from langsplat_core.cli.run import main
from langsplat_core.config import BenchmarkConfig, DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from langsplat_core.formats import load_scene
from langsplat_core.lab.demo import SEED
from langsplat_core.lab.rooms import scoring as synthetic
from langsplat_core.lab.rooms.benchmark import run_benchmark
from langsplat_core.lab.rooms.oracles import (
    MIN_REGION,
    TruthMasks,
    among_pictures,
    phrase_vectors,
    told_vectors,
    true_labels,
)
from langsplat_core.lab.rooms.report import separation
from langsplat_core.lab.rooms.scoring import (
    Answer,
    Asked,
    Phrase,
    Truth,
    ask,
    evaluate_direct,
    found_rate,
    read_truth,
    relevancy_maps,
)
from langsplat_core.lab.rooms.variants import variants
from langsplat_core.lab.world import photographs as dataset
from langsplat_core.lab.world.assembly import build_room
from langsplat_core.progress import silent
from langsplat_core.query.cut import CUT_RULES, cut_level
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.pixels import decoded_relevancy, splatted_relevancy
from langsplat_core.query.relevancy import latent_relevancy
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import CANONICAL_PHRASES, LanguageField, Scene
from langsplat_core.semantics.masks import label_maps
from langsplat_core.semantics.store import ImageFeatures
from tests.query.test_engine import random_codec, two_blob_scene
from tests.support.scenes import random_camera, random_gaussians

TINY = BenchmarkConfig(
    tiers=("separate",), views=8, size=(64, 48), steps=60, max_gaussians=3_000, codec_steps=60, budget=True
)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Layers this small are many times slower on several threads where other work wants the cores too."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The whole command on a tiny room: its output, its figures, and its work folder."""
    folder = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "_LIGHT_SAMPLES", 2)
        patch.setattr(dataset, "_LIGHT_CELL", 0.0)
        patch.setattr(synthetic, "MIN_PIXELS", 12)
        command = EvalSynthetic(TINY, work=folder / "work", json=folder / "figures.json")
        command.run()
        made = {path: path.stat().st_mtime_ns for path in (folder / "work").rglob("*") if path.is_file()}
        command.run()
    return SimpleNamespace(
        room=folder / "work" / "separate-101-8x64x48",
        made=made,
        work=folder / "work",
        figures=json.loads((folder / "figures.json").read_text()),
    )


@pytest.fixture(scope="module")
def capture(run):
    photographs = run.room / "photographs"
    return load_capture(photographs, DatasetConfig(max_side=64), run.room, silent)


# ---- the whole command ----


def test_the_command_measures_every_stage(run):
    (room,) = run.figures["rooms"]
    assert (room["views"], room["held_out"]) == (7, 1)
    assert [row["name"] for row in room["measured"]] == [v.name for v in variants("truth", True)]
    for row in room["measured"]:
        assert sum(score["queries"] for score in row["scores"]) > 3
        assert all(0 <= score["mean_iou"] <= 1 for score in [*row["scores"], *row["direct"]])
        assert row["absent"] > 0
        assert row["query_ms"] > 0
    assert run.figures["settings"]["seeds"] == [101]


def test_rows_differ_in_the_named_stage(run):
    by_name = {row["name"]: row for row in run.figures["rooms"][0]["measured"]}
    ours = by_name["the method"]
    # The query's variants ask the very same field, another codec or embedding is another field.
    assert by_name["exact query"]["codec_cosine"] == ours["codec_cosine"]
    assert by_name["the paper's order"]["codec_cosine"] == ours["codec_cosine"]
    assert by_name["the paper's order"]["direct"] == ours["direct"]
    assert by_name["the paper's order"]["rejected"] == ours["rejected"]
    assert by_name["no codec"]["codec_cosine"] > 0.99 > ours["codec_cosine"]
    assert len(list(run.room.glob("scene-*.ply"))) == 3


def test_a_second_run_makes_nothing_again(run):
    now = {path: path.stat().st_mtime_ns for path in run.work.rglob("*") if path.is_file()}
    assert now == run.made


@pytest.mark.parametrize("masks", ["truth", "graph"])
def test_variants_swap_one_stage_at_a_time(masks):
    method, *others = (asdict(variant) for variant in variants(masks, budget=True))
    swapped = [{key for key in method if key != "name" and method[key] != other[key]} for other in others]
    expected = [{"vectors"}, {"codec"}, {"query"}, {"query"}]
    assert swapped == ([{"masks"}] if masks == "graph" else []) + expected
    assert len(variants(masks, budget=False)) == 1


# ---- oracles ----


def test_truth_masks_are_the_truth(run, capture):
    truth = read_truth(run.room / "photographs")
    source = TruthMasks(capture, truth)
    for image, camera in zip(capture.images[:3], capture.cameras, strict=False):
        ids = truth.labels(camera.name)
        for level, rows in zip(ids, label_maps(source(image, silent)), strict=True):
            expected = {n: level == n for n in np.unique(level[level >= 0])}
            expected = {n: mask for n, mask in expected.items() if mask.sum() >= MIN_REGION}
            got = [rows == row for row in np.unique(rows[rows >= 0])]
            assert len(got) == len(expected) > 0
            assert {mask.tobytes() for mask in got} == {mask.tobytes() for mask in expected.values()}


def test_truth_masks_refuse_a_strange_photograph(run, capture):
    source = TruthMasks(capture, read_truth(run.room / "photographs"))
    with pytest.raises(InputError, match="no truth for this photograph"):
        source(255 - capture.images[0], silent)


class Speller:
    """A text encoder that gives every phrase its own axis and does not know cactuses."""

    def __init__(self) -> None:
        self.known: dict[str, int] = {}

    def encode_texts(self, texts):
        return np.stack(
            [np.eye(512, dtype=np.float32)[self.known.setdefault(t, len(self.known))] for t in texts]
        )

    def unknown_words(self, text):
        return tuple(word for word in text.split() if word == "cactus")


def test_perfect_embeddings_are_text_vectors_of_the_true_words():
    names = {0: "red mug", 1: "handle of the red mug", 2: "blue cactus", 3: ""}
    encoder = Speller()
    vectors = phrase_vectors(Truth(None, (), frozenset(), names), encoder)
    assert set(vectors) == {0, 1}
    ids = np.full((3, 4, 5), 0)
    ids[1, :, :3], ids[1, :, 3:] = 1, 2
    ids[2, 0] = -1
    labels = np.full((3, 4, 5), -1, np.int32)
    labels[0], labels[1, :, :4], labels[1, :, 4:], labels[2] = 0, 1, 2, 3
    own = unit(np.random.default_rng(0).normal(size=(4, 512))).astype(np.float32)
    told = told_vectors(ImageFeatures(labels, own), ids, vectors)
    want = [encoder.encode_texts([text])[0] for text in ("red mug", "handle of the red mug")]
    np.testing.assert_array_equal(told.vectors, [want[0], want[1], own[2], want[0]])
    np.testing.assert_array_equal(told.labels, labels)


def test_text_vectors_are_moved_as_one():
    rng = np.random.default_rng(1)
    labels = np.zeros((3, 2, 2), np.int32)

    def described(mean):
        return ImageFeatures(labels, unit(rng.normal(size=(6, 8)) + mean).astype(np.float32))

    told, seen = [described(2.0), described(2.0)], [described(-2.0), described(-2.0)]
    moved = among_pictures(told, seen)
    shift = np.mean([item.vectors for item in seen], (0, 1)) - np.mean(
        [item.vectors for item in told], (0, 1)
    )
    for got, text in zip(moved, told, strict=True):
        np.testing.assert_allclose(got.vectors, unit(text.vectors + shift), atol=1e-6)


def test_every_region_of_a_room_has_a_right_phrase():
    for label in build_room(5, "separate").labels:
        assert label.phrase in label.words or not label.phrase
        if label.thing:
            assert label.thing in label.phrase
            assert label.thing_colour in label.phrase


def test_a_gaussian_is_what_it_shows_most_of():
    scene, *_ = two_blob_scene()  # 60 Gaussians around x = -1, then 60 around x = 1, at z = 4
    camera = replace(random_camera(0, 64, 48, off_centre=False), world_to_camera=np.eye(4))
    alpha = CpuRasterizer().view(scene.gaussians, camera).splat(np.ones((120, 1), np.float32))[1]
    ids = np.full((3, 48, 64), -1)
    columns = np.arange(64)[None].repeat(48, 0)
    ids[2] = np.where(alpha > 0.02, np.where(columns < camera.cx, 7, 9), -1)
    got = true_labels(CpuRasterizer(), scene.gaussians, [(camera, ids)] * 2)
    assert (got[2][:60] == 7).all()
    assert (got[2][60:] == 9).all()
    assert (got[:2] == -1).all()


# ---- scores ----


def answer(values, peak=1.0, level=2, vector=None, found=True) -> Answer:
    values = np.asarray(values, np.float32)
    return Answer(
        np.zeros(4) if vector is None else vector, level, values, peak, float(np.median(values)), found
    )


def test_direct_overlap_has_its_closed_form():
    labels = np.full((3, 200), -1)
    labels[2, :180] = np.repeat([0, 1, 2], 60)  # the last 20 are shown nowhere
    values = np.zeros(200)
    values[30:100] = 0.9  # 30 of thing 0, 40 of thing 1
    values[180:] = 0.9
    phrases = (
        Phrase("mug", "object", (0,)),
        Phrase("mug or bowl", "object", (0, 1)),
        Phrase("rare", "part", (5,)),
    )
    answers = {phrase.text: answer(values) for phrase in phrases}
    truth = Truth(None, phrases, frozenset())
    (score,) = evaluate_direct(Asked(None, answers, (), 0.0), labels, truth)
    assert (score.kind, score.phrases) == ("object", 2)
    assert score.mean_iou == pytest.approx((30 / 100 + 70 / 120) / 2)


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("floor", 0.7),
        ("median", 0.6),
        ("range", 0.1 + 0.7 * 0.8),
    ],
)
def test_cuts(rule, expected):
    values = np.array([[0.1, 0.3], [0.3, 0.9]])
    assert cut_level(rule, values, peak=0.9, median=0.3) == pytest.approx(expected)


@pytest.mark.parametrize("rule", CUT_RULES)
def test_a_cut_never_lets_a_flat_map_through(rule):
    assert not (np.full((4, 4), 0.5) > cut_level(rule, np.full((4, 4), 0.5), 0.5, 0.5)).any()


def test_separation_is_the_chance_of_the_right_order():
    assert separation(np.array([0.9, 0.5]), np.array([0.5, 0.1, 0.6])) == pytest.approx(4.5 / 6)
    assert separation(np.array([0.9]), np.zeros(0)) == 1.0


def test_absent_things_have_no_other_name_in_the_room():
    truth = Truth(None, (), frozenset({"mug", "cup", "orange", "couch"}))
    assert truth.absent(["mug", "orange", "sofa", "lamp", "apple"]) == ["apple", "lamp"]


def test_unknown_phrases_are_named_not_asked():
    scene, *_ = two_blob_scene()
    rows = {text: 8 + row for row, text in enumerate(CANONICAL_PHRASES)}  # as the scene has them
    axes = SimpleNamespace(
        encode_texts=lambda texts: np.eye(16, dtype=np.float32)[[rows.get(text, 0) for text in texts]],
        unknown_words=Speller().unknown_words,
    )
    asked = ask(QueryEngine(scene, axes), ["mug", "red cactus", "mug"])
    assert asked.unknown == ("red cactus",)
    assert found_rate(asked, ["mug", "red cactus"]) == (1.0, 1)


@pytest.fixture(scope="module")
def random_scene() -> Scene:
    """400 Gaussians with random latents of a random autoencoder."""
    rng = np.random.default_rng(3)
    gaussians = random_gaussians(400, 3)
    latents = unit(rng.normal(size=(3, 400, 3))).astype(np.float32)
    canonical = unit(rng.normal(size=(4, 16))).astype(np.float32)
    field = LanguageField(latents, np.ones((3, 400), np.float32), random_codec(rng), canonical, "x")
    return Scene(gaussians, field)


@pytest.mark.parametrize("paper_order", [True, False])
def test_maps_of_all_phrases_together_equal_those_one_by_one(random_scene, monkeypatch, paper_order):
    rng = np.random.default_rng(4)
    engine = QueryEngine(random_scene)
    view = CpuRasterizer().view(random_scene.gaussians, random_camera(1))
    vectors = unit(rng.normal(size=(5, 16))).astype(np.float32)
    levels = (2, 0, 2, 2, 0)
    answers = [
        answer(engine.relevancy(v)[level], level=level, vector=v)
        for v, level in zip(vectors, levels, strict=True)
    ]
    decoded = []

    def counting(*arguments):
        decoded.append(arguments[2])
        return decoded_relevancy(*arguments)

    monkeypatch.setattr(synthetic, "decoded_relevancy", counting)
    maps = list(relevancy_maps(engine, view, answers, paper_order))
    assert sorted(decoded) == ([0, 2] if paper_order else [])
    for got, one in zip(maps, answers, strict=True):
        if paper_order:
            want = decoded_relevancy(view, engine.field, one.level, one.vector[None], 0.3)[..., 0]
        else:
            want = splatted_relevancy(view, one.values[:, None], 0.3)[..., 0]
        # float32 products of other sizes round differently; relevancy magnifies a cosine by at most 2.5
        np.testing.assert_allclose(got, want, atol=1e-5)


def test_an_exact_engine_decodes_every_gaussian(random_scene):
    vector = unit(np.random.default_rng(5).normal(size=16)).astype(np.float32)
    field = random_scene.language
    want = latent_relevancy(field.codec, field.latents.reshape(-1, 3), vector[None], field.canonical)
    exact = QueryEngine(random_scene, exact=True).relevancy(vector)
    np.testing.assert_allclose(exact, want.reshape(3, 400), atol=1e-6)
    assert np.abs(QueryEngine(random_scene).relevancy(vector) - exact).max() > 1e-6


# ---- what cannot be measured ----


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (EvalSynthetic(replace(TINY, seeds=(101, SEED))), "bundled scene's room"),
        (EvalSynthetic(replace(TINY, seeds=())), "at least one"),
        (EvalSynthetic(replace(TINY, views=5)), "at least 8"),
        (EvalSynthetic(scene="a.ply"), "belong together"),
        (EvalSynthetic(TINY, paper_order=True), "needs --scene"),
    ],
)
def test_mistakes_end_with_one_line(command, message, capsys):
    assert main("langsplat", lambda: command) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_bundled_seed_is_refused_before_any_work(tmp_path):
    with pytest.raises(InputError, match="another seed"):
        run_benchmark(replace(TINY, seeds=(SEED,)), tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_scene_mode_still_measures_a_pair(run, capsys, monkeypatch):
    monkeypatch.setattr(synthetic, "MIN_PIXELS", 12)
    path = min(run.room.glob("scene-*.ply"))
    assert load_scene(path).language is not None
    EvalSynthetic(scene=path, dataset=run.room / "photographs").run()
    assert "absent objects rejected" in capsys.readouterr().out

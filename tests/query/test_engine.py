"""Asking: encoders, phrasebooks, many phrases, processes and threads; relevancy against its definition."""

import math
import multiprocessing
import pickle
import threading
import time
import tracemalloc
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.config import ClipConfig, TrainConfig
from langsplat_core.errors import EncoderError, InputError, LangSplatError, UnknownWordError
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.io.sidecar import read_words, write_words
from langsplat_core.pipeline.notebook import draw
from langsplat_core.pipeline.train import train_scene
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import (
    Lookup,
    decoded_relevancy,
    peak_pixel,
    sphere_cells,
    splatted_relevancy,
    through_cells,
)
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.raster.render import render
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    AutoencoderCodec,
    Calibration,
    LanguageField,
    LinearCodec,
    PlattScaling,
    Scene,
)
from langsplat_core.semantics import relevancy as relevancies
from langsplat_core.semantics.encoders import DEMO, OPEN_MODEL, keep_calibration, load_text_encoder
from langsplat_core.semantics.relevancy import FEWEST, Scale, latent_relevancy, relevancy_of
from tests.support.fakes import (
    DIM,
    PER_BLOB,
    WORDS,
    FakeEncoder,
    Fluent,
    axis,
    blob_scene,
    blobs,
    named_field,
    named_scene,
)
from tests.support.file_samples import random_field
from tests.support.scenes import random_camera, random_gaussians, tree_of_wholes


def test_engine_errors_say_what_to_do():
    class Other(FakeEncoder):
        def __init__(self, vector: Array) -> None:
            self.vector = vector

        def encode_texts(self, texts: list[str]) -> Array:
            return np.stack([self.vector] * len(texts))

    with pytest.raises(UnknownWordError, match=r"'brook' \(did you mean 'book'\?\); use other words"):
        QueryEngine(named_scene(), lambda _: FakeEncoder()).run("brook")
    for vector in (np.ones(3, np.float32), axis(0)):
        with pytest.raises(EncoderError, match="other weights of fake, vectors of 8 numbers"):
            QueryEngine(blob_scene(), lambda _, vector=vector: Other(vector)).run("mug")


@pytest.mark.parametrize("phrase", ["the", "'the'!", "of the"])
def test_stop_words_alone_are_refused(phrase):
    """An encoder has a vector for them too, and something is always near it."""
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder())
    for ask in (engine.run, lambda text: engine.run_many(["mug", text])):
        with pytest.raises(InputError, match="names nothing to look for"):
            ask(phrase)
    assert engine.texts.of_known([phrase, "mug"])[0] == ("mug",)


def test_check_phrase_raises_what_asking_would():
    engine = QueryEngine(blob_scene(phrasebook=True))
    check_phrase(engine, "Book")
    with pytest.raises(EncoderError, match="phrasebook"):
        check_phrase(engine, "book or mug")
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder())
    with pytest.raises(UnknownWordError, match="did you mean 'plant'") as unknown:
        check_phrase(engine, "mug near the plamt")
    assert unknown.value.near == {"plamt": ("plant",)}
    for text, said in (("mug behind the plant", "where one stands"), ("?", "empty")):
        with pytest.raises(InputError, match=said):
            check_phrase(engine, text)


@pytest.mark.parametrize(("encoder_id", "asked_for"), [("", "fake"), ("mine", "mine")])
def test_encoder_is_loaded_once_when_needed(encoder_id, asked_for):
    loaded = []

    def load(name: str) -> FakeEncoder:
        loaded.append(name)
        return FakeEncoder()

    engine = QueryEngine(blob_scene(phrasebook=True), load, encoder_id=encoder_id)
    told = []
    with pytest.raises(InputError):
        engine.run("  ")
    assert engine.run("  Book ", progress=lambda label, _: told.append(label)).found
    assert engine.unknown_words("BOOK") == ()
    assert (loaded, told) == ([], ["searching 'Book'"])
    assert engine.run(" Plant ", progress=lambda label, _: told.append(label)).phrase == "Plant"
    engine.run("mug", progress=lambda label, _: told.append(label))
    assert engine.unknown_words("red mug") == ("red",)
    assert loaded == [asked_for]
    assert told[1:] == ["loading the text encoder", "searching 'Plant'", "searching 'mug'"]


def test_answers_reach_other_processes_and_say_where_in_the_world():
    scene = replace(blob_scene(), origin=np.array([5e5, 5.4e6, 0]))
    answer = QueryEngine(scene, FakeEncoder()).run("mug")  # what loads an encoder, or one
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(answer)).members, answer.members)
    np.testing.assert_array_equal(asdict(answer)["members"], answer.members)
    assert repr(answer).endswith(f"near {scene.in_world(answer.place)}>")


def test_wrong_kinds_are_named_and_arrays_are_not_printed():
    scene = blob_scene()
    engine, demo = QueryEngine(scene, FakeEncoder()), TrainConfig(clip=ClipConfig(DEMO))
    for wrong, said in (
        (lambda: render(scene, 0), "expected a Camera, got int; scene.cameras has those of a scene"),
        (lambda: render("a.ply", scene.cameras[0]), "expected a Scene, got str; load_scene"),
        (lambda: save_scene("a.ply", scene.gaussians), "expected a Scene, got Gaussians; Scene\\(gaussians"),
        (lambda: Scene("a.ply"), "expected a Gaussians, got str; load_scene"),
        (lambda: Scene(scene.gaussians, scene.gaussians), "LanguageField.*, got Gaussians; a scene"),
        (lambda: Scene(scene.gaussians, cameras=scene.cameras[0]), "got Camera; say cameras=\\(camera,"),
        (lambda: load_scene(3), "got int; name the file"),
        (lambda: engine.run("  "), "empty"),
        (lambda: engine.run("mug", "Whole"), "no level 'Whole'; choose"),
        (lambda: engine.run(["mug"]), "a phrase is text"),
        (lambda: engine.run_many("mug"), "a phrase is text"),
        (lambda: QueryEngine(Scene(scene.gaussians)).run("mug"), "langsplat train"),
        (lambda: QueryEngine(scene, "demo"), "no name alone"),
        (lambda: QueryEngine(scene).run("sofa"), "only the phrases in the scene's phrasebook"),
        (lambda: QueryEngine(scene).like(np.ones(2, bool)), r"members: expected shape \(N\)"),
        (lambda: render(scene, scene.cameras[0], np.full((len(scene.gaussians), 1), np.nan)), "not finite"),
        (lambda: load_text_encoder("demo", "gpu"), "device gpu: choose one of auto, cpu, cuda"),
        (lambda: QueryEngine(scene, rule="best"), "no rule 'best'; choose regions or peak"),
        (lambda: QueryEngine(scene, words={}), "Words.*, got dict; read_words"),
        (lambda: engine.instances(run_phrase(engine, "mug")), "expected a QueryResult, got ComposedResult"),
        (lambda: load_text_encoder("demo").encode_texts("mug"), "phrases are several texts"),
        (lambda: read_words(3), "got int; name a file that write_words"),
        (lambda: save_scene(scene, "a.ply"), "got Scene; say save_scene\\(path, scene"),
        (lambda: load_text_encoder(3), "got int; a folder, a file, a hub id"),
        (lambda: render(scene, scene.cameras[0], profile="inria"), "got str; config.INRIA"),
        (lambda: draw(scene, scene.cameras[0]), "got Camera; say draw\\(scene, \\(width"),
        (lambda: draw(scene, answer="mug"), "expected a QueryResult, got str; run_phrase"),
        (lambda: run_phrase(engine, "mug left of book", viewpoint=0), "Camera.*, got int"),
        (lambda: train_scene("p", "a.ply", {}), "expected settings such as TrainConfig.*, got dict"),
        (lambda: write_words({}, "a.safetensors"), "got str; say write_words"),
        (lambda: train_scene("absent", "a.ply", demo, "w"), "absent does not exist"),
        (lambda: train_scene("p", "a.ply", {}, until="masks"), "until 'masks': no stage .*'language"),
    ):
        with pytest.raises((LangSplatError, ValueError), match=said):
            wrong()
    found = run_phrase(engine, "mug")
    drawn = [np.asarray(draw(scene, (64, 48), answer)) for answer in (found, found.answer)]
    np.testing.assert_array_equal(*drawn)
    shown = repr((scene.gaussians, scene.language, render(scene, scene.cameras[0])))
    parts = scene.language.codec, tree_of_wholes(np.zeros(360, int)), engine.surface, scene.cameras
    assert "array" not in shown + repr(parts)
    assert "members" not in repr(engine.instances(found.answer))  # thousands of numbers
    assert repr(parts[0]) == "<linear codec of 4, for vectors of 8 numbers>"
    assert "<360 Gaussians, SH degree 0>, <language field of 360 Gaussians" in shown


def test_peak_pixel_is_the_middle_one_of_equal_means():
    image = np.zeros((33, 47), np.float32)
    image[10:21, 5:16] = 1  # means over 5 px are 1 at 7 x 7 places
    assert peak_pixel(image, 5) == (10, 15, pytest.approx(1))
    image[30, 40] = 26
    assert peak_pixel(image, 5) == (40, 30, pytest.approx(26 / 25))
    assert peak_pixel(image[:1, :1], 90) == (0, 0, 0)


def with_phrases(field: LanguageField, count: int) -> LanguageField:
    """Whose phrasebook holds so many random ones, and no other."""
    vectors = unit(np.random.default_rng(8).normal(size=(count, field.codec.vector_dim))).astype(np.float32)
    return replace(field, phrasebook={f"phrase {number}": vector for number, vector in enumerate(vectors)})


def test_many_answers_take_no_memory_per_gaussian():
    asked = with_phrases(random_field(30_000, "codebook"), 60)
    book, engine = asked.phrasebook, QueryEngine(Scene(random_gaussians(30_000), asked))
    engine.run_many([*book])  # what depends on the scene, and the places of regions
    tracemalloc.start()
    many = engine.run_many([*book])
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert engine.rule == "regions"
    assert taken < 60 * 30_000
    assert many[7].members.shape == (30_000,)


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("rule", ["regions", "peak"])
@pytest.mark.parametrize("exact", [False, True])
def test_run_many_equals_run_one_by_one(kind, rule, exact):
    asked = replace(with_phrases(random_field(400, kind), 20), everyday=None)
    book = asked.phrasebook
    engine = QueryEngine(Scene(random_gaussians(400), asked), exact=exact, rule=rule)
    many = engine.run_many([*book, "Phrase 3"])
    assert [result.phrase for result in many] == [*book, "Phrase 3"]
    for phrase, together in zip([*book, "phrase 3"], many, strict=True):
        alone = engine.run(phrase)
        assert (together.level, together.found) == (alone.level, alone.found)
        for name in ("relevancy", "even", "scores"):
            np.testing.assert_allclose(getattr(together, name), getattr(alone, name), atol=1e-6)
        differ = together.members != alone.members  # at most where rounding decides
        np.testing.assert_allclose(alone.even[differ], min(alone.cut, together.cut), atol=1e-5)


def test_run_many_encodes_in_one_batch_or_not_at_all():
    class Counting(FakeEncoder):
        def encode_texts(self, texts):
            batches.append(texts)
            return super().encode_texts(texts)

    batches: list[list[str]] = []
    engine = QueryEngine(blob_scene(), lambda _: Counting())
    assert engine.run_many([]) == []
    with pytest.raises(EncoderError, match="'flurb'"):
        engine.run_many(["mug", "flurb"])
    with pytest.raises(InputError, match="empty"):
        engine.run_many(["mug", " "])
    assert batches == [list(CANONICAL_PHRASES)]  # by which the encoder is checked
    check_phrase(engine, "mug or book")
    assert len(engine.run_many(["mug", "book", "Mug"])) == 3
    run_phrase(engine, "book or mug")
    assert batches[1:] == [["mug", "book"]]  # each phrase once


# Questions and pictures from processes that were forked or spawned, and from many threads at once.

THREADS = 12


class OneAtATime(FakeEncoder):
    """Fails, as tokenizers do, where two threads ask at once."""

    made = 0

    def __init__(self) -> None:
        OneAtATime.made += 1
        self.busy = False

    def encode_texts(self, texts: list[str]) -> Array:
        assert not self.busy
        self.busy = True
        time.sleep(0.01)
        found = super().encode_texts(texts)
        self.busy = False
        return found


@cache  # in a forked process these are the parent's
def shared() -> tuple[QueryEngine, CpuRasterizer]:
    return QueryEngine(blob_scene(), lambda _: OneAtATime()), CpuRasterizer(threads=3)


def answers(_: int = 0) -> list[Array]:
    """Relevancies of every word, a picture, and one by a rasterizer with three threads."""
    engine, rasterizer = shared()
    view = rasterizer.view(random_gaussians(200, 4), random_camera(3, 60, 40))
    asked = [engine.run(word).relevancy for word in WORDS]
    return [*asked, render(blob_scene(), blob_scene().cameras[0]).colours, view.splat(np.ones((200, 2)))[0]]


def check_equal(found: list[Array], wanted: list[Array]) -> None:
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.long
@pytest.mark.parametrize("how", ["fork", "spawn", "forkserver"])
def test_forked_process_gives_its_parents_answers(how: str) -> None:
    if how not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {how} on this system")
    wanted = answers()  # with its threads begun, of which a fork takes none along
    with ProcessPoolExecutor(2, multiprocessing.get_context(how)) as pool:
        found = [future.result() for future in [pool.submit(answers) for _ in range(3)]]
    for one in found:
        check_equal(one, wanted)
    check_equal(answers(), wanted)


@pytest.mark.long
def test_twelve_threads_share_engine_and_rasterizer() -> None:
    wanted = answers()
    shared.cache_clear()
    fresh, made = shared(), OneAtATime.made  # nothing is remembered yet: all threads ask first
    together = threading.Barrier(THREADS)

    def ask(_: int) -> list[Array]:
        together.wait()
        return answers()

    with ThreadPoolExecutor(THREADS) as pool:
        for found in pool.map(ask, range(THREADS)):
            check_equal(found, wanted)
    assert shared() is fresh
    assert OneAtATime.made == made + 1


# What an answer is said to stand on.

CALIBRATED = Calibration(*[PlattScaling(0, 1, 1)] * 3)
# Far from what is in the scene, so that that is found clearly.
FAR = np.where(np.arange(DIM) < len(WORDS), 0.5, 1)
EVERYDAY = unit((FAR * np.random.default_rng(4).normal(size=(FEWEST, DIM))).astype(np.float32))


def scene_of(encoder: str, calibration: Calibration | None = None, *, everyday: bool = True) -> Scene:
    scene, vectors = named_scene(), EVERYDAY if everyday else None
    field = replace(scene.language, encoder_id=encoder, calibration=calibration, everyday=vectors)
    return replace(scene, language=field)


@pytest.mark.parametrize("encoder", [DEMO, "lab/clip"])
@pytest.mark.parametrize("calibration", [CALIBRATED, None])
@pytest.mark.parametrize("everyday", [True, False])
def test_basis_names_a_calibration_where_there_is_one(encoder, calibration, everyday):
    engine = QueryEngine(scene_of(encoder, calibration, everyday=everyday))
    before = engine.basis  # known before anything is asked, without loading an encoder
    answer = engine.run("mug")
    assert engine.basis == before
    assert (before.calibration is not None) == (answer.probability is not None)
    assert before.encoder == encoder
    assert before.guesses == (encoder == DEMO and calibration is None)
    assert (OPEN_MODEL in before.long) == before.guesses


def test_own_calibration_is_used_and_named_as_from_drawn_rooms(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    by_chance = QueryEngine(scene_of("lab/clip")).run("mug")
    encoder = Fluent(np.tile(axis(3), (4, 1)))
    encoder.id = "lab/clip"
    path = keep_calibration(encoder, CALIBRATED)
    assert path.is_relative_to(tmp_path)
    exact, later = encoder.encode_texts, Calibration(*[PlattScaling(0.0, 9.0, 0.0)] * 3)
    monkeypatch.setattr(encoder, "encode_texts", lambda texts: exact(texts) * np.float32(0.999))  # a GPU's
    assert keep_calibration(encoder, later) == path  # in place of the first
    assert QueryEngine(scene_of("lab/clip")).calibration == later
    for encoder, calibrated in (("elsewhere/clip", True), (DEMO, False)):  # by its vectors, not by its name
        engine = QueryEngine(scene_of(encoder))
        assert (engine.run("mug").probability is not None) == calibrated
        assert ("drawn rooms" in engine.basis.long and engine.basis.calibration is not None) == calibrated
    assert QueryEngine(scene_of("lab/clip", everyday=False)).run("mug").probability is None
    field = scene_of("lab/clip").language
    other = replace(field, canonical=axis(2)[None])  # another encoder
    assert QueryEngine(replace(scene_of("lab/clip"), language=other)).calibration is None
    path.write_text("{}", encoding="utf-8")
    assert QueryEngine(scene_of("lab/clip")).run("mug").judgement == by_chance.judgement
    assert str(path) in caplog.text


def test_everyday_phrases_of_the_encoder_are_used_once_loaded():
    engine = QueryEngine(scene_of("lab/clip", everyday=False), lambda _: Fluent(np.tile(axis(3), (4, 1))))
    published = engine.basis
    assert engine.run("mug").judgement.reached == "chance"
    assert engine.basis.short != published.short


def test_combined_answers_take_the_weakest_margin():
    scene = scene_of("lab/clip")
    book = scene.language.phrasebook | {"handle": axis(3)}
    engine = QueryEngine(replace(scene, language=replace(scene.language, phrasebook=book)))
    parts = [engine.run(text) for text in ("mug", "wall")]
    both = run_phrase(engine, "mug and wall").answer
    assert both.judgement.margin == min(part.judgement.margin for part in parts) < parts[0].judgement.margin
    either = run_phrase(engine, "mug or wall").answer
    assert either.judgement.margin == parts[0].judgement.margin
    assert run_phrase(engine, "mug near the wall").answer.judgement.margin <= parts[1].judgement.margin
    assert [part.found for part in (*parts, both, either)] == [True, False, False, True]
    inside = run_phrase(engine, "handle of the wall").answer
    assert inside.judgement.margin <= parts[1].judgement.margin
    none = run_phrase(engine, "mug, not mug").answer
    assert not none.members.any()
    assert {answer.probability for answer in (both, either, inside, none)} == {None}
    assert (inside.verdict, none.verdict) == ("not here", "not here")


# Relevancy of every Gaussian, by whatever the codec allows, against the definition.


def scale_of(field: LanguageField, chance: bool) -> Scale:
    return Scale(field.canonical, field.everyday if chance else None, field.temperature)


def plain_relevancy(vector: Array, phrase: Array, scale: Scale) -> float:
    """The definition, one meaning after the other, in float64."""
    vector, nearest = vector.astype(np.float64), float((scale.canonical @ vector).max())
    if scale.everyday is None:
        return 1 / (1 + math.exp(-scale.temperature * (float(phrase @ vector) - nearest)))
    cosines = sorted((float(other @ vector) for other in scale.everyday.astype(np.float64)), reverse=True)
    top = np.mean(cosines[: round(relevancies.TOP * len(cosines))])
    zero = relevancies.CANONICAL * nearest + (1 - relevancies.CANONICAL) * top
    return 1 / (1 + math.exp(-(float(phrase @ vector) - zero) / np.std(cosines)))


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("temperature", [10.0, 25.0])
@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("chance", [False, True])
def test_every_lookup_finds_the_relevancy_of_its_latents(kind, temperature, exact, chance):
    field = replace(random_field(300, kind), temperature=temperature)
    field.confidence[1, 5:20] = 0
    scale = scale_of(field, chance)
    phrase = unit(np.random.default_rng(3).normal(size=field.codec.vector_dim)).astype(np.float32)
    got = next(Lookup(field if exact else through_cells(field), scale).relevancies(phrase[None]))()
    vectors = field.codec.decode(field.latents.reshape(-1, field.latents.shape[2]))
    known = field.known.reshape(-1)
    want = [plain_relevancy(v, phrase, scale) if k else 0 for v, k in zip(vectors, known, strict=True)]
    assert np.abs(got.ravel() - want).max() < 1e-5
    assert (got[1, 5:20] == 0).all()
    assert not through_cells(replace(field, confidence=0 * field.confidence)).known.any()


def test_codeword_zero_is_a_feature():
    field = random_field(10, "codebook")
    field.latents[:] = 0
    field.confidence[:] = 1
    field.confidence[2, 4] = 0
    lookup = Lookup(field, scale_of(field, chance=False))
    values = next(lookup.relevancies(field.codec.vectors[:1]))()
    assert values[2, 4] == 0
    assert (np.delete(values[2], 4) > 0.5).all()


@pytest.mark.parametrize("everyday", [np.ones((1, 4)), np.eye(4)[[0] * 60], np.zeros((60, 4))])
def test_identical_everyday_phrases_give_finite_scales(everyday):
    scale = Scale(np.eye(4, dtype=np.float32)[:1], unit(everyday).astype(np.float32), 10.0)
    zero, rate = scale.of(np.eye(4, dtype=np.float32) @ scale.texts.T)
    values = relevancy_of(np.linspace(-1, 1, 4, dtype=np.float32), zero, rate)
    assert np.isfinite(values).all()
    assert ((values >= 0) & (values <= 1)).all()
    assert np.isfinite(scale.fit(values)).all()


def test_fit_inverts_relevancy():
    fits = np.linspace(-6, 6, 50)
    for scale, rate in ((Scale(np.eye(2), np.eye(2), 7.0), 1), (Scale(np.eye(2), None, 7.0), 7)):
        np.testing.assert_allclose(scale.fit(sigmoid(fits)), fits / rate, atol=1e-9)
        ends = scale.fit(np.array([0.0, 1.0]))
        widest = math.log((1 - relevancies.NARROWEST) / relevancies.NARROWEST)
        assert ends == pytest.approx(np.array([-widest, widest]) / rate)


D = 16


def smooth_codec(rng: np.random.Generator) -> AutoencoderCodec:
    def layer(a: int, b: int) -> tuple[Array, Array]:
        weights = rng.normal(size=(b, a)) * (1.6 / a**0.5)
        return weights.astype(np.float32), (0.3 * rng.normal(size=b)).astype(np.float32)

    def layers(*widths: int) -> tuple[tuple[Array, Array], ...]:
        return tuple(layer(a, b) for a, b in pairwise(widths))

    return AutoencoderCodec(layers(D, 24, 3), layers(3, 24, 32, D))


@pytest.mark.parametrize("linear", [False, True])
def test_published_relevancy_is_the_minimum_of_pairwise_softmaxes(linear):
    """Of latents of any length: a blend keeps the meaning of its direction, and zero means nothing."""
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.normal(size=(D, 6)))[0].T.astype(np.float32)
    codec = LinearCodec(np.ascontiguousarray(basis)) if linear else smooth_codec(rng)
    latents = unit(rng.normal(size=(50, codec.latent_dim))).astype(np.float32)
    phrases, canonical = unit(rng.normal(size=(3, D))), unit(rng.normal(size=(4, D)))
    vectors = codec.decode(latents).astype(np.float64)
    pairs = np.exp(10 * (vectors @ phrases.T))[..., None], np.exp(10 * (vectors @ canonical.T))[:, None]
    want = (pairs[0] / (pairs[0] + pairs[1])).min(-1)
    for length in (1.0, 0.02):
        got = latent_relevancy(codec, np.float32(length) * latents, phrases, canonical)
        np.testing.assert_allclose(got, want, atol=1e-5)
    assert (latent_relevancy(codec, 0 * latents, phrases, canonical) == 0).all()


def test_cells_converge_to_exact_decoding():
    rng = np.random.default_rng(6)
    codec = smooth_codec(rng)
    latents = unit(rng.normal(size=(4000, 3))).astype(np.float32)
    phrases, canonical = unit(rng.normal(size=(5, D))), unit(rng.normal(size=(4, D)))
    exact = latent_relevancy(codec, latents, phrases, canonical)
    errors = {}
    for most in (200, 3200):
        cells, centres = sphere_cells(latents, most)
        errors[most] = np.abs(latent_relevancy(codec, centres, phrases, canonical)[cells] - exact)
    assert errors[3200].mean() < 6e-3
    assert errors[3200].mean() < errors[200].mean() / 3  # of first order in the side of a cell


def test_by_peaks_one_gaussian_scores_no_whole():
    """Where every Gaussian has its own relevancy, that of a thing is smoothed along its surface."""
    field = named_field(codebook=False)
    field.latents[2, :PER_BLOB] = unit(np.array([0.7, 0, 0, 0.7]))
    field.latents[2, 5] = 2 * field.latents[2, 5] * (1, 0, 0, 0)
    tree = tree_of_wholes(np.repeat(np.arange(3, dtype=np.int32), PER_BLOB))
    engine = QueryEngine(Scene(blobs(), replace(field, tree=tree)), rule="peak")
    (thing,) = engine.instances(engine.run("mug", level="whole"))
    assert thing.members[:PER_BLOB].all()
    assert thing.score < engine.relevancy(engine.texts.of(["mug"])[0])[2, 5] - 0.05


def test_both_orders_agree_inside_an_object():
    scene = named_scene(codebook=False)
    scene = scene.take(np.arange(3 * PER_BLOB) // PER_BLOB != 1)  # the outer two blobs: they do not overlap
    view = ReferenceRasterizer().view(scene.gaussians, scene.cameras[1])
    engine = QueryEngine(scene, rule="peak")
    phrase = engine.texts.of(["mug"])[0]
    ours = splatted_relevancy(view, engine.relevancy(phrase)[2][:, None], 0.3)[..., 0]
    paper = decoded_relevancy(view, scene.language, 2, phrase[None], 0.3)[..., 0]
    _, alpha = view.splat(np.ones((len(scene.gaussians), 1)))
    assert not np.stack([ours, paper])[:, alpha <= 0.3].any()
    covered = alpha > 0.5
    np.testing.assert_allclose(ours[covered], paper[covered], atol=1e-3)
    column, row, score = peak_pixel(ours, 5)
    assert column < 80
    assert score > 0.9
    assert alpha[row, column] > 0.3

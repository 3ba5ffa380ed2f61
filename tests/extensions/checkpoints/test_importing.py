"""Foreign scenes with a language field, and the way back: numbers, against a tiny CLIP."""

import json
import logging
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array, unit
from langsplat_core.config import CodebookConfig, LinearConfig
from langsplat_core.errors import EncoderError, FormatError, InputError
from langsplat_core.extensions.checkpoints.convert import export_langsplat, export_occam
from langsplat_core.extensions.checkpoints.importing import import_scene, read_foreign
from langsplat_core.extensions.checkpoints.langsplat_files import write_autoencoder, write_checkpoint
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import CANONICAL_PHRASES, AutoencoderCodec, LanguageField, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.training.language.codec_fit import everyday_vocabulary
from tests.support.comparing import assert_same
from tests.support.file_samples import autoencoder, random_codec, random_field, save_model, tensor
from tests.support.processes import Captured, Write, check_full_disk, refusal, run
from tests.support.scenes import random_camera, random_gaussians
from tests.support.tiny_models import tiny_clip

pytestmark = pytest.mark.long

N, D = 60, 24
G = random_gaussians(N, sh_degree=2)
rng = np.random.default_rng(5)
FEATURES = unit(rng.normal(size=(7, D))).astype(np.float32)
CHOICE = rng.integers(0, 7, (3, N))
VECTORS = (FEATURES[CHOICE] * rng.uniform(0.1, 9, (3, N, 1))).astype(np.float32)  # of any length
VECTORS[:, ::9] = 0  # never seen
SEEN = np.ones(N, bool)
SEEN[::9] = False


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("clip")
    tiny_clip(folder)
    odds = {key: {"constant": 0, "whole": 1, "finer": 1} for key in ("thing", "part", "inside")}
    (folder / "reading.json").write_text(json.dumps({"calibration": odds}))
    return str(folder)


def occam(folder: Path, vectors: Array = VECTORS) -> list[Path]:
    return [
        save_model(folder / f"chkpnt_langfeat_{i + 1}.pth", G, tensor(vectors[i]))
        for i in range(len(vectors))
    ]


def decoded(field: LanguageField, level: int) -> Array:
    return field.codec.decode(field.latents[level])


def test_few_vectors_become_a_codebook_of_them(tmp_path, clip):
    scene, loss = import_scene(read_foreign(occam(tmp_path)), clip, ("red mug", "Red mug "))
    field = scene.language
    assert field is not None
    assert_same(scene.gaussians, G)
    assert (field.codec.kind, field.codec.size) == ("codebook", 7)
    assert field.calibration is None  # the encoder's is of drawn rooms
    np.testing.assert_array_equal(field.confidence, np.tile(SEEN.astype(np.float32), (3, 1)))
    for level in range(3):
        # codewords are float16 numbers
        np.testing.assert_allclose(decoded(field, level)[SEEN], FEATURES[CHOICE[level]][SEEN], atol=5e-4)
    encoder = load_text_encoder(clip)
    np.testing.assert_array_equal(field.canonical, encoder.encode_texts(list(CANONICAL_PHRASES)))
    assert list(field.phrasebook) == ["red mug"]
    assert (field.encoder_id, field.temperature) == (clip, encoder.temperature)
    assert loss is not None
    assert loss.error_mean < 1e-3
    save_scene(tmp_path / "a.ply", scene)
    read = load_scene(tmp_path / "a.ply").language
    assert read is not None
    np.testing.assert_array_equal(read.latents, field.latents)


def test_many_vectors_keep_the_stated_error(tmp_path, clip):
    """The error that is stated is of a few Gaussians that the codec was not fitted to; here of all."""
    n = 900
    g = random_gaussians(n)
    vectors = unit(FEATURES[rng.integers(0, 7, n)] + rng.normal(scale=0.02, size=(n, D))).astype(np.float32)
    path = save_model(tmp_path / "a_3.pth", g, tensor(vectors))
    config = CodebookConfig(max_relevancy_error=0.02)
    scene, loss = import_scene(read_foreign([path]), clip, (), config)
    assert scene.language is not None
    assert loss is not None
    assert (scene.language.confidence.sum(1) == [0, 0, n]).all()
    vocabulary = everyday_vocabulary(load_text_encoder(clip))
    got, want = (vocabulary.relevancy(v) for v in (decoded(scene.language, 2), vectors))
    assert 7 < scene.language.codec.size <= n // 4
    assert np.abs(got - want).mean() <= 1.1 * loss.error_mean  # most of these were fitted to
    assert loss.error_mean <= 1.2 * config.max_relevancy_error
    linear, _ = import_scene(read_foreign([path]), clip, (), LinearConfig(latent_dim=D))
    assert linear.language is not None
    np.testing.assert_allclose(decoded(linear.language, 2), vectors, atol=1e-5)


def langsplat(folder: Path) -> tuple[list[Path], Array, torch.nn.Module]:
    network = autoencoder(D)
    with torch.no_grad():
        latents = np.stack([network.encode(torch.from_numpy(FEATURES[CHOICE[i]])).numpy() for i in range(3)])
    latents = np.where(SEEN[:, None], latents * 0.4, 0).astype(np.float32)  # not normalised, as trained
    paths = [save_model(folder / f"a_{i + 1}" / "chkpnt30000.pth", G, tensor(latents[i])) for i in range(3)]
    torch.save(network.state_dict(), folder / "best_ckpt.pth")
    return [*paths, folder / "best_ckpt.pth"], latents, network


def test_langsplat_there_and_back(tmp_path, clip):
    scene, _ = import_scene(read_foreign(langsplat(tmp_path / "a")[0]), clip)
    written = export_langsplat(scene, tmp_path / "b", "case")
    assert [str(path.relative_to(tmp_path / "b")) for path in written] == [
        *(f"case_{level}/chkpnt30000.pth" for level in (1, 2, 3)),
        "best_ckpt.pth",
    ]
    (elements, iteration) = torch.load(written[0], weights_only=True)
    assert (len(elements), iteration) == (13, 30_000)
    shapes = [(N, 3), (N, 1, 3), (N, 8, 3), (N, 3), (N, 4), (N, 1), (N, 3)]
    assert [tuple(elements[i].shape) for i in range(1, 8)] == shapes
    network = autoencoder(D)
    network.load_state_dict(torch.load(written[3], weights_only=True))  # the names are those of its layers
    again, _ = import_scene(read_foreign(written), clip)
    first, second = scene.language, again.language
    assert first is not None
    assert second is not None
    assert_same(again.gaussians, G)
    np.testing.assert_allclose(second.latents, first.latents, atol=1e-6)
    np.testing.assert_array_equal(second.confidence, first.confidence)
    for name, array in first.codec.tensors().items():
        np.testing.assert_allclose(second.codec.tensors()[name], array, rtol=1e-6, atol=1e-7)
    with torch.no_grad():
        theirs = network.eval().encode(torch.from_numpy(FEATURES)).numpy()
    np.testing.assert_allclose(theirs, first.codec.encode(FEATURES), atol=1e-5)


def test_occam_there_and_back(tmp_path, clip):
    scene, _ = import_scene(read_foreign(occam(tmp_path)), clip)
    assert scene.language is not None
    written = export_occam(scene, tmp_path / "out")
    (elements, _) = torch.load(written[2], weights_only=True)
    assert elements[7].shape == (N, D)
    np.testing.assert_array_equal(elements[7][0].numpy(), 0)  # never seen
    again, _ = import_scene(read_foreign(written), clip)
    assert again.language is not None
    assert_same(again.gaussians, G)
    np.testing.assert_array_equal(again.language.confidence, scene.language.confidence)
    for level in range(3):
        got, want = decoded(again.language, level), decoded(scene.language, level)
        np.testing.assert_allclose(got[SEEN], want[SEEN], atol=1e-3)


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
def test_every_codec_is_written_as_vectors(tmp_path, kind):
    field = random_field(N, kind)
    export_occam(Scene(G, field), tmp_path)
    for level in range(3):
        (elements, _) = torch.load(tmp_path / f"chkpnt30000_langfeat_{level + 1}.pth", weights_only=True)
        want = np.where(field.known[level][:, None], decoded(field, level), 0)
        np.testing.assert_allclose(elements[7].numpy(), want, atol=1e-6)


@pytest.mark.parametrize("number", [6, 600])
def test_clusters_are_a_codebook(tmp_path, clip, number):
    """As many codewords as clusters with a meaning that Gaussians belong to."""
    vectors = rng.normal(size=(number, D)).astype(np.float32) * 3
    vectors[1] = 0
    index = rng.integers(0, number, N)
    index[:6] = range(6)
    index[6] = number  # of none
    np.savez(tmp_path / "cluster_lang.npz", leaf_feat=vectors, leaf_ind=index)
    path = save_model(tmp_path / "c.pth", G, tensor(np.zeros((N, 6))), tensor(np.zeros((N, 6))))
    scene, _ = import_scene(read_foreign([path, tmp_path / "cluster_lang.npz"]), clip)
    field = scene.language
    assert field is not None
    seen = (index != 1) & (index < number)
    assert field.codec.size == len(np.unique(index[seen]))
    np.testing.assert_array_equal(field.confidence, [np.zeros(N), np.zeros(N), seen])
    np.testing.assert_allclose(decoded(field, 2)[seen], unit(vectors[index[seen]]), atol=5e-4)


def test_refusals(tmp_path, clip, caplog):
    caplog.set_level(logging.ERROR)
    foreign = read_foreign(occam(tmp_path))
    with pytest.raises(InputError, match=r"_1\.pth: vectors of 24 numbers, .* demo have"):
        import_scene(foreign, "demo")
    with pytest.raises(EncoderError):
        import_scene(foreign, str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="no Gaussian has a meaning"):
        import_scene(read_foreign(occam(tmp_path / "zero", VECTORS * 0)), clip)
    spoiled = VECTORS.copy()
    spoiled[1, 4, 2] = np.inf
    with pytest.raises(FormatError, match=r"_2\.pth: features are not finite, .* of Gaussian 4"):
        import_scene(read_foreign(occam(tmp_path / "inf", spoiled)), clip)


# `langsplat convert`.


@pytest.fixture
def checkpoints(tmp_path: Path) -> list[Path]:
    """Of Occam's LGS, three levels of vectors as long as the demo encoder's."""
    g = random_gaussians(20, sh_degree=1)
    features = unit(rng.normal(size=(5, load_text_encoder("demo").dim))).astype(np.float32)
    return [
        save_model(tmp_path / f"chkpnt_langfeat_{level}.pth", g, tensor(features[rng.integers(0, 5, 20)]))
        for level in (1, 2, 3)
    ]


@pytest.mark.long
def test_checkpoints_become_a_scene_and_back(tmp_path, checkpoints, capsys):
    read = ("--encoder", "demo", "--phrases", "apple", "red mug")
    assert run("convert", *checkpoints, tmp_path / "a.ply", *read) == 0
    printed = capsys.readouterr().out
    assert "Occam's LGS: levels (by the names of files and folders): subpart from" in printed
    assert "codec codebook of 5, encoder demo" in printed
    assert "relevancy error of the codec: mean 0.000" in printed
    scene = load_scene(tmp_path / "a.ply")
    assert scene.language is not None
    assert set(scene.language.phrasebook) == {"apple", "red mug"}
    assert (scene.language.confidence == 1).all()
    assert run("convert", tmp_path / "a.ply", tmp_path / "out", "--to", "occam") == 0
    assert len(list((tmp_path / "out").glob("chkpnt30000_langfeat_[123].pth"))) == 3
    words = ("convert", tmp_path / "a.ply", tmp_path / "out", "--to", "langsplat")
    assert "--to occam" in refusal(capsys, *words)


def test_a_checkpoint_of_gaussians_is_converted(tmp_path, capsys):
    g = random_gaussians(20, sh_degree=3)
    path = save_model(tmp_path / "chkpnt30000.pth", g)
    assert run("convert", path, tmp_path / "a.spz") == 0
    assert "20 Gaussians, without a language field" in capsys.readouterr().out
    assert np.abs(load_scene(tmp_path / "a.spz").gaussians.means - g.means).max() < 1e-3
    words = ("convert", tmp_path / "a.spz", tmp_path / "out", "--to", "langsplat")
    assert "has no language field" in refusal(capsys, *words)


def test_a_scene_of_an_autoencoder_becomes_langsplats(tmp_path):
    scene = Scene(random_gaussians(30, sh_degree=1), random_field(30), (random_camera(),))
    save_scene(tmp_path / "case.ply", scene)
    assert run("convert", tmp_path / "case.ply", tmp_path / "out", "--to", "langsplat") == 0
    made = sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.pth"))
    assert made == ["best_ckpt.pth", *(f"case_{level}/chkpnt30000.pth" for level in (1, 2, 3))]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{0}", "{1}", "out.ply"], "of which levels|latents of LangSplat's autoencoder"),
        (["{0}", "out.ply", "--rematch", "x.safetensors"], "--rematch is for one scene"),
        (["{0}", "{1}", "--levels", "whole"], "scenes are written as"),
        (["missing.pth", "out.ply"], "no such file"),
        (["{0}", "out.ply", "--levels", "whole", "--encoder", "/nowhere"], "autoencoder"),
    ],
)
def test_unusable_checkpoints_are_refused(tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    g = random_gaussians(20)
    paths = [save_model(tmp_path / f"{name}.pth", g, tensor(np.ones((20, 3), np.float32))) for name in "ab"]
    assert re.search(message, refusal(capsys, "convert", *(word.format(*paths) for word in words)))


# A full disk: one line, and what was there stays.


def checkpoint(count: int) -> Write:
    gaussians = random_gaussians(count, 1, sh_degree=1)
    return lambda folder: write_checkpoint(folder / "c.pth", gaussians, np.ones((count, 3), np.float32))


def best_checkpoint(folder: Path) -> object:
    codec = random_codec("autoencoder")
    assert isinstance(codec, AutoencoderCodec)
    return write_autoencoder(folder / "a.pth", codec.encoder, codec.decoder)


WRITERS: dict[str, Write] = {
    "checkpoint": checkpoint(40),
    "autoencoder": best_checkpoint,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line(name: str, tmp_path: Path, capsys: Captured) -> None:
    check_full_disk(WRITERS[name], tmp_path, capsys, b"what was there before")

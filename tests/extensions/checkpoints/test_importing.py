"""Files of other methods: what is found in them, which belong together, what is refused."""

import json
import logging
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array, unit
from langsplat_core.config import CodecConfig
from langsplat_core.errors import STRICTNESS, EncoderError, FormatError, InputError
from langsplat_core.extensions.checkpoints.importing import IMPORTER, ForeignScene, import_scene, read_foreign
from langsplat_core.extensions.checkpoints.langsplat_files import export_langsplat
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import ImportRequest, load_scene, save_scene
from langsplat_core.progress import silent
from langsplat_core.scene import CANONICAL_PHRASES, Gaussians, LanguageField, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.training.language.codec_fit import everyday_vocabulary
from tests.support.file_samples import assert_same, autoencoder, geometry, save_model, tensor, training_state
from tests.support.processes import refusal, run
from tests.support.scenes import random_gaussians
from tests.support.tiny_models import tiny_clip

N, D = 20, 24
G = random_gaussians(N, sh_degree=3)
rng = np.random.default_rng(3)
VECTORS = rng.normal(size=(3, N, D)).astype(np.float32)
LATENTS = unit(rng.normal(size=(3, N, 3))).astype(np.float32)
ALL = np.arange(N)


def assert_rows(scene: ForeignScene, level: int, want: Array, atol: float = 0.0) -> None:
    """The vectors of all Gaussians at a level are these."""
    found = scene.rows(level, np.arange(len(scene.scene.gaussians)))
    np.testing.assert_allclose(found, want, rtol=0, atol=atol)


def langsplat(folder: Path, levels: tuple[int, ...] = (1, 2, 3), g: Gaussians = G) -> list[Path]:
    return [
        save_model(folder / f"teatime_{level}" / "chkpnt30000.pth", g, tensor(LATENTS[level - 1]))
        for level in levels
    ]


def best_ckpt(folder: Path, **widths: tuple[int, ...]) -> Path:
    torch.save(autoencoder(D, **widths).state_dict(), folder / "best_ckpt.pth")
    return folder / "best_ckpt.pth"


def test_plain_gaussians(tmp_path):
    got = read_foreign([save_model(tmp_path / "chkpnt30000.pth", G)])
    assert_same(got.scene.gaussians, G)
    assert got.levels == {}
    assert got.dim == 0


def test_langsplat_and_its_autoencoder(tmp_path):
    paths = [best_ckpt(tmp_path), *reversed(langsplat(tmp_path))]  # in any order
    got = read_foreign(paths)
    assert got.method == "LangSplat"
    assert_same(got.scene.gaussians, G)
    for level in range(3):
        assert_rows(got, level, LATENTS[level])
    assert "by the names of files and folders" in got.notes[0]


@pytest.mark.parametrize(
    "widths",
    [
        {},
        {"encoder": (40, 8), "decoder": (30, 50)},
        {"encoder": (8,), "decoder": ()},
        {"encoder": (64, 32, 1), "decoder": (7,)},
    ],
)
def test_the_autoencoder_is_the_networks(tmp_path, widths):
    network = autoencoder(D, **widths)
    torch.save(network.state_dict(), tmp_path / "best_ckpt.pth")
    d = network.encoder[-1].out_features
    latents = unit(rng.normal(size=(N, d))).astype(np.float32)
    save_model(tmp_path / "a_1" / "c.pth", G, tensor(latents))
    codec = read_foreign([tmp_path / "a_1" / "c.pth", tmp_path / "best_ckpt.pth"]).codec
    with torch.no_grad():
        decoded = network.decode(torch.from_numpy(latents)).numpy()
        encoded = network.encode(torch.from_numpy(VECTORS[0])).numpy()
    np.testing.assert_allclose(codec.decode(latents), decoded, atol=1e-5)
    np.testing.assert_allclose(codec.encode(VECTORS[0]), encoded, atol=1e-5)


def test_levels_may_be_missing_and_are_told_apart(tmp_path):
    ae = best_ckpt(tmp_path)
    got = read_foreign([*langsplat(tmp_path, (3, 1)), ae])
    assert_rows(got, 0, LATENTS[0])
    assert_rows(got, 2, LATENTS[2])
    assert [*got.levels] == [0, 2]
    assert "without features: part" in got.notes
    nameless = [save_model(tmp_path / f"{name}.pth", G, tensor(LATENTS[i])) for i, name in enumerate("xyz")]
    assert "by their order" in read_foreign([*nameless, ae]).notes[0]
    assert "one alone is taken for the whole" in read_foreign([nameless[0], ae]).notes[0]
    with pytest.raises(InputError, match="of which levels"):
        read_foreign([*nameless[:2], ae])
    asked = read_foreign([*nameless[:2], ae], ["whole", "subpart"])
    assert_rows(asked, 2, LATENTS[0])
    assert_rows(asked, 0, LATENTS[1])
    for levels in (["whole"], ["part", "part"]):
        with pytest.raises(InputError, match="name a level for each"):
            read_foreign([*nameless[:2], ae], levels)


def mixture(logits: Array, codebooks: Array, topk: int) -> Array:
    """By torch, the way it is defined: softmax, the largest, their sum made 1."""
    out = torch.zeros(len(logits), codebooks.shape[2])
    for layer, words in enumerate(torch.from_numpy(codebooks)):
        k = len(words)
        soft = torch.from_numpy(logits[:, layer * k : (layer + 1) * k]).softmax(1)
        kept, index = soft.topk(topk, 1)
        kept = kept / (kept.sum(1, keepdim=True) + 1e-10)
        out += torch.zeros_like(soft).scatter_(1, index, kept) @ words
    return out.numpy()


def test_langsplat_v2(tmp_path):
    logits = rng.normal(size=(N, 64)).astype(np.float32) * 3
    logits[5] = 0  # never trained
    codebooks = rng.normal(size=(1, 64, D)).astype(np.float32)
    path = save_model(tmp_path / "teatime_0_2" / "chkpnt10000.pth", G, tensor(logits), tensor(codebooks))
    got = read_foreign([path])
    assert (got.method, got.dim) == ("LangSplatV2", D)
    want = mixture(logits, codebooks, 4)
    want[5] = 0
    assert_rows(got, 1, want, 1e-5)
    assert [*got.levels] == [1]


def occam(
    folder: Path, kept: tuple[Array, ...] = (ALL,) * 3, g: Gaussians = G, vectors: Array = VECTORS
) -> list[Path]:
    return [
        save_model(folder / f"chkpnt30000_langfeat_{level + 1}.pth", g.take(k), tensor(vectors[level][k]))
        for level, k in enumerate(kept)
    ]


LACKING = (ALL[2:], np.r_[0:7, 9:19], ALL[1:15][::-1])


@pytest.mark.parametrize(("kept", "with_all"), [((ALL,) * 3, False), (LACKING, False), (LACKING, True)])
def test_occam_where_levels_may_lack_different_gaussians(tmp_path, kept, with_all):
    paths = occam(tmp_path, kept)
    if with_all:
        paths.append(save_model(tmp_path / "chkpnt30000.pth", G))
    got = read_foreign(paths)
    assert got.method == "Occam's LGS"
    means = got.scene.gaussians.means
    assert len(means) == N  # every Gaussian is in one of the three
    order = np.array([np.flatnonzero((G.means == mean).all(1))[0] for mean in means])
    assert_same(got.scene.gaussians, G.take(order))
    for level in range(3):
        assert_rows(got, level, np.where(np.isin(order, kept[level])[:, None], VECTORS[level][order], 0))
    assert any("lack some Gaussians" in note for note in got.notes) == (kept is LACKING)


def test_gaussians_at_one_place_are_kept_apart(tmp_path):
    g = replace(G, means=np.repeat(G.means[:5], 4, axis=0))
    path = save_model(tmp_path / "a_langfeat_1.pth", g, tensor(VECTORS[0]))
    less = save_model(tmp_path / "a_langfeat_2.pth", g.take(ALL[:15]), tensor(VECTORS[1][:15]))
    got = read_foreign([path, less])
    assert len(got.scene.gaussians) == N
    assert_rows(got, 1, np.concatenate([VECTORS[1][:15], np.zeros((5, D))]))


def leaves(path: Path, index: Array, count: int = 6) -> Array:
    vectors = VECTORS[0][:count]
    occurrences = np.array([3, 1, 0, 9, 9, 9][:count])
    np.savez(path, leaf_feat=vectors, leaf_score=np.ones(count), occu_count=occurrences, leaf_ind=index)
    return np.where(occurrences[:, None] > 0, vectors, 0)


@pytest.mark.parametrize("as_ply", [False, True])
def test_open_gaussian(tmp_path, as_ply):
    index = rng.integers(0, 6, N)
    index[:2] = 6, -1  # of no cluster
    vectors = leaves(tmp_path / "cluster_lang.npz", index)
    names = ("ins_feat_r", "ins_feat_g", "ins_feat_b", "ins_feat_r2", "ins_feat_g2", "ins_feat_b2")
    instance = rng.normal(size=(N, 6)).astype(np.float32)
    if as_ply:
        path = tmp_path / "point_cloud.ply"
        write_ply(path, Scene(G, extras=dict(zip(names, instance.T, strict=True))))
    else:
        path = save_model(tmp_path / "chkpnt90000.pth", G, tensor(instance), tensor(instance))
        refused([path], r"cluster_lang\.npz, too")
    both = [path, tmp_path / "cluster_lang.npz"]
    got = read_foreign(both)
    assert got.method == "OpenGaussian"
    leaves(both[1], index.clip(0).astype(np.uint8))  # which cannot say -1
    assert_rows(read_foreign(both), 2, np.append(vectors, np.zeros((1, D)), axis=0)[index.clip(0)])
    assert_rows(got, 2, np.where(((index >= 0) & (index < 6))[:, None], vectors[index.clip(0, 5)], 0))
    assert [*got.levels] == [2]
    leaves(tmp_path / "cluster_lang.npz", index[1:])
    refused(both, "clusters of 19 Gaussians")
    leaves(tmp_path / "cluster_lang.npz", index + 100)
    refused(both, "names none of the 6 clusters")


def test_feature_3dgs(tmp_path):
    ply = tmp_path / "a.ply"
    extras = {f"semantic_{i}": VECTORS[0][:, i] for i in reversed(range(D))} | {"kept": VECTORS[0][:, 0]}
    write_ply(ply, Scene(G, extras=extras))
    got = read_foreign([ply])
    assert_rows(got, 2, VECTORS[0])
    assert list(got.scene.extras) == ["kept"]
    for shape in ((N, 1, D), (N, D, 1), (N, D)):
        path = save_model(tmp_path / "c.pth", G, behind=(tensor(VECTORS[0].reshape(shape)),))
        got = read_foreign([path])
        assert got.method == "Feature-3DGS"
        assert_rows(got, 2, VECTORS[0])
    torch.save({"conv.weight": torch.zeros(D, 8, 1, 1), "conv.bias": torch.zeros(D)}, tmp_path / "dec.pth")
    refused([path, tmp_path / "dec.pth"], "decodes pictures, not Gaussians")
    write_ply(ply, Scene(G, extras={"semantic_0": VECTORS[0][:, 0], "semantic_2": VECTORS[0][:, 0]}))
    refused([ply], "without gaps")


def test_archives_with_deflated_members_are_refused(tmp_path):
    path, packed = save_model(tmp_path / "a.pth", G), tmp_path / "b.pth"
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in whole.namelist():
            archive.writestr(name, whole.read(name))
    refused([packed], r"^\S*b\.pth: its archive is compressed")


FAR = replace(G, means=G.means + np.float32(2**20))
PASSED_OVER: dict[str, Callable[[Path], list[Path]]] = {
    "an array of NumPy": lambda path: [save_model(path / "a.pth", G, VECTORS[0])],
    "a lower active degree": lambda path: [saved(path / "a.pth", (1, *geometry(G)[1:], *training_state(G)))],
    "vectors twice": lambda path: [save_model(path / "a.pth", G, behind=(tensor(VECTORS[0]),) * 2)],
    "other entries": lambda path: [
        saved(path / "best_ckpt.pth", autoencoder(D).state_dict() | {"epoch": 3}),
        *langsplat(path),
    ],
    "other arrays": lambda path: [
        save_model(path / "a.pth", G),
        saved(path / "c.npz", {"leaf_feat": VECTORS[0], "leaf_ind": ALL, "more": ALL}),
    ],
    "other clusters": lambda path: [
        save_model(path / "a.pth", G),
        saved(path / "c.npz", {"leaf_feat": VECTORS[0][:9], "leaf_ind": ALL}),
    ],
    "a level that is a guess": lambda path: [best_ckpt(path), save_model(path / "a", G, tensor(LATENTS[0]))],
}


def saved(path: Path, content: Any) -> Path:
    if path.suffix == ".npz":
        np.savez(path, **content)
    else:
        torch.save(content, path)
    return path


@pytest.mark.parametrize("case", PASSED_OVER)
def test_checkpoints_say_what_is_skipped(tmp_path, case, caplog, monkeypatch):
    paths = PASSED_OVER[case](tmp_path)
    read_foreign(paths)
    assert len(caplog.messages) == 1
    monkeypatch.setattr(STRICTNESS, "on", True)
    refused(paths, "--strict")


def test_a_ply_far_from_zero_keeps_its_origin(tmp_path):
    write_ply(tmp_path / "a.ply", Scene(FAR, metres_per_unit=2.0))
    scene = read_foreign([tmp_path / "a.ply"]).scene
    assert scene.origin.any()
    assert scene.metres_per_unit == 2
    assert_same(scene.world_gaussians(), FAR)


def test_half_precision_and_older_files(tmp_path):
    """bfloat16 has no NumPy type; files before torch 1.6 are no archives."""
    for kind in (torch.bfloat16, torch.float16):
        want = torch.from_numpy(VECTORS[0]).to(kind)
        path = save_model(tmp_path / "c.pth", G, want)
        assert_rows(read_foreign([path]), 2, want.float().numpy())
    content = ((*geometry(G), tensor(VECTORS[0]), *training_state(G)), 7)
    torch.save(content, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    assert_rows(read_foreign([tmp_path / "old.pth"]), 2, VECTORS[0])


def test_cameras_of_the_models_folder(tmp_path):
    entry = {"id": 0, "img_name": "a", "width": 40, "height": 30, "position": [0, 0, -3]}
    entry |= {"rotation": np.eye(3).tolist(), "fx": 30, "fy": 30}
    path = save_model(tmp_path / "chkpnt30000.pth", G)
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    assert [camera.width for camera in read_foreign([path]).scene.cameras] == [40]


# Files of other methods that are refused: one line each, which names the file.


def read_whole(paths: list[Path]) -> None:
    scene = read_foreign(paths)
    for level in scene.levels:
        scene.rows(level, ALL)


def refused(paths: list[Path], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_whole(paths)
    assert any(str(caught.value).startswith(str(path)) for path in paths)


@pytest.mark.parametrize(("index", "message"), [(5, "element 5: rotations"), (7, r"features \(21, 24\) for")])
def test_elements_of_another_length_are_refused(tmp_path, index, message):
    elements = [*geometry(G), tensor(VECTORS[0]), *training_state(G)]
    elements[index] = torch.zeros(N + 1, elements[index].shape[1])
    torch.save((tuple(elements), 1), tmp_path / "c.pth")
    refused([tmp_path / "c.pth"], message)


def test_damaged_autoencoders_are_refused(tmp_path):
    good, checkpoint = autoencoder(D).state_dict(), langsplat(tmp_path, (1,))[0]
    missing = {name: value for name, value in good.items() if name != "encoder.3.bias"}
    infinite = good | {"decoder.4.bias": good["decoder.4.bias"] * torch.nan}
    for state in (missing, infinite, {"layer.weight": torch.zeros(3, 3)}):
        torch.save(state, tmp_path / "ae.pth")
        refused([tmp_path / "ae.pth", checkpoint], "autoencoder('s| of) ")


def test_files_that_do_not_go_together(tmp_path):
    ae, levels = best_ckpt(tmp_path), langsplat(tmp_path)
    refused(levels, "3 numbers per Gaussian, latents of LangSplat's autoencoder; name its best_ckpt.pth")
    refused([ae], "belongs to checkpoints with features")
    plain = save_model(tmp_path / "plain.pth", G)
    refused([ae, plain], "belongs to checkpoints with features")
    refused([plain, plain], "two scenes without features")
    refused([ae, ae, *levels], "two autoencoders")
    moved = langsplat(tmp_path / "other", (2,), random_gaussians(N, seed=1, sh_degree=3))
    refused([levels[0], *moved, ae], "its 20 Gaussians are not the 20 of the other files")
    fewer = save_model(tmp_path / "f_2.pth", G.take(ALL[1:]), tensor(LATENTS[1][1:]))
    refused([levels[0], fewer, ae], "its 19 Gaussians are not the 20")
    stranger = random_gaussians(N, 1, 3)
    stranger.means[0] = G.means[0]  # one in common is chance
    apart = save_model(tmp_path / "f_3.pth", stranger, tensor(VECTORS[1]))
    whole = save_model(tmp_path / "g_1.pth", G, tensor(VECTORS[0]))
    refused([whole, apart], "1 of 20 Gaussians are at positions of the other files'")
    refused([whole, levels[1], ae], "give the files of one method")
    refused([*levels, levels[0], ae], "a fourth checkpoint")
    d4 = save_model(tmp_path / "d4.pth", G, tensor(VECTORS[0][:, :4]))
    refused([d4, ae], "4 numbers per Gaussian, but .* makes 3")


# What becomes of them: scenes with a language field, and the way back, against a tiny CLIP.

COUNT = 60
GAUSSIANS = random_gaussians(COUNT, sh_degree=2)
FEATURES = unit(rng.normal(size=(7, D))).astype(np.float32)
CHOICE = rng.integers(0, 7, (3, COUNT))
LEVELS = (FEATURES[CHOICE] * rng.uniform(0.1, 9, (3, COUNT, 1))).astype(np.float32)  # of any length
LEVELS[:, ::9] = 0  # never seen
SEEN = np.ones(COUNT, bool)
SEEN[::9] = False


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("clip")
    tiny_clip(folder)
    odds = {key: {"constant": 0, "whole": 1, "finer": 1} for key in ("thing", "part", "inside")}
    (folder / "reading.json").write_text(json.dumps({"calibration": odds}))
    return str(folder)


def occam_levels(folder: Path, vectors: Array = LEVELS) -> list[Path]:
    return occam(folder, (np.arange(COUNT),) * 3, GAUSSIANS, vectors)


def decoded(field: LanguageField, level: int) -> Array:
    return field.codec.decode(field.latents[level])


@pytest.mark.long
def test_few_vectors_become_a_codebook_of_them(tmp_path, clip):
    scene, loss = import_scene(read_foreign(occam_levels(tmp_path)), clip, ("red mug", "Red mug "))
    field = scene.language
    assert_same(scene.gaussians, GAUSSIANS)
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
    assert loss.error_mean < 1e-3
    save_scene(tmp_path / "a.ply", scene)
    read = load_scene(tmp_path / "a.ply").language
    np.testing.assert_array_equal(read.latents, field.latents)


@pytest.mark.long
def test_many_vectors_keep_the_stated_error(tmp_path, clip):
    """The error that is stated is of a few Gaussians that the codec was not fitted to; here of all."""
    n = 900
    g = random_gaussians(n)
    vectors = unit(FEATURES[rng.integers(0, 7, n)] + rng.normal(scale=0.02, size=(n, D))).astype(np.float32)
    path = save_model(tmp_path / "a_3.pth", g, tensor(vectors))
    config = CodecConfig(max_relevancy_error=0.02)
    scene, loss = import_scene(read_foreign([path]), clip, (), config)
    assert (scene.language.confidence.sum(1) == [0, 0, n]).all()
    vocabulary = everyday_vocabulary(load_text_encoder(clip))
    got, want = (vocabulary.relevancy(v) for v in (decoded(scene.language, 2), vectors))
    assert 7 < scene.language.codec.size <= n // 4
    assert np.abs(got - want).mean() <= 1.1 * loss.error_mean  # most of these were fitted to
    assert loss.error_mean <= 1.2 * config.max_relevancy_error
    linear, _ = import_scene(read_foreign([path]), clip, (), CodecConfig("linear", latent_dim=D))
    np.testing.assert_allclose(decoded(linear.language, 2), vectors, atol=1e-5)


def langsplat_levels(folder: Path) -> tuple[list[Path], Array, torch.nn.Module]:
    network = autoencoder(D)
    with torch.no_grad():
        latents = np.stack([network.encode(torch.from_numpy(FEATURES[CHOICE[i]])).numpy() for i in range(3)])
    latents = np.where(SEEN[:, None], latents * 0.4, 0).astype(np.float32)  # not normalised, as trained
    paths = [save_model(folder / f"a_{i + 1}" / "c.pth", GAUSSIANS, tensor(latents[i])) for i in range(3)]
    torch.save(network.state_dict(), folder / "best_ckpt.pth")
    return [*paths, folder / "best_ckpt.pth"], latents, network


@pytest.mark.long
def test_langsplat_there_and_back(tmp_path, clip):
    trained, request = langsplat_levels(tmp_path / "a")[0], ImportRequest((), clip, (), (), CodecConfig())
    scene, lines = IMPORTER.read(replace(request, paths=tuple(trained)), silent)
    assert "brought to length 1" in lines[-1]
    written = [Path(name) for name in export_langsplat(replace(scene, path=Path("case.ply")), tmp_path / "b")]
    assert [str(path.relative_to(tmp_path / "b")) for path in written] == [
        *(f"case_{level}/chkpnt30000.pth" for level in (1, 2, 3)),
        "best_ckpt.pth",
    ]
    (elements, iteration) = torch.load(written[0], weights_only=True)
    assert (len(elements), iteration) == (13, 30_000)
    shapes = [(COUNT, 3), (COUNT, 1, 3), (COUNT, 8, 3), (COUNT, 3), (COUNT, 4), (COUNT, 1), (COUNT, 3)]
    assert [tuple(elements[i].shape) for i in range(1, 8)] == shapes
    network = autoencoder(D)
    network.load_state_dict(torch.load(written[3], weights_only=True))  # the names are those of its layers
    again, lines = IMPORTER.read(replace(request, paths=tuple(written)), silent)
    assert "length 1" not in lines[-1]
    first, second = scene.language, again.language
    assert_same(again.gaussians, GAUSSIANS)
    np.testing.assert_allclose(second.latents, first.latents, atol=1e-6)
    np.testing.assert_array_equal(second.confidence, first.confidence)
    for name, array in first.codec.tensors().items():
        np.testing.assert_allclose(second.codec.tensors()[name], array, rtol=1e-6, atol=1e-7)
    with torch.no_grad():
        theirs = network.eval().encode(torch.from_numpy(FEATURES)).numpy()
    np.testing.assert_allclose(theirs, first.codec.encode(FEATURES), atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("number", [6, 600])
def test_clusters_are_a_codebook(tmp_path, clip, number):
    """As many codewords as clusters with a meaning that Gaussians belong to."""
    vectors = rng.normal(size=(number, D)).astype(np.float32) * 3
    vectors[1] = 0
    index = rng.integers(0, number, COUNT)
    index[:6] = range(6)
    index[6] = number  # of none
    np.savez(tmp_path / "cluster_lang.npz", leaf_feat=vectors, leaf_ind=index)
    zeros = tensor(np.zeros((COUNT, 6)))
    path = save_model(tmp_path / "c.pth", GAUSSIANS, zeros, zeros)
    scene, _ = import_scene(read_foreign([path, tmp_path / "cluster_lang.npz"]), clip)
    field = scene.language
    seen = (index != 1) & (index < number)
    assert field.codec.size == len(np.unique(index[seen]))
    np.testing.assert_array_equal(field.confidence, [np.zeros(COUNT), np.zeros(COUNT), seen])
    np.testing.assert_allclose(decoded(field, 2)[seen], unit(vectors[index[seen]]), atol=5e-4)


@pytest.mark.long
def test_refusals(tmp_path, clip, caplog):
    caplog.set_level(logging.ERROR)
    foreign = read_foreign(occam_levels(tmp_path))
    with pytest.raises(InputError, match=r"_1\.pth: vectors of 24 numbers, .* demo have"):
        import_scene(foreign, "demo")
    with pytest.raises(EncoderError):
        import_scene(foreign, str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="no Gaussian has a meaning"):
        import_scene(read_foreign(occam_levels(tmp_path / "zero", LEVELS * 0)), clip)
    spoiled = LEVELS.copy()
    spoiled[1, 4, 2] = np.inf
    with pytest.raises(FormatError, match=r"_2\.pth: features are not finite, .* of Gaussian 4"):
        import_scene(read_foreign(occam_levels(tmp_path / "inf", spoiled)), clip)


# `langsplat convert`.


@pytest.fixture
def checkpoints(tmp_path: Path) -> list[Path]:
    """Of Occam's LGS, three levels of vectors as long as the demo encoder's."""
    features = unit(rng.normal(size=(5, load_text_encoder("demo").dim))).astype(np.float32)
    return occam(tmp_path, vectors=features[rng.integers(0, 5, (3, N))])


@pytest.mark.long
def test_checkpoints_become_a_scene(tmp_path, checkpoints, capsys):
    read = ("--encoder", "demo", "--phrases", "apple", "red mug")
    assert run("convert", *checkpoints, tmp_path / "a.ply", *read) == 0
    printed = capsys.readouterr().out
    assert "Occam's LGS: levels (by the names of files and folders): subpart from" in printed
    assert "codec codebook of 5, encoder demo" in printed
    assert "relevancy error of the codec: mean 0.000" in printed
    scene = load_scene(tmp_path / "a.ply")
    assert set(scene.language.phrasebook) == {"apple", "red mug"}
    assert (scene.language.confidence == 1).all()
    for options, told in (("--to langsplat", "--codec.kind autoencoder"), ("--encoder demo", "it has none")):
        assert told in refusal(capsys, "convert", tmp_path / "a.ply", tmp_path / "b.ply", *options.split())

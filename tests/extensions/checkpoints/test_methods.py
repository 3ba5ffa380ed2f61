"""Files of other methods: what is found in them, which belong together, and what is refused."""

import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.importing import ForeignScene, read_foreign
from langsplat_core.io.ply import write_ply
from langsplat_core.scene import Gaussians, Scene
from tests.support.comparing import assert_same
from tests.support.file_samples import autoencoder, geometry, save_model, tensor, training_state
from tests.support.scenes import random_gaussians

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
    assert got.levels == (None, None, None)
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
    assert codec is not None
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
    assert got.levels[1] is None
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
    assert got.levels[0] is got.levels[2] is None


def occam(folder: Path, kept: tuple[Array, ...]) -> list[Path]:
    return [
        save_model(folder / f"chkpnt30000_langfeat_{level + 1}.pth", G.take(k), tensor(VECTORS[level][k]))
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
        refused([path], r"cluster_lang\.npz, name it too")
    both = [path, tmp_path / "cluster_lang.npz"]
    got = read_foreign(both)
    assert got.method == "OpenGaussian"
    assert_rows(got, 2, np.where(((index >= 0) & (index < 6))[:, None], vectors[index.clip(0, 5)], 0))
    assert got.levels[:2] == (None, None)
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


class Harmful:
    """Would run a command when unpickled."""

    def __reduce__(self):
        return (os.system, ("exit 1",))


def read_whole(paths: list[Path]) -> None:
    scene = read_foreign(paths)
    for level in range(3):
        if scene.levels[level] is not None:
            scene.rows(level, ALL)


def refused(paths: list[Path], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_whole(paths)
    assert "\n" not in str(caught.value)
    assert any(str(caught.value).startswith(str(path)) for path in paths)


def test_classes_are_not_unpickled(tmp_path):
    path = save_model(tmp_path / "c.pth", G, behind=(Harmful(),))
    refused([path], r"needs '(posix|nt).system'; only tensors")
    path.write_bytes(pickle.dumps(Harmful()))
    refused([path], r"needs 'posix.system'|not a whole file")


def wrong(index: int, value: object) -> tuple[object, ...]:
    elements = [*geometry(G), tensor(VECTORS[0]), *training_state(G)]
    elements[index] = value
    return tuple(elements)


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (1, torch.zeros(N, 2), "element 1: positions"),
        (1, None, "element 1 holds no positions"),
        (3, torch.zeros(N, 7, 3), "7 SH coefficients"),
        (4, torch.zeros(N, 2), "element 4: log scales"),
        (5, torch.zeros(N + 1, 4), "element 5: rotations"),
        (6, torch.zeros(N, 1, dtype=torch.int64), "element 6 holds no opacities"),
        (7, torch.zeros(N + 1, D), r"features \(21, 24\) for 20 Gaussians"),
        (7, torch.zeros(N, D, dtype=torch.int32), "features of the type int32"),
        (7, torch.zeros(1).expand(10**9, 24), "more numbers than the file has"),
        (7, torch.zeros(N, D, dtype=torch.complex64), "needs 'torch.ComplexFloatStorage'"),
        (7, torch.full((N, D), torch.nan), "features are not finite, or huge, as those of Gaussian 0"),
        (7, torch.full((N, D), 3e38), "features are not finite, or huge, as those of Gaussian 0"),
    ],
)
def test_wrong_elements(tmp_path, index, value, message):
    torch.save((wrong(index, value), 1), tmp_path / "c.pth")
    refused([tmp_path / "c.pth"], message)


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
    apart = save_model(tmp_path / "f_3.pth", random_gaussians(N, 1, 3), tensor(VECTORS[1]))
    whole = save_model(tmp_path / "g_1.pth", G, tensor(VECTORS[0]))
    refused([whole, apart], "0 of 20 Gaussians are at positions of the other files'")
    refused([whole, levels[1], ae], "give the files of one method")
    refused([*levels, levels[0], ae], "a fourth checkpoint")
    d4 = save_model(tmp_path / "d4.pth", G, tensor(VECTORS[0][:, :4]))
    refused([d4, ae], "4 numbers per Gaussian, but .* makes 3")


def test_damaged_autoencoders(tmp_path):
    good, checkpoint = autoencoder(D).state_dict(), langsplat(tmp_path, (1,))[0]
    missing = {name: value for name, value in good.items() if name != "encoder.3.bias"}
    infinite = good | {"decoder.4.bias": good["decoder.4.bias"] * torch.nan}
    short = good | {"decoder.0.weight": torch.zeros(16, 4)}
    for state, message in (
        (missing, "not an autoencoder of LangSplat's kind"),
        (short, "not an autoencoder of LangSplat's kind"),
        (infinite, "weights are not finite"),
        ({"layer.weight": torch.zeros(3, 3)}, "not a checkpoint or autoencoder of a known method"),
    ):
        torch.save(state, tmp_path / "ae.pth")
        refused([tmp_path / "ae.pth", checkpoint], message)


def test_files_of_no_method_are_refused(tmp_path):
    path, checkpoint = tmp_path / "x", save_model(tmp_path / "c.pth", G, tensor(VECTORS[0]))
    for content in (b"something else", b""):
        path.write_bytes(content)
        refused([path, checkpoint], "neither a PLY nor a file of torch")
    np.savez(tmp_path / "x.npz", a=np.zeros((3, 4)))
    refused([tmp_path / "x.npz", checkpoint], r"holds arrays \(3, 4\)")

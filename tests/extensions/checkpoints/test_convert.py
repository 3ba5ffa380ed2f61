"""`langsplat convert` from and to checkpoints of other methods."""

import re
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.store import FeatureStore, ImageFeatures
from tests.support.commands import refusal, run
from tests.support.file_samples import random_field, save_model, tensor
from tests.support.scenes import random_camera, random_gaussians


@pytest.fixture
def checkpoints(tmp_path: Path) -> list[Path]:
    """Of Occam's LGS, three levels of vectors as long as the demo encoder's."""
    g, rng = random_gaussians(20, sh_degree=1), np.random.default_rng(0)
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


def test_features_are_converted_both_ways(tmp_path):
    labels = np.arange(12, dtype=np.int32).reshape(3, 2, 2)
    store = FeatureStore(tmp_path / "features")
    store.save("a.jpg", ImageFeatures(labels, np.eye(12, 20, dtype=np.float32)))
    assert run("convert", tmp_path / "features", tmp_path / "language_features", "--to", "features") == 0
    assert run("convert", tmp_path / "language_features", tmp_path / "back", "--to", "features") == 0
    np.testing.assert_array_equal(FeatureStore(tmp_path / "back").load("a").labels, labels)
    for sources in ([tmp_path / "nothing"], [tmp_path / "features", tmp_path / "language_features"]):
        assert run("convert", *sources, tmp_path / "back", "--to", "features") == 2


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

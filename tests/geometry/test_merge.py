"""Two scenes as one, and `langsplat mesh`, `register` and `merge` on files."""

import json
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import INRIA
from langsplat_core.errors import InputError
from langsplat_core.geometry.merge import merge
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import NO_NODE, Scene, TaughtWord
from langsplat_core.scene.transform import moving, transform_scene
from langsplat_core.scene.tree import tree_of_wholes
from tests.support.commands import refusal, run
from tests.support.fakes import FakeEncoder, blob_scene
from tests.support.file_samples import random_field
from tests.support.scenes import box_room, random_camera, random_gaussians

N = 40


def scene(seed: int, name: str, degree: int = 1) -> Scene:
    field = random_field(N, "codebook", phrases=(f"red {name}",), seed=seed)
    vector = np.eye(1, field.codec.vector_dim, dtype=np.float32)
    field = replace(
        field,
        tree=tree_of_wholes(np.arange(N) // 9),
        taught=(TaughtWord(name, 2, vector, np.zeros(1, np.float32)),),
    )
    cameras = tuple(random_camera(seed + k) for k in range(2))
    return Scene(random_gaussians(N, seed, sh_degree=degree), field, cameras)


def test_what_both_have_is_there():
    a, b = scene(0, "mug"), scene(5, "vase", degree=3)
    both = merge(a, b)
    assert len(both.gaussians) == 2 * N
    assert len(both.cameras) == 4
    assert [word.name for word in both.language.taught] == ["mug", "vase"]
    assert list(both.language.phrasebook) == ["red vase", "red mug"]
    tree, count = both.language.tree, a.language.tree.count
    np.testing.assert_array_equal(tree.leaves[:N], a.language.tree.leaves)
    theirs = b.language.tree.leaves
    np.testing.assert_array_equal(tree.leaves[N:], np.where(theirs == NO_NODE, NO_NODE, theirs + count))
    for level in range(3):
        for one, rows in ((a, slice(0, N)), (b, slice(N, None))):
            vectors = both.language.codec.decode(both.language.latents[level, rows])
            expected = one.language.codec.decode(one.language.latents[level])
            np.testing.assert_allclose(vectors, expected, atol=1e-6)


def test_an_image_of_both_is_of_both_sets_of_gaussians():
    """Harmonics of a lower degree are filled up by zeros."""
    a, b = scene(0, "mug", degree=0), scene(5, "vase", degree=3)
    both, camera = merge(a, b).gaussians, random_camera(1)
    view = ReferenceRasterizer().view(both, camera, INRIA)
    image, _ = view.splat(colours(both.sh, both.means, camera.position))
    apart = np.concatenate([colours(g.sh, g.means, camera.position) for g in (a.gaussians, b.gaussians)])
    np.testing.assert_allclose(image, view.splat(apart)[0], atol=1e-6)


def test_a_scene_without_a_field_gets_no_meaning():
    named, plain = blob_scene(), replace(blob_scene(field=False), cameras=())
    plain = transform_scene(plain, moving(np.array([30.0, 0, 0])))
    both = merge(named, plain)
    found = QueryEngine(both, lambda _: FakeEncoder()).run("mug")
    assert found.members.any()
    assert not found.members[len(named.gaussians) :].any()
    assert merge(plain, plain).language is None


def test_what_cannot_be_one_is_refused():
    a, b = scene(0, "mug"), scene(5, "vase")
    with pytest.raises(InputError, match="two text encoders"):
        merge(a, replace(b, language=replace(b.language, encoder_id="another")))
    with pytest.raises(InputError, match="antialiasing"):
        merge(a, replace(b, antialiased=True))


def test_nothing_and_something_are_something():
    a, none = scene(0, "mug"), Scene(random_gaussians(0))
    assert len(merge(a, none).gaussians) == N
    assert len(merge(none, a).gaussians) == N


# On files.


def test_scenes_are_laid_onto_each_other_and_merged(tmp_path, capsys):
    pytest.importorskip("open3d")
    room = box_room(3)
    turn = moving(np.array([0.7, -0.4, 0.2]))
    save_scene(tmp_path / "a.ply", room)
    save_scene(tmp_path / "b.ply", transform_scene(room, turn))
    assert run("register", tmp_path / "b.ply", tmp_path / "a.ply", "--out", tmp_path / "to.json") == 0
    found = np.array(json.loads((tmp_path / "to.json").read_text())["matrix"])
    np.testing.assert_allclose(found @ turn.matrix, np.eye(4), atol=0.02)
    told = ("--transform", tmp_path / "to.json")
    assert run("merge", tmp_path / "a.ply", tmp_path / "b.ply", "--out", tmp_path / "both.ply", *told) == 0
    assert "as told" in capsys.readouterr().out
    both, count = load_scene(tmp_path / "both.ply"), len(room.gaussians)
    off = np.linalg.norm(both.gaussians.means[count:] - both.gaussians.means[:count], axis=1)
    assert off.max() < 0.03
    assert len(both.cameras) == 2 * len(room.cameras)


def test_a_mesh_of_a_room_is_written(tmp_path, capsys):
    pytest.importorskip("open3d")
    save_scene(tmp_path / "a.ply", box_room(1))
    assert run("mesh", tmp_path / "a.ply", tmp_path / "mesh.ply") == 0
    assert "triangles" in capsys.readouterr().out
    assert (tmp_path / "mesh.ply").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("mesh a.ply m.stl", ".ply or .obj or .glb"),
        ("mesh a.ply a.ply", "would replace the original"),
        ("mesh a.ply m.ply --resolution 1e-9", "finer than the images"),
        ("mesh a.ply m.ply --phrase mug", "no language field"),
        ("merge a.ply b.ply --out m.ply --transform none.json", "none.json: no such file"),
        ("merge a.ply b.ply --out m.ply --transform bad.json", "bad.json: 'matrix'"),
        ("merge a.ply b.ply --out a.ply", "would replace the original"),
        ("merge a.ply b.ply --out m.ply --as-is --transform bad.json", "give one of them"),
        ("register a.ply none.ply", "none.ply"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, words, message):
    pytest.importorskip("open3d")
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        save_scene(tmp_path / f"{name}.ply", replace(box_room(1), path=None))
    (tmp_path / "bad.json").write_text('{"matrix": [[1, 2], [3, 4]]}')
    before = sorted(path.name for path in tmp_path.iterdir())
    assert message in refusal(capsys, *words.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == before

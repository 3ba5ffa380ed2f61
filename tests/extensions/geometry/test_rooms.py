"""Planes of a room, two captures laid onto each other, two scenes as one; `mesh`, `register` and `merge`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from langsplat_core.arrays import Array, unit
from langsplat_core.config import INRIA
from langsplat_core.errors import InputError
from langsplat_core.extensions.geometry.planes import FEWEST, find_room, sample_surface
from langsplat_core.extensions.geometry.registration import agreement, merge, quarter_turns, register
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import NO_NODE, Scene, TaughtWord
from langsplat_core.scene.language import tree_of_wholes
from langsplat_core.scene.transform import IDENTITY, Similarity, moving, transform_scene
from tests.support.fakes import FakeEncoder, blob_scene
from tests.support.file_samples import random_field
from tests.support.processes import refusal, run
from tests.support.scenes import FLOOR, WALL, box_room, random_camera, random_gaussians

pytest.importorskip("open3d")


def similarity(turn: tuple[float, float, float], step: tuple[float, float, float], scale=1.0) -> Similarity:
    return Similarity(Rotation.from_rotvec(turn).as_matrix(), np.array(step), scale)


def degrees_apart(one: Array, other: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("there", [IDENTITY, similarity((0.2, -0.1, 0.7), (3.0, -1.0, 5.0), 2.0)])
def test_floor_and_up_are_found(seed, there):
    room = find_room(transform_scene(box_room(seed), there))
    up = there.rotation[:, 2]
    assert degrees_apart(room.up, up) < 2
    assert room.floor is not None
    ground = there.scale * FLOOR + there.translation @ up
    assert room.ground == pytest.approx(ground, abs=0.03 * there.scale * WALL)


def test_scene_without_floor_takes_the_up_of_its_cameras():
    scene = box_room()
    ball = unit(np.random.default_rng(0).normal(size=(len(scene.gaussians), 3)))
    floating = replace(scene, gaussians=replace(scene.gaussians, means=ball))
    room = find_room(floating)
    assert room.floor is None
    np.testing.assert_allclose(room.up, floating.up())
    assert -1.1 < room.ground < -0.7


def test_points_lie_as_densely_everywhere():
    scene = box_room()
    points, normals = sample_surface(scene.gaussians, 20_000)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    on_floor = np.abs(points[:, 2] - FLOOR) < 0.02
    quarter = on_floor & (points[:, 0] > 0) & (points[:, 1] > 0)
    assert quarter.sum() / on_floor.sum() == pytest.approx(0.25, abs=0.05)
    assert np.abs(normals[on_floor & (np.abs(points[:, :2]).max(1) < 1.2), 2]).mean() > 0.9


def test_a_scene_without_a_surface_is_refused():
    few = Scene(random_gaussians(FEWEST - 1))
    for find in (lambda: find_room(few), lambda: register(few, box_room())):
        with pytest.raises(InputError, match="have no surface"):
            find()


@pytest.mark.parametrize(("scale", "scaled"), [(1.0, False), (3.0, True)])
def test_a_capture_is_laid_onto_another(scale, scaled):
    there = similarity((0.4, -0.3, 1.2), (2.0, 1.0, -3.0), scale)
    fixed = box_room(2)
    found = register(transform_scene(fixed, there), fixed, scaled)
    assert found.trusted
    assert found.agreement > 0.9
    assert np.linalg.norm(found.transform @ there.matrix - np.eye(4)) < 0.03
    assert found.scale == pytest.approx(1 / scale, rel=0.01)


def test_quarter_turns_are_rotations_about_the_middle():
    scene = box_room()
    centre, up = scene.bounds()[0], scene.up()
    turns = quarter_turns(scene)
    for quarter, turn in enumerate(turns):
        np.testing.assert_allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(turn[:3, :3] @ centre + turn[:3, 3], centre, atol=1e-12)
        np.testing.assert_allclose(turn[:3, :3] @ up, up, atol=1e-12)
        np.testing.assert_allclose(np.linalg.matrix_power(turns[1], quarter), turn, atol=1e-12)
    assert np.trace(turns[1][:3, :3]) == pytest.approx(1)


def test_metres_decide_the_scale():
    there = similarity((0, 0, 0.5), (0.0, 1.0, 0.0), 3.0)
    fixed = replace(box_room(2), metres_per_unit=1.0)
    found = register(transform_scene(fixed, there), fixed)  # of 1 / 3 metres per unit
    assert found.scale == pytest.approx(1 / 3)
    assert np.linalg.norm(found.transform @ there.matrix - np.eye(4)) < 0.03


def test_agreement_tells_a_place_from_another():
    there = similarity((0.4, -0.3, 1.2), (2.0, 1.0, -3.0), 2.0)
    fixed = box_room(3)
    elsewhere, back = transform_scene(fixed, there), there.inverse()
    assert agreement(elsewhere, fixed, back.matrix) > 0.95
    assert agreement(elsewhere, fixed, similarity((0, 0, 0.3), (0.6, 0, 0.4)).then(back).matrix) < 0.7
    assert agreement(elsewhere, fixed, np.eye(4)) < 0.7


# Two scenes as one.

N = 40


def scene(seed: int, name: str, degree: int = 1) -> Scene:
    field = random_field(N, "codebook", phrases=(f"red {name}",), seed=seed)
    taught = TaughtWord(name, 2, np.eye(1, field.codec.vector_dim, dtype=np.float32), np.zeros(1, np.float32))
    field = replace(field, tree=tree_of_wholes(np.arange(N) // 9), taught=(taught,))
    cameras = random_camera(seed), random_camera(seed + 1)
    return Scene(random_gaussians(N, seed, sh_degree=degree), field, cameras)


def test_merge_keeps_what_both_scenes_have():
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


def test_merge_refuses_scenes_of_two_encoders():
    a, b = scene(0, "mug"), scene(5, "vase")
    with pytest.raises(InputError, match="two text encoders"):
        merge(a, replace(b, language=replace(b.language, encoder_id="another")))
    with pytest.raises(InputError, match="antialiasing"):
        merge(a, replace(b, antialiased=True))
    nothing = Scene(random_gaussians(0))
    assert len(merge(a, nothing).gaussians) == len(merge(nothing, a).gaussians) == N


# On files.


def test_scenes_are_laid_onto_each_other_and_merged(tmp_path, capsys):
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
    save_scene(tmp_path / "a.ply", box_room(1))
    assert run("mesh", tmp_path / "a.ply", tmp_path / "mesh.ply") == 0
    assert "triangles" in capsys.readouterr().out
    assert (tmp_path / "mesh.ply").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("mesh a.ply m.stl", ".ply or .glb"),
        ("mesh a.ply a.ply", "would replace the original"),
        ("mesh a.ply m.ply --resolution 1e-9", "finer than the images"),
        ("mesh a.ply m.ply --phrase mug", "no language field"),
        ("merge a.ply b.ply --out m.ply --transform none.json", "none.json: no such file"),
        ("merge a.ply b.ply --out m.ply --transform bad.json", "bad.json: no transform"),
        ("merge a.ply b.ply --out a.ply", "would replace the original"),
        ("merge a.ply b.ply --out m.ply --as-is --transform bad.json", "give one of them"),
        ("register a.ply none.ply", "none.ply"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        save_scene(tmp_path / f"{name}.ply", replace(box_room(1), path=None))
    (tmp_path / "bad.json").write_text('{"matrix": [[1, 2], [3, 4]]}')
    before = sorted(path.name for path in tmp_path.iterdir())
    assert message in refusal(capsys, *words.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == before

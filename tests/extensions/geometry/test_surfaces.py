"""Meshes of rooms whose surfaces are known; two captures laid onto each other, two scenes as one."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from langsplat_core.arrays import Array, unit
from langsplat_core.config import INRIA
from langsplat_core.errors import InputError
from langsplat_core.extensions.geometry.mesh import Mesh, close_holes, fuse, surface_depth
from langsplat_core.extensions.geometry.planes import FEWEST, find_room
from langsplat_core.extensions.geometry.registration import agreement, merge, quarter_turns, register
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import NO_NODE, Gaussians, Scene, TaughtWord, look_at
from langsplat_core.scene.language import tree_of_wholes
from langsplat_core.scene.transform import (
    AXES,
    IDENTITY,
    Similarity,
    moving,
    rotation_quaternion,
    transform_scene,
    turning,
)
from tests.support.fakes import FakeEncoder, blob_scene
from tests.support.file_samples import random_field
from tests.support.processes import refusal, run
from tests.support.scenes import FLOOR, WALL, box_room, random_camera, random_gaussians

pytest.importorskip("open3d")


def ball(radius: float = 1.0, count: int = 3000) -> Scene:
    """Flat opaque Gaussians on a sphere around the origin, without cameras."""
    index = np.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    quats = [rotation_quaternion(turning(AXES["z"], normal).rotation) for normal in normals]
    log_scales = np.tile(np.log(radius * np.array([0.04, 0.04, 0.0004])), (count, 1))
    sh = np.tile([1.0, -1.0, 0.0], (count, 1, 1))
    return Scene(Gaussians(radius * normals, log_scales, np.array(quats), np.full(count, 5.0), sh))


def test_depth_is_that_of_the_planes_where_gaussians_are_flat():
    scene = box_room()
    camera = scene.cameras[0]
    view = CpuRasterizer().view(scene.gaussians, camera)
    depth = surface_depth(scene.gaussians, camera, view.median_rows())
    rows, columns = np.nonzero(depth)
    pixels = np.stack([columns, rows], 1) + 0.5
    world = np.stack([camera.unproject(*seen) for seen in zip(pixels, depth[rows, columns], strict=True)])
    on_wall = np.abs(np.abs(world[:, :2]).max(1) - WALL) < 0.1
    off = np.abs(np.abs(world[on_wall, :2]).max(1) - WALL)
    centres = np.abs(depth - view.median_depth())[rows, columns][on_wall]
    assert on_wall.sum() > 1000
    assert np.quantile(off, 0.9) < 0.002  # a Gaussian's own thickness is 3 mm
    assert np.quantile(centres, 0.9) > 0.02  # of which the depth of its centre knows nothing


@pytest.mark.parametrize("seed", range(3))
def test_depth_is_where_a_gaussian_is_densest_along_the_ray(seed):
    gaussians, camera = random_gaussians(40, seed), random_camera(seed, distance=3.0)
    rows = CpuRasterizer().view(gaussians, camera).median_rows()
    depth = surface_depth(gaussians, camera, rows)
    assert (depth[rows < 0] == 0).all()
    assert (rows >= 0).sum() > 20
    for y, x in np.argwhere(rows >= 0)[::17]:
        mean, quat, scales = (
            np.asarray(values[rows[y, x]], np.float64)
            for values in (gaussians.means, gaussians.quats_wxyz, np.exp(gaussians.log_scales))
        )
        axes = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
        reach = 3 * np.sqrt(np.square(camera.rotation[2] @ axes * scales).sum())
        middle = camera.rotation[2] @ mean + camera.world_to_camera[2, 3]
        tried = np.linspace(middle - reach, middle + reach, 4001)
        points = np.stack([camera.unproject((x + 0.5, y + 0.5), z) for z in tried])
        exponents = np.square((points - mean) @ axes / scales).sum(1)
        assert depth[y, x] == pytest.approx(max(tried[exponents.argmin()], 0), abs=reach / 500)


def test_degenerate_gaussians_have_a_finite_depth():
    scene = box_room()
    camera = scene.cameras[0]
    for log_scales in (-np.inf, 40.0):
        gaussians = replace(scene.gaussians, log_scales=np.full_like(scene.gaussians.log_scales, log_scales))
        rows = np.arange(camera.width * camera.height).reshape(camera.height, camera.width)
        depth = surface_depth(gaussians, camera, rows % len(gaussians))
        assert np.isfinite(depth).all()
        assert (depth >= 0).all()


def test_the_surface_of_a_room_is_found():
    """Photographed with pixels of a centimetre; what stands on the table is left out by height."""
    room = box_room(1)
    mesh, side = fuse(room, cameras=tuple(camera.resized(384, 288) for camera in room.cameras))
    heights, across = mesh.vertices[:, 2], np.abs(mesh.vertices[:, :2]).max(1)
    shell = (heights < -0.1) & (across > 1.85)
    assert shell.sum() > 1000
    off = np.minimum(np.abs(heights - FLOOR), np.abs(across - WALL))  # from the nearest of floor and walls
    assert np.median(off[shell]) < 0.005 < side
    assert mesh.holes() > 0  # no ceiling
    assert mesh.colour.min() >= 0
    assert mesh.colour.std() > 0.05


def test_a_ball_is_closed_and_coloured_without_cameras():
    mesh, side = fuse(ball(2.0))
    assert np.median(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 2)) < 0.01
    outside = np.cross(
        *(mesh.vertices[mesh.triangles[:, k]] - mesh.vertices[mesh.triangles[:, 0]] for k in (1, 2))
    )
    assert ((outside * mesh.vertices[mesh.triangles[:, 0]]).sum(1) > 0).mean() > 0.98
    np.testing.assert_allclose(np.median(mesh.colour, axis=0), 0.5 + 0.2821 * np.array([1, -1, 0]), atol=0.02)
    half = mesh.triangles[mesh.vertices[mesh.triangles].mean(1)[:, 2] > -1.0]
    used, triangles = np.unique(half, return_inverse=True)
    opened = Mesh(mesh.vertices[used], triangles.reshape(-1, 3), mesh.colour[used])
    assert opened.holes() >= 1
    closed, made = close_holes(opened, side)
    assert closed.holes() == 0
    assert 0.1 < made / closed.areas().sum() < 0.6
    _, nothing = close_holes(mesh, side)
    assert nothing < 0.02 * mesh.areas().sum()


def test_nothing_to_see_is_refused():
    away = look_at(np.array([0, 0, 3.0]), np.array([0, 0, 9.0]), np.array([0, 1.0, 0]), (20, 20))
    for message, scene, options in (
        ("see no surface", ball(), {"cameras": (away,)}),
        ("finer than the images", ball(), {"resolution": 1e-6}),
        ("too few views", ball(), {"views": 1000}),
        ("see no surface", Scene(random_gaussians(0)), {}),
    ):
        with pytest.raises(InputError, match=message):
            fuse(scene, **options)


# Planes of a room, and two captures laid onto each other.


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
        ("mesh a.ply a.ply", "would replace the original"),
        ("mesh a.ply m.ply --phrase mug", "no language field"),
        ("merge a.ply b.ply --out m.ply --transform none.json", "none.json: no such file"),
        ("merge a.ply b.ply --out m.ply --transform bad.json", "bad.json: no transform"),
        ("merge a.ply b.ply --out m.ply --transform huge.json", "huge.json: no transform"),
        ("merge a.ply b.ply --out m.ply --as-is --transform bad.json", "give one of them"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        save_scene(tmp_path / f"{name}.ply", replace(box_room(1), path=None))
    (tmp_path / "bad.json").write_text('{"matrix": [[1, 2], [3, 4]]}')
    (tmp_path / "huge.json").write_text(f'{{"matrix": [[1{400 * "0"}]]}}')
    before = sorted(path.name for path in tmp_path.iterdir())
    assert message in refusal(capsys, *words.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == before

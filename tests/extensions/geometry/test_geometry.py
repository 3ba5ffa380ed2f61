"""Meshes of rooms whose surfaces are known; captures laid onto each other; maps, and poses before things."""

import json
import os
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import open3d
import pytest
from PIL import Image
from plyfile import PlyData
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from langsplat_core.arrays import Array, quaternions, rotation_matrices, unit
from langsplat_core.cli.app import parse
from langsplat_core.errors import BackendError, FormatError, InputError
from langsplat_core.extensions.geometry.commands import read_transform
from langsplat_core.extensions.geometry.mesh import (
    Mesh,
    close_holes,
    fuse,
    surface_depth,
    watertight,
    write_mesh,
)
from langsplat_core.extensions.geometry.occupancy import (
    FloorMap,
    Occupancy,
    Room,
    collider,
    find_goal,
    find_occupancy,
    find_room,
    floor_map,
    map_axes,
    reachable,
    trace,
)
from langsplat_core.extensions.geometry.registration import FEWEST, agreement, merge, once, register
from langsplat_core.io import apart
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import NO_NODE, NO_ORIGIN, Gaussians, Scene, look_at
from langsplat_core.scene.transform import (
    AXES,
    IDENTITY,
    Similarity,
    moving,
    place_scene,
    scaling,
    transform_scene,
    turning,
)
from tests.support.fakes import PER_BLOB, FakeEncoder, blob_scene, named_scene
from tests.support.file_kinds import FileKind, drawable_share, few_and_many, in_json, taught_word
from tests.support.file_samples import glb_column, parts, random_field
from tests.support.processes import refusal, run
from tests.support.scenes import (
    DEMO,
    FLOOR,
    WALL,
    box_room,
    random_camera,
    random_gaussians,
    ring,
    tree_of_wholes,
)

pytest.importorskip("open3d")


@cache
def ball(radius: float = 1.0, count: int = 3000) -> Scene:
    """Flat opaque Gaussians on a sphere around the origin, without cameras."""
    index = np.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    quats = [quaternions(turning(AXES["z"], normal).rotation) for normal in normals]
    log_scales = np.tile(np.log(radius * np.array([0.04, 0.04, 0.0004])), (count, 1))
    sh = np.tile([1.0, -1.0, 0.0], (count, 1, 1))
    return Scene(Gaussians(radius * normals, log_scales, np.array(quats), np.full(count, 5.0), sh))


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


def assert_watertight(points: Array, triangles: Array) -> None:
    """Ask Open3D, once vertices in one place are joined, as other programs do where they read a file."""
    kinds = open3d.utility.Vector3dVector(points.astype(np.float32)), open3d.utility.Vector3iVector(triangles)
    mesh = open3d.geometry.TriangleMesh(*kinds)
    mesh.remove_duplicated_vertices()
    assert mesh.is_edge_manifold(allow_boundary_edges=False)
    assert mesh.is_orientable()
    for spoilt in (mesh.remove_degenerate_triangles, mesh.remove_duplicated_triangles):
        assert len(spoilt().triangles) == len(triangles)
    sides = (points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))
    assert (np.linalg.norm(np.cross(*sides), axis=1) > 0).all()


def test_a_ball_is_closed_and_coloured_without_cameras(monkeypatch, capfd):
    mesh, side = fuse(ball(2.0), resolution=0.05)
    assert np.median(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 2)) < 0.01
    corners = mesh.vertices[mesh.triangles]
    outside = np.cross(*(corners[:, k] - corners[:, 0] for k in (1, 2)))
    assert ((outside * corners[:, 0]).sum(1) > 0).mean() > 0.98
    np.testing.assert_allclose(np.median(mesh.colour, axis=0), 0.5 + 0.2821 * np.array([1, -1, 0]), atol=0.02)
    half = mesh.triangles[mesh.vertices[mesh.triangles].mean(1)[:, 2] > -1.0]
    used, triangles = np.unique(half, return_inverse=True)
    opened = Mesh(mesh.vertices[used], triangles.reshape(-1, 3), mesh.colour[used])
    assert opened.holes() >= 1
    with_reverse = np.concatenate([opened.triangles, opened.triangles[:9, ::-1]])
    assert_watertight(*watertight(opened.vertices, with_reverse, 1e-5))
    poisson = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson

    def noisy(*given: Any, **options: Any) -> Any:
        os.write(2, b"[WARNING] Extract bad average roots: 3")
        return poisson(*given, **options)

    speaking = SimpleNamespace(create_from_point_cloud_poisson=noisy)
    monkeypatch.setattr(open3d.geometry, "TriangleMesh", speaking)
    closed, made = close_holes(opened, side)
    assert capfd.readouterr() == ("", "")
    monkeypatch.undo()
    assert_watertight(closed.vertices, closed.triangles)
    assert closed.hollows() == 0
    assert replace(closed, triangles=closed.triangles[:, ::-1]).hollows() == 1
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


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("there", [IDENTITY, similarity((0.2, -0.1, 0.7), (3.0, -1.0, 5.0), 2.0)])
def test_floor_and_up_are_found(seed, there):
    room = find_room(transform_scene(box_room(seed), there))
    up = there.rotation[:, 2]
    assert np.degrees(np.arccos(np.clip(room.up @ up, -1, 1))) < 2
    assert room.has_floor
    ground = there.scale * FLOOR + there.translation @ up
    assert room.ground == pytest.approx(ground, abs=0.03 * there.scale * WALL)


def test_scene_without_floor_takes_the_up_of_its_cameras():
    scene = box_room()
    ball = unit(np.random.default_rng(0).normal(size=(len(scene.gaussians), 3)))
    floating = replace(scene, gaussians=replace(scene.gaussians, means=ball))
    room = find_room(floating)
    assert not room.has_floor
    np.testing.assert_allclose(room.up, floating.up())
    assert -1.1 < room.ground < -0.7


def test_a_scene_without_a_surface_is_refused():
    few = Scene(random_gaussians(FEWEST - 1))
    for find in (lambda: find_room(few), lambda: register(few, box_room())):
        with pytest.raises(InputError, match="have no surface"):
            find()


@pytest.mark.parametrize("unit", [1.0, 1e-4])
@pytest.mark.parametrize(("scale", "scaled", "metres"), [(1, False, None), (3, True, None), (3, False, 1.0)])
def test_a_capture_is_laid_onto_another(scale, scaled, metres, unit):
    """Of the same scale, of a scale that is looked for, and of one that metres decide."""
    there = similarity((0.4, -0.3, 1.2), (2.0 * unit, unit, -3.0 * unit), scale)
    fixed = transform_scene(replace(box_room(2), metres_per_unit=metres), scaling(unit))
    found = register(transform_scene(fixed, there), fixed, scaled)
    assert found.trusted
    assert found.agreement > 0.9
    off = (found.transform.matrix @ there.matrix - np.eye(4)) / [1, 1, 1, unit]
    assert np.linalg.norm(off) < 0.03
    assert found.transform.scale == pytest.approx(1 / scale, rel=0.01)


def test_agreement_tells_a_place_from_another():
    there = similarity((0.4, -0.3, 1.2), (2.0, 1.0, -3.0), 2.0)
    fixed = box_room(3)
    elsewhere, back = transform_scene(fixed, there), there.inverse()
    assert agreement(elsewhere, fixed, back) > 0.95
    assert agreement(elsewhere, fixed, similarity((0, 0, 0.3), (0.6, 0, 0.4)).then(back)) < 0.7
    assert agreement(elsewhere, fixed, IDENTITY) < 0.7


# Two scenes as one.

N = 40


def scene(seed: int, name: str, degree: int = 1) -> Scene:
    field = random_field(N, "codebook", phrases=(f"red {name}",), seed=seed)
    taught = (taught_word(name, field.codec.vector_dim),)
    field = replace(field, tree=tree_of_wholes(np.arange(N) // 9), taught=taught)
    cameras = random_camera(seed), random_camera(seed + 1)
    return Scene(random_gaussians(N, seed, sh_degree=degree), field, cameras)


def test_merge_keeps_what_both_scenes_have():
    a, b = scene(0, "mug"), scene(5, "vase", degree=3)
    both = merge(a, b)
    assert len(both.gaussians) == 2 * N
    filled = np.pad(a.gaussians.sh, ((0, 0), (0, 12), (0, 0)))  # harmonics of a lower degree are zero beyond
    np.testing.assert_array_equal(both.gaussians.sh, np.concatenate([filled, b.gaussians.sh]))
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


def test_a_scene_without_a_field_gets_no_meaning():
    named, plain = blob_scene(), replace(blob_scene(field=False), cameras=())
    plain = transform_scene(plain, moving(np.array([30.0, 0, 0])))
    found = QueryEngine(merge(named, plain), lambda _: FakeEncoder()).run("mug")
    assert found.members.any()
    assert not found.members[len(named.gaussians) :].any()
    assert merge(plain, plain).language is None


def test_merge_keeps_what_both_scenes_show_once(tmp_path, capsys):
    """The second's mug, seen more often, and book lie on the first's; its plant lies elsewhere."""
    made, tree = named_scene(), tree_of_wholes(np.arange(3 * PER_BLOB) // PER_BLOB)
    first = replace(made, language=replace(made.language, tree=tree))
    means, votes = made.gaussians.means.copy(), tree.votes + np.array([[2], [0], [0]], np.uint16)
    means[2 * PER_BLOB :] += (0, 0, 2)
    made.gaussians.means[0] = np.nan  # which lies on nothing
    language = replace(made.language, tree=replace(tree, votes=votes))
    second = replace(made, gaussians=replace(made.gaussians, means=means), language=language)
    second = second.take(np.arange(0, 3 * PER_BLOB, 2))
    save_scene(tmp_path / "a.ply", first)
    save_scene(tmp_path / "b.ply", second)
    words = "merge", tmp_path / "a.ply", tmp_path / "b.ply", "--as-is", "--out", tmp_path / "both.ply"
    for options, number in ((["--keep-both"], 2), ([], 1)):
        assert run(*words, *options) == 0
        assert ("2 things that both show are kept once" in capsys.readouterr().out) == (number == 1)
        engine = QueryEngine(load_scene(tmp_path / "both.ply"), lambda _: FakeEncoder())
        for word, count in (("mug", number), ("book", number), ("plant", 2)):
            assert len(engine.instances(engine.run(word))) == count
    sizes = np.bincount(engine.scene.language.tree.at(2), minlength=6).tolist()
    # the first's mug is part of the second's where it has what that has not
    assert sizes == [1, PER_BLOB, PER_BLOB, PER_BLOB, 0, PER_BLOB / 2]
    assert once(merge(first, Scene(random_gaussians(0))), first)[1] == 0


def test_merge_says_what_only_one_scene_has(caplog):
    a = replace(scene(0, "mug"), metres_per_unit=0.001)
    fields = ({"language": field} for field in (None, replace(a.language, tree=None), a.language))
    for change in ({"extras": {"age": np.zeros(N)}}, {"metres_per_unit": 1.0}, *fields):
        merge(a, replace(a, **change))
    told = "left out: age", "units of 0.001 and 1 m count", "only one of the scenes has", "tree of instances"
    assert [word in said for word, said in zip(told, caplog.messages, strict=True)] == [True] * 4


def test_merge_refuses_scenes_of_two_encoders_or_far_apart():
    a, b = scene(0, "mug"), scene(5, "vase")
    far = np.full(3, 5e8)
    other = {"language": replace(b.language, encoder_id="another"), "antialiased": True, "origin": far}
    for told, name in zip(("two text encoders", "antialiasing", "units apart"), other, strict=True):
        with pytest.raises(InputError, match=told):
            merge(a, replace(b, **{name: other[name]}))
    nothing = Scene(random_gaussians(0))
    assert len(merge(a, nothing).gaussians) == len(merge(nothing, a).gaussians) == N


# On files.


def transform_files(_):
    turned = similarity((0.3, 1, 0), (1, 2, 3), 0.5)
    return [json.dumps({"matrix": to.matrix.tolist(), "scale": 1.0}).encode() for to in (IDENTITY, turned)]


def laid_over(path):
    moved = place_scene(Scene(random_gaussians(20)), read_transform(path), NO_ORIGIN)
    return drawable_share(moved.gaussians)


KINDS = {"transform": FileKind("to.json", transform_files, laid_over, in_json)}
test_a_few_mutants_are_read_or_refused, test_many_mutants_are_read_or_refused = few_and_many(KINDS)


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (500_123.25, 5_412_345.5, 0.0)], ids=["near", "UTM"])
def test_scenes_are_laid_onto_each_other_and_merged(tmp_path, at):
    room = place_scene(box_room(3), moving(np.array(at)))
    turn = moving(np.array([0.7, -0.4, 0.2]))
    save_scene(tmp_path / "a.ply", room)
    save_scene(tmp_path / "b.ply", place_scene(room, turn))
    assert run("register", tmp_path / "b.ply", tmp_path / "a.ply", "--out", tmp_path / "to.json") == 0
    found = np.array(json.loads((tmp_path / "to.json").read_text())["matrix"])
    corners = at + np.eye(3)
    got = turn.points(corners) @ found[:3, :3].T + found[:3, 3]
    np.testing.assert_allclose(got, corners, rtol=0, atol=0.02)
    told = ("--transform", tmp_path / "to.json")
    assert run("merge", tmp_path / "a.ply", tmp_path / "b.ply", "--out", tmp_path / "both.ply", *told) == 0
    both, count = load_scene(tmp_path / "both.ply"), len(room.gaussians)
    off = np.linalg.norm(both.gaussians.means[count:] - both.gaussians.means[:count], axis=1)
    assert off.max() < 0.03
    assert len(both.cameras) == 2 * len(room.cameras)


def test_a_mesh_of_a_room_is_written(tmp_path):
    save_scene(tmp_path / "a.ply", box_room(1))
    assert run("mesh", tmp_path / "a.ply", tmp_path / "mesh.ply") == 0
    assert (tmp_path / "mesh.ply").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("mesh a.ply a.ply", "would replace the original"),
        ("mesh a.ply m.ply --phrase mug", "no language field"),
        ("map a.ply m", "nobody said how long a unit"),
        ("merge a.ply b.ply --out m.ply --transform bad.json", "bad.json: no transform"),
        ("merge a.ply b.ply --out m.ply --as-is --transform bad.json", "give one of them"),
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


# Maps.


COARSE = "--resolution", 0.1, "--step", 0.15
ROOM = Room(np.array([0.0, 0.0, 1.0]), FLOOR, has_floor=True)


def reference_trace(eye: Array, ends: Array, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """The voxels that many small steps along each ray meet."""
    hits, passes = (np.zeros(shape, np.uint16) for _ in range(2))
    for end in ends:
        last = np.floor(end).astype(int)
        steps = eye + np.linspace(0, 1, 20_001)[:, None] * (end - eye)
        met = {tuple(cell) for cell in np.floor(steps).astype(int)} - {tuple(last)}
        for cell in met:
            if all(0 <= c < n for c, n in zip(cell, shape, strict=True)):
                passes[cell] += 1
        if ((last >= 0) & (last < shape)).all():
            hits[tuple(last)] += 1
    return hits, passes


@pytest.mark.parametrize("eye", [(3.3, 4.2, 5.1), (-4.6, 2.2, 3.7)], ids=["inside", "outside"])
def test_rays_pass_the_voxels_that_small_steps_pass(eye):
    ends, shape = np.random.default_rng(1).uniform(-1, 9, (40, 3)), (8, 8, 8)
    hits, passes = (np.zeros(shape, np.uint16) for _ in range(2))
    trace(np.array(eye), ends, hits, passes)
    want_hits, want_passes = reference_trace(np.array(eye), ends, shape)
    np.testing.assert_array_equal(hits, want_hits)
    # A step may miss a corner that the ray cuts.
    assert (passes >= want_passes).all()
    assert (passes - want_passes).sum() <= 0.01 * want_passes.sum()


def test_rays_along_an_axis_and_of_no_length_end():
    hits, passes = (np.zeros((4, 4, 4), np.uint16) for _ in range(2))
    start = np.full(3, 0.5)
    trace(start, np.array([[3.5, 0.5, 0.5], start]), hits, passes)
    assert passes[:, 0, 0].tolist() == [1, 1, 1, 0]
    assert hits[3, 0, 0] == hits[0, 0, 0] == 1
    full = np.full((4, 4, 4), np.iinfo(np.uint16).max, np.uint16)
    trace(start, np.array([[3.5, 0.5, 0.5]]), full.copy(), full)
    assert full[0, 0, 0] == np.iinfo(np.uint16).max


def test_axes_of_a_map_are_metres_with_the_ground_at_nought():
    up = np.array([0.6, 0.0, 0.8])
    matrix = map_axes(Room(up, 2.0, True), 3.0).matrix
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, 9 * np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(27)
    np.testing.assert_allclose(matrix[:3, :3] @ (2.0 * up) + matrix[:3, 3], [0, 0, 0], atol=1e-12)
    tilt = np.array([0.001, 0.0, 1.0])
    far = map_axes(Room(tilt / np.linalg.norm(tilt), 0.0, True), 3.0, np.array([5e5, 5e6, 300.0]))
    np.testing.assert_allclose(far.translation[:2], [1.5e6, 1.5e7])  # where it is on a map of the world
    sideways = map_axes(Room(np.array([1.0, 0, 0]), 0.0, True), 1.0)
    assert np.isfinite(sideways.matrix).all()


def test_a_room_is_free_within_its_walls():
    occupancy = find_occupancy(box_room(), map_axes(ROOM, 1.0), 0.1)
    plan = floor_map(occupancy, 0.15, 0.5)
    centres = plan.centres(np.argwhere(plan.free))
    assert np.abs(centres).max() < WALL + 0.1
    assert len(centres) * 0.01 > 0.4 * (2 * WALL) ** 2  # the cameras do not see all of it
    standing = plan.centres(np.argwhere(plan.occupied))
    at_wall = np.abs(np.abs(standing).max(1) - WALL) < 0.35  # seen at a flat angle
    block = (np.abs(standing[:, 0] - 1.5) < 0.4) & (np.abs(standing[:, 1]) < 1.5)
    assert (at_wall | block).mean() > 0.5
    assert at_wall.sum() > 20
    assert block.sum() > 10
    with pytest.raises(InputError, match="finer --resolution"):
        floor_map(occupancy, 0.6, 0.5)
    for scene, side, message in (
        (replace(box_room(), cameras=()), 0.1, "no cameras"),
        (box_room(), 0.001, "coarser --resolution"),
    ):
        with pytest.raises(InputError, match=message):
            find_occupancy(scene, map_axes(ROOM, 1.0), side)


def plan_of(rows: list[str]) -> FloorMap:
    """A map of cells of a metre: "." free, "#" occupied, "?" unknown; the first row has the largest y."""
    grid = np.array([list(row) for row in rows[::-1]]).T
    return FloorMap(np.zeros(2), 1.0, grid == "#", grid == ".")


PLAN = ["#######", "#..#..#", "#..#..#", "#..#.##", "#.....#", "#######"]


def test_goals_are_reachable_and_face_a_thing_with_nothing_between():
    plan, thing = plan_of(PLAN), np.array([[4.5, 4.5]])
    where = reachable(plan, 0.4, (1.5, 1.5))
    goal = find_goal(plan, where, thing)
    assert goal.x >= 4  # not through the wall, where it would be as near
    islands, _ = ndimage.label(where)  # of cells that share an edge
    assert islands[int(goal.x), int(goal.y)] == islands[1, 1] > 0
    far = find_goal(plan, where, thing, 1.5)
    assert far.distance >= 1.5
    assert np.hypot(4.5 - far.x, 4.5 - far.y) == pytest.approx(far.distance)
    assert far.yaw == pytest.approx(np.arctan2(4.5 - far.y, 4.5 - far.x))
    assert find_goal(plan, where, thing, 30.0) is None
    assert find_goal(plan, np.zeros(plan.free.shape, bool), thing) is None


def test_a_robot_stays_where_it_fits_and_where_it_is():
    plan = plan_of([*PLAN[:4], "#..#..#", PLAN[5]])  # two rooms
    assert np.argwhere(reachable(plan, 0.4, (1.5, 1.5)))[:, 0].max() == 2
    assert np.argwhere(reachable(plan, 0.4))[:, 0].max() == 2  # the larger one
    with pytest.raises(InputError, match="does not fit there"):
        reachable(plan, 0.4, (3.5, 2.5))
    with pytest.raises(InputError, match="fits nowhere"):
        reachable(plan, 5.0)


@pytest.mark.parametrize("share", [0.03, 0.3, 0.5, 0.8])
def test_a_collider_is_closed_around_what_is_occupied(share):
    hits = (np.random.default_rng(0).random((9, 8, 7)) < share).astype(np.uint16)
    corners, triangles = collider(Occupancy(IDENTITY, np.full(3, -1.0), 0.5, hits, np.zeros_like(hits)))
    assert_watertight(corners, triangles)
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(0.125 * hits.sum(), rel=0.06)


def nav2_map(folder: Path) -> tuple[Array, Array, dict[str, str]]:
    """(rows, columns) occupied and free, as map_server reads them in mode trinary, and the settings."""
    settings = dict(line.split(": ", 1) for line in (folder / "map.yaml").read_text().splitlines())
    assert settings["mode"] == "trinary"
    assert settings["negate"] == "0"
    shade = np.asarray(Image.open(folder / settings["image"])).astype(float)
    occupancy = (255 - shade) / 255
    occupied = occupancy > float(settings["occupied_thresh"])
    return occupied, occupancy < float(settings["free_thresh"]), settings


def test_the_command_writes_what_nav2_reads(tmp_path, capsys):
    save_scene(tmp_path / "room.ply", replace(box_room(), metres_per_unit=1.0))
    assert run("map", tmp_path / "room.ply", tmp_path / "map", *COARSE) == 0
    occupied, free, settings = nav2_map(tmp_path / "map")
    assert not (occupied & free).any()
    assert (~occupied & ~free).any()  # what nobody saw
    x, y, yaw = json.loads(settings["origin"])
    assert yaw == 0
    columns, rows = x + 0.1 * (np.arange(free.shape[1]) + 0.5), y + 0.1 * (np.arange(free.shape[0]) + 0.5)
    beyond = np.maximum(np.abs(columns)[None], np.abs(rows)[::-1, None]) > WALL + 0.15
    assert not free[beyond].any()
    labels, _ = ndimage.label(free)
    assert np.bincount(labels[labels > 0]).max() > 0.7 * free.sum()
    voxels = np.load(tmp_path / "map" / "voxels.npz", allow_pickle=False)
    assert len(voxels["cells"]) == len(voxels["words"]) == len(voxels["nodes"])
    assert (tmp_path / "map" / "collider.obj").read_text().startswith("v ")
    (tmp_path / "half" / "collider.obj").mkdir(parents=True)  # where none can be written
    assert run("map", tmp_path / "room.ply", tmp_path / "half", *COARSE) != 0
    assert not (tmp_path / "half" / "map.yaml").exists()  # which robots begin with


def test_goals_by_phrase_and_what_has_none(tmp_path, capsys):
    scene = box_room()
    near_block = (np.abs(scene.gaussians.means - [1.5, 0, FLOOR + 0.3]) < [0.4, 1.5, 0.4]).all(1)
    latents = np.zeros((3, len(near_block), 4), np.float32)
    latents[..., 3] = 1
    latents[:, near_block] = [1, 0, 0, 0]
    ones = np.ones(latents.shape[:2], np.float32)
    codec = named_scene(False).language.codec
    field = replace(named_scene().language, latents=latents, confidence=ones, codec=codec)
    save_scene(tmp_path / "room.ply", replace(scene, language=field, metres_per_unit=1.0))
    words = "map", tmp_path / "room.ply", tmp_path / "map", *COARSE, "--goal", "mug", "wall"
    assert run(*words) == 2
    assert "no goal for 'wall': not here" in capsys.readouterr().err
    (goal,) = json.loads((tmp_path / "map" / "goals.json").read_text())
    assert goal["phrase"] == "mug"
    assert 0.3 <= goal["distance"] < 1.0
    assert np.cos(goal["yaw"]) > 0  # towards the block, which stands at the wall x = 2


# Meshes in files, read back by other programs.

TETRAHEDRON = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
    np.array([[1.0, 0, 0], [0, 0.5, 0], [0, 0, 0], [0, 1, 0]]),
)


def test_a_ply_holds_a_mesh(tmp_path):
    write_mesh(tmp_path / "a.ply", TETRAHEDRON, Scene(random_gaussians(3)))
    data = PlyData.read(tmp_path / "a.ply")
    vertices = np.stack([data["vertex"][k] for k in "xyz"], 1)
    np.testing.assert_array_equal(vertices, TETRAHEDRON.vertices)
    np.testing.assert_array_equal(np.stack(data["face"]["vertex_indices"]), TETRAHEDRON.triangles)
    assert data["vertex"]["red"].tolist() == [255, 0, 0, 0]


ASIDE = np.array([2.0, 1.0, -1.5])
RING = tuple(ring(14, (320, 320), 6.0, ASIDE))


@pytest.mark.parametrize(("cameras", "metres"), [((), None), (RING, 0.25)])
def test_splats_and_surface_of_a_glb_overlap(tmp_path, cameras, metres):
    """As another program loads both: attributes, and the matrices of their nodes."""
    scene = replace(place_scene(ball(2.0), moving(ASIDE)), cameras=cameras, metres_per_unit=metres)
    save_scene(tmp_path / "splats.glb", scene)
    write_mesh(tmp_path / "mesh.glb", fuse(scene, resolution=0.05)[0], scene)
    places, colours = [], []
    for name in ("splats", "mesh"):
        file = parts((tmp_path / f"{name}.glb").read_bytes())
        matrix = np.reshape(file[0]["nodes"][0].get("matrix", np.eye(4).ravel()), (4, 4)).T
        places.append(glb_column(*file, "POSITION") @ matrix[:3, :3].T + matrix[:3, 3])
        colours.append(np.median(glb_column(*file, "COLOR_0")[:, :3], axis=0) / 65_535)
    size = 4 * (metres or 1.0)
    np.testing.assert_allclose(np.ptp(places[0], axis=0), size, rtol=0.02)
    gaps = cKDTree(places[0]).query(places[1])[0]
    assert np.median(gaps) < 0.02 * size  # the splats lie 0.04 apart
    assert gaps.max() < 0.05 * size
    np.testing.assert_allclose(colours[1], colours[0], atol=0.02)
    up = scene.up() * [-1, -1, 1]
    np.testing.assert_allclose(matrix[:3, :3] @ up, [0, metres or 1.0, 0], atol=1e-6)


# Stages of OpenUSD, as usd-core reads and judges them.


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_stage_is_valid_and_stands_upright_in_metres(tmp_path, caplog, suffix):
    usd, geom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    from pxr import UsdUtils, UsdValidation

    scene = load_scene(DEMO).take(np.arange(0, 80_000, 40))
    at = np.array([500_123.25, 5_412_345.5, 30.0])  # UTM
    save_scene(tmp_path / "far.ply", place_scene(scene, moving(at)))
    out = tmp_path / f"far{suffix}"
    parse(["convert", str(tmp_path / "far.ply"), str(out)]).run()
    stage = usd.Stage.Open(str(out))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []
    assert stage.GetDefaultPrim().GetPath() == "/Scene"
    prim = stage.GetPrimAtPath("/Scene/Gaussians")
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"

    def get(name: str) -> np.ndarray:
        return np.array(prim.GetAttribute(name).Get())

    matrix = np.array(geom.Xformable(prim).ComputeLocalToWorldTransform(0.0))
    world = get("positions") @ matrix[:3, :3] + matrix[3, :3]
    given = load_scene(tmp_path / "far.ply")
    heights = given.in_world(given.gaussians.means) @ given.up()
    np.testing.assert_allclose(np.diff(world[:, 1]), np.diff(heights), atol=1e-6)
    np.testing.assert_allclose(np.exp(given.gaussians.log_scales), get("scales"), rtol=1e-6)
    each = given.gaussians.sh.shape[1]
    harmonics = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
    assert (len(harmonics.Get()), harmonics.GetMetadata("elementSize")) == (2000 * each, each)
    np.testing.assert_array_equal(wholes := get("primvars:whole"), given.language.tree.at(2))
    bounds, named = geom.BBoxCache(0.0, ["default"], useExtentsHint=True), set()
    for thing in stage.GetPrimAtPath("/Scene/Things").GetChildren():
        box = bounds.ComputeWorldBound(thing).ComputeAlignedRange()
        own = world[wholes == thing.GetCustomDataByKey("node")]
        within = (own >= np.array(box.GetMin()) - 0.1) & (own <= np.array(box.GetMax()) + 0.1)
        assert within.all(1).mean() > 0.9
        named |= {*(thing.GetAttribute("semantics:labels:class").Get() or ())}
    assert {"teddy bear", "hamburger"} < named
    assert not caplog.messages
    out.with_name(f"far{suffix}.langsplat.safetensors").unlink()
    assert load_scene(out).language is None
    assert "language features and labels are in" in caplog.text
    assert UsdUtils.CreateNewUsdzPackage(str(out), str(tmp_path / "far.usdz"))
    np.testing.assert_array_equal(load_scene(tmp_path / "far.usdz").origin, load_scene(out).origin)


OTHERS = """#usda 1.0
( metersPerUnit = 0.01; upAxis = "Z" )
def Xform "World"
{
    double3 xformOp:translate = (100, 0, 50); float3 xformOp:rotateXYZ = (10, 20, 90)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    def Xform "Group"
    {
        float3 xformOp:scale.timeSamples = { 1: (2, 2, 2), 5: (3, 3, 3) }
        uniform token[] xformOpOrder = ["xformOp:scale"]
        def ParticleField3DGaussianSplat "Splats"
        {
            point3f[] positions = [(0, 0, 0), (1, 0, 0), (0, 0, 1)]
            quath[] orientationsh = [(1, 0, 0, 0), (0.6, 0, 0, 0.8), (1, 0, 0, 0)]
            float3[] scales = [(0.1, 0.1, 0.1), (0.3, 0.1, 0.1), (0.1, 0.1, 0.2)]
            float[] opacities.timeSamples = { 1: [0.9, 0.5, 0.25], 2: [0, 0, 0] }
            int radiance:sphericalHarmonicsDegree = 0
            float3[] radiance:sphericalHarmonicsCoefficients = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
        }
    }
    def Mesh "Table" ( references = @table.usd@ ) {}
    over "Splats" {}
}
"""


def test_a_stage_of_another_program_is_placed_by_its_transforms(tmp_path, caplog):
    usd, geom = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom"))
    (tmp_path / "a.usd").write_text(OTHERS)
    stage = usd.Stage.Open(str(tmp_path / "a.usd"))
    prim = stage.GetPrimAtPath("/World/Group/Splats")
    matrix = np.array(geom.Xformable(prim).ComputeLocalToWorldTransform(1.0))  # of rows
    got = load_scene(tmp_path / "a.usd")
    assert got.metres_per_unit == 0.01
    to_ours = np.array([[-1, 0, 0], [0, 0, -1], [0, -1, 0.0]])  # of rows: z is up there, -y here
    there = np.array(prim.GetAttribute("positions").Get()) @ matrix[:3, :3] + matrix[3, :3]
    np.testing.assert_allclose(got.in_world(got.gaussians.means), there @ to_ours, atol=1e-5)
    axes = rotation_matrices(got.gaussians.quats_wxyz)[1] * np.exp(got.gaussians.log_scales[1])
    long = np.array([1 - 2 * 0.8**2, 2 * 0.6 * 0.8, 0]) * 0.3  # x, turned about z
    np.testing.assert_allclose(np.abs(axes[:, 0]), np.abs(long @ matrix[:3, :3] @ to_ours), atol=1e-3)
    np.testing.assert_allclose(1 / (1 + np.exp(-got.gaussians.opacity_logits)), [0.9, 0.5, 0.25], atol=1e-6)
    for said in ("2 moments of opacities", "of xformOp:scale", "'Mesh'", "/World/Splats", "to, 'table.usd'"):
        assert said in caplog.text
    broken = {"scales its axes unlike": ("(2, 2, 2)", "(2, 1, 1)"), "do not fit degree": ("= 0\n", "= 1\n")}
    broken |= {"holds no Particle": ("3DGaussianSplat", ""), "has no scales": ("[] scales", "[] s")}
    for message, change in broken.items():
        (tmp_path / "b.usd").write_text(OTHERS.replace(*change))
        with pytest.raises(FormatError, match=message):
            load_scene(tmp_path / "b.usd")


def test_optional_packages_are_asked_for_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.setattr(apart, "run", lambda read, *given, progress, **_: read(*given, progress))
    (stage := tmp_path / "a.usda").write_text(OTHERS)
    for ask in (lambda: load_scene(stage), lambda: save_scene(tmp_path / "b.usdc", blob_scene())):
        with pytest.raises(BackendError, match=r"langsplat-viewer\[usd\]"):
            ask()
    with pytest.raises(ModuleNotFoundError):
        fuse(box_room(1), progress=lambda *_, **__: pytest.fail("rendered first"))

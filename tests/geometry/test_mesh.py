"""Meshes of rooms whose surfaces are known, holes and their closing, files; and two scenes as one."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.geometry.mesh import Mesh, close_holes, fuse, generated_cameras, surface_depth
from langsplat_core.io.shapes import gltf_axes, write_meshes
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import Gaussians, Scene, look_at
from tests.support.scenes import FLOOR, WALL, box_room, random_camera, random_gaussians

pytest.importorskip("open3d")


def ball(radius: float = 1.0, count: int = 3000) -> Scene:
    """Flat opaque Gaussians on a sphere around the origin, without cameras."""
    index = np.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    turns = [Rotation.align_vectors([normal], [[0, 0, 1]])[0].as_quat() for normal in normals]
    sh = np.tile(np.array([1.0, -1.0, 0.0]), (count, 1, 1))
    flat = np.log([0.04 * radius, 0.04 * radius, 0.0004 * radius])
    return Scene(
        Gaussians(
            radius * normals, np.tile(flat, (count, 1)), np.array(turns)[:, [3, 0, 1, 2]],
            np.full(count, 5.0), sh,
        )
    )  # fmt: skip


def test_depth_is_that_of_the_planes_where_gaussians_are_flat():
    scene = box_room()
    camera = scene.cameras[0]
    view = CpuRasterizer().view(scene.gaussians, camera)
    depth = surface_depth(scene.gaussians, camera, view.median_rows())
    rows, columns = np.nonzero(depth)
    rays = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy], 1)
    points = np.column_stack([rays, np.ones(len(rays))]) * depth[rows, columns, None]
    world = (points - camera.world_to_camera[:3, 3]) @ camera.rotation
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


def sharp_room(seed: int = 1) -> Scene:
    """With pixels of a centimetre."""
    room = box_room(seed)
    return replace(room, cameras=tuple(camera.resized(384, 288) for camera in room.cameras))


def distances_to_room(points: Array) -> Array:
    """To the nearest of floor and walls; what stands on the table is left out by height."""
    return np.minimum(np.abs(points[:, 2] - FLOOR), np.abs(np.abs(points[:, :2]).max(1) - WALL))


def test_the_surface_of_a_room_is_found():
    mesh, side = fuse(sharp_room())
    shell = (mesh.vertices[:, 2] < -0.1) & (np.abs(mesh.vertices[:, :2]).max(1) > 1.85)
    assert shell.sum() > 1000
    assert np.median(distances_to_room(mesh.vertices[shell])) < 0.005 < side
    assert mesh.holes() > 0  # no ceiling
    assert mesh.colour.min() >= 0
    assert mesh.colour.std() > 0.05


def test_more_views_leave_out_more():
    loose, strict = (fuse(box_room(1), 0.05, views)[0] for views in (1, 4))
    assert strict.areas().sum() < 0.9 * loose.areas().sum()


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


def test_generated_cameras_are_outside():
    outside = np.stack([camera.position for camera in generated_cameras(ball())])
    assert (np.linalg.norm(outside, axis=1) > 1.5).all()


def test_nothing_to_see_is_refused():
    away = look_at(np.array([0, 0, 3.0]), np.array([0, 0, 9.0]), np.array([0, 1.0, 0]), (20, 20))
    with pytest.raises(InputError, match="see no surface"):
        fuse(ball(), cameras=(away,))
    with pytest.raises(InputError, match="finer than the images"):
        fuse(ball(), 1e-6)
    with pytest.raises(InputError, match="too few views"):
        fuse(ball(), views=1000)
    with pytest.raises(InputError, match="see no surface"):
        fuse(Scene(random_gaussians(0)))


def triangle() -> Mesh:
    return Mesh(np.eye(3), np.array([[0, 1, 2]]), np.array([[1.0, 0, 0], [0, 0.5, 0], [0, 0, 0]]), "a b")


def test_glb_holds_places_colours_and_axes(tmp_path):
    scene = replace(box_room(), metres_per_unit=2.0)
    write_meshes(tmp_path / "a.glb", [triangle(), triangle()], gltf_axes(scene))
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    assert document["buffers"][0]["byteLength"] == len(binary)
    assert len(document["meshes"]) == 2
    np.testing.assert_array_equal(np.frombuffer(binary[:36], "<f4").reshape(3, 3), np.eye(3))
    colours = np.frombuffer(binary[36:60], "<u2").reshape(3, 4) / 65_535
    np.testing.assert_allclose(colours[:, :3].sum(1), [1, 0.2140, 0], atol=1e-4)  # linear
    matrix = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix @ [0, 0, 1, 1], [0, 2, 0, 1], atol=1e-6)  # up, metres
    import open3d

    write_meshes(tmp_path / "one.glb", [triangle()])
    read = open3d.io.read_triangle_mesh(str(tmp_path / "one.glb"))
    np.testing.assert_allclose(np.asarray(read.vertices), np.eye(3))


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_other_programs_read_colours_of_vertices(tmp_path, suffix):
    import open3d

    write_meshes(tmp_path / f"a{suffix}", [triangle()])
    read = open3d.io.read_triangle_mesh(str(tmp_path / f"a{suffix}"))
    np.testing.assert_allclose(np.asarray(read.vertices), np.eye(3))
    np.testing.assert_allclose(np.asarray(read.vertex_colors), triangle().colour, atol=0.003)

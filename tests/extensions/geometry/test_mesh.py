"""Meshes of rooms whose surfaces are known, holes and their closing, files; and two scenes as one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from langsplat_core.errors import InputError
from langsplat_core.extensions.geometry.mesh import Mesh, close_holes, fuse, surface_depth
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import Gaussians, Scene, look_at
from langsplat_core.scene.transform import AXES, rotation_quaternion, turning
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

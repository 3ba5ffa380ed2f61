"""Planes of a room, and two captures of one room laid onto each other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.geometry import registration
from langsplat_core.geometry.planes import find_room
from langsplat_core.geometry.points import FEWEST, sample_surface
from langsplat_core.geometry.registration import agreement, quarter_turns, register
from langsplat_core.scene import Scene
from langsplat_core.scene import transform as transforms
from langsplat_core.scene.transform import moved_camera
from tests.support.scenes import FLOOR, WALL, box_room, random_gaussians

pytest.importorskip("open3d")


def similarity(turn: tuple[float, float, float], step: tuple[float, float, float], scale: float = 1) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = step
    return matrix


def moved(scene: Scene, matrix: Array) -> Scene:
    return transforms.transform_scene(scene, transforms.similarity(matrix))


def degrees_apart(one: Array, other: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("transform", [np.eye(4), similarity((0.2, -0.1, 0.7), (3.0, -1.0, 5.0), 2.0)])
def test_floor_walls_and_up_are_found(seed, transform):
    scale = float(np.cbrt(np.linalg.det(transform[:3, :3])))
    room = find_room(moved(box_room(seed), transform))
    up = transform[:3, 2] / scale
    assert degrees_apart(room.up, up) < 2
    assert room.floor is not None
    assert room.ground == pytest.approx(scale * FLOOR + transform[:3, 3] @ up, abs=0.03 * scale * WALL)
    want = [sign * transform[:3, axis] / scale for axis in (0, 1) for sign in (1, -1)]
    assert len(room.walls) == 4
    for normal in want:
        assert min(degrees_apart(wall.normal, normal) for wall in room.walls) < 4
    assert all(
        wall.heights(transform[None, :3, 3])[0] == pytest.approx(scale * WALL, rel=0.1) for wall in room.walls
    )


def test_what_has_no_floor_has_the_cameras_up_and_its_lowest_surface():
    rng = np.random.default_rng(0)
    scene = box_room()
    ball = rng.normal(size=(len(scene.gaussians), 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    floating = Scene(
        type(scene.gaussians)(ball, *list(vars(scene.gaussians).values())[1:]), cameras=scene.cameras
    )
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
    with pytest.raises(InputError, match="have no surface"):
        find_room(few)
    with pytest.raises(InputError, match="have no surface"):
        register(few, box_room())


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "SAMPLES", 20_000)


@pytest.mark.parametrize(("scale", "scaled"), [(1.0, False), (3.0, True)])
def test_a_capture_is_laid_onto_another(quick, scale, scaled):
    there = similarity((0.4, -0.3, 1.2), (2.0, 1.0, -3.0), scale)
    fixed = box_room(2)
    found = register(moved(fixed, there), fixed, scaled)
    off = found.transform @ there
    assert found.trusted
    assert found.agreement > 0.9
    assert np.linalg.norm(off - np.eye(4)) < 0.03
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


def test_metres_decide_the_scale(quick):
    there = similarity((0, 0, 0.5), (0.0, 1.0, 0.0), 3.0)
    fixed = Scene(box_room(2).gaussians, cameras=box_room(2).cameras, metres_per_unit=1.0)
    turned = moved(fixed, there)
    moving = Scene(turned.gaussians, cameras=turned.cameras, metres_per_unit=1 / 3)
    found = register(moving, fixed)
    assert found.scale == pytest.approx(1 / 3)
    assert np.linalg.norm(found.transform @ there - np.eye(4)) < 0.03


def test_agreement_tells_a_place_from_another():
    there = similarity((0.4, -0.3, 1.2), (2.0, 1.0, -3.0), 2.0)
    fixed = box_room(3)
    moving = moved(fixed, there)
    assert agreement(moving, fixed, np.linalg.inv(there)) > 0.95
    assert agreement(moving, fixed, np.linalg.inv(there) @ similarity((0, 0, 0.3), (0.6, 0, 0.4))) < 0.7
    assert agreement(moving, fixed, np.eye(4)) < 0.7


def test_a_camera_moved_along_sees_the_same_points():
    transform = similarity((0.4, -0.3, 1.2), (2.0, 1.0, -3.0), 2.5)
    camera = box_room().cameras[0]
    other, scale = moved_camera(camera, transform)
    points = np.random.default_rng(0).normal(size=(50, 3))
    pixels, depths = camera.project(points @ transform[:3, :3].T + transform[:3, 3])
    np.testing.assert_allclose(other.project(points)[0], pixels, rtol=1e-9)
    np.testing.assert_allclose(scale * other.project(points)[1], depths, rtol=1e-9)
    with pytest.raises(InputError, match="similarity"):
        moved_camera(camera, np.diag([1.0, 1, -1, 1]))

"""A transformed scene seen by the transformed camera is the scene that was there before."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import rotation_matrices, unit
from langsplat_core.errors import InputError
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import (
    AXES,
    IDENTITY,
    Similarity,
    moving,
    rotating,
    rotation_quaternion,
    scaling,
    sh_basis,
    sh_rotations,
    similarity,
    transform_gaussians,
    transform_rows,
    transform_scene,
    turning,
)
from tests.support.file_samples import random_field
from tests.support.scenes import random_camera, random_gaussians, without_perspective

TO = rotating(np.array([1.0, -2.0, 0.5]), 77).then(scaling(1.7)).then(moving(np.array([3.0, -1.0, 2.0])))
TURNS = [rotating(axis, degrees) for axis in AXES.values() for degrees in (90, 180)] + [TO]


def image(gaussians, camera):
    return splat_colours(ReferenceRasterizer().view(gaussians, camera), gaussians, camera).colours


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("perspective", [True, False])
def test_the_transformed_scene_looks_the_same(degree: int, perspective: bool) -> None:
    """To the float64 reference; the Gaussians themselves are rounded to float32."""
    gaussians, camera = random_gaussians(40, seed=3, sh_degree=degree), random_camera(4)
    camera = camera if perspective else without_perspective(camera)
    for to in (*TURNS, scaling(0.5)):
        moved = image(transform_gaussians(gaussians, to), to.camera(camera))
        np.testing.assert_allclose(moved, image(gaussians, camera), atol=2e-5)


@pytest.mark.parametrize("to", TURNS)
def test_harmonics_turn_with_the_world(to: Similarity) -> None:
    """Orthogonal matrices, and f'(R d) = f(d) at directions that did not make them."""
    directions = unit(np.random.default_rng(1).normal(size=(50, 3)))
    values = np.random.default_rng(2).normal(size=16)
    for order, matrix in enumerate(sh_rotations(to.rotation, 3)):
        span = slice(order**2, (order + 1) ** 2)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(2 * order + 1), atol=1e-12)
        before = sh_basis(directions, 16)[:, span] @ values[span]
        after = sh_basis(directions @ to.rotation.T, 16)[:, span] @ (matrix @ values[span])
        np.testing.assert_allclose(after, before, atol=1e-12)


def test_transforms_compose_and_lead_back():
    points = np.random.default_rng(0).normal(size=(20, 3))
    other = rotating(AXES["y"], 12).then(scaling(0.25))
    np.testing.assert_allclose(TO.then(other).points(points), other.points(TO.points(points)), atol=1e-12)
    np.testing.assert_allclose(TO.then(TO.inverse()).matrix, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(TO.then(other).matrix, other.matrix @ TO.matrix, atol=1e-12)
    np.testing.assert_allclose(similarity(TO.matrix).matrix, TO.matrix, atol=1e-12)
    centre = np.array([1.0, 2.0, 3.0])
    turned = rotating(AXES["z"], 30).then(scaling(3)).about(centre)
    np.testing.assert_allclose(turned.points(centre[None])[0], centre, atol=1e-12)


def test_four_quarter_turns_are_none_at_all():
    quarter = rotating(AXES["z"], 90)
    assert quarter.then(quarter).then(quarter).then(quarter).is_identity
    assert rotating(AXES["x"], -360).is_identity


def test_a_quaternion_of_every_rotation():
    quats = unit(np.random.default_rng(5).normal(size=(300, 4)))
    for quat, matrix in zip(quats, rotation_matrices(quats), strict=True):
        np.testing.assert_allclose(rotation_quaternion(matrix), quat * np.sign(quat[0]), atol=1e-12)
    for turn in TURNS:
        matrix = rotation_matrices(rotation_quaternion(turn.rotation)[None])[0]
        np.testing.assert_allclose(matrix, turn.rotation, atol=1e-12)


@pytest.mark.parametrize("onto", [*AXES.values(), np.array([1.0, 1.0, 1e-9])])
def test_a_direction_is_turned_onto_another(onto) -> None:
    for start in (*AXES.values(), np.array([0.3, -2.0, 0.1])):
        np.testing.assert_allclose(turning(start, onto).rotation @ unit(start), unit(onto), atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (np.diag([1.0, 1, -1, 1]), "mirrors"),
        (np.diag([1.0, 1, 0, 1]), "flat"),
        (np.zeros((4, 4)) + np.diag([0, 0, 0, 1.0]), "flat"),
        (np.diag([1.0, 1, 2, 1]), "unlike"),
        (np.eye(4) + 0.2 * np.eye(4, k=1) * [[1], [0], [0], [0]], "shears"),
        (np.eye(4) * [1, 1, 1, 2.0], "last row"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_a_matrix_that_is_no_similarity_is_refused(matrix, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        similarity(matrix)


def test_numbers_that_leave_nothing_are_refused():
    for make in (
        lambda: scaling(0),
        lambda: scaling(-1),
        lambda: scaling(np.inf),
        lambda: moving(np.array([np.nan, 0, 0])),
        lambda: rotating(np.zeros(3), 90),
        lambda: rotating(AXES["x"], np.inf),
        lambda: transform_gaussians(random_gaussians(3), scaling(1e39)),
        lambda: transform_gaussians(random_gaussians(3), moving(np.array([1e39, 0, 0]))),
        lambda: transform_scene(Scene(random_gaussians(3), cameras=(random_camera(),)), scaling(1e12)),
    ):
        with pytest.raises(InputError):
            make()


def test_rows_that_cannot_be_drawn_stay_so():
    """Zero quaternions, flat axes, places that are not finite: as they were, and no warning."""
    gaussians = random_gaussians(6, sh_degree=3)
    gaussians.quats_wxyz[0] = 0
    gaussians.log_scales[1, 2] = -np.inf
    gaussians.means[2] = [np.nan, np.inf, 0]
    gaussians.sh[3, 5] = np.nan
    gaussians.opacity_logits[4] = np.inf
    moved = transform_gaussians(gaussians, TO)
    np.testing.assert_array_equal(moved.valid(), gaussians.valid())
    assert moved.log_scales[1, 2] == -np.inf
    assert (moved.quats_wxyz[0] == 0).all()


def test_companions_go_along():
    """The language field is the same object, cameras move, a metre stays a metre."""
    scene = Scene(
        random_gaussians(9),
        random_field(9),
        (random_camera(),),
        extras={"age": np.arange(9.0)},
        metres_per_unit=0.5,
    )
    moved = transform_scene(scene, TO)
    assert moved.language is scene.language
    assert moved.extras is scene.extras
    assert moved.metres_per_unit == pytest.approx(0.5 / TO.scale)
    np.testing.assert_allclose(moved.cameras[0].position, TO.points(scene.cameras[0].position[None])[0])
    np.testing.assert_allclose(moved.up(), TO.rotation @ scene.up(), atol=1e-12)
    assert transform_scene(scene, IDENTITY) is scene


@pytest.mark.parametrize("chosen", [[], [4], range(9)])
def test_a_part_moves_alone(chosen) -> None:
    gaussians = random_gaussians(9, sh_degree=2)
    selected = np.isin(np.arange(9), list(chosen))
    moved = transform_rows(gaussians, selected, TO)
    whole = transform_gaussians(gaussians, TO)
    for name in ("means", "log_scales", "quats_wxyz", "sh"):
        expected = np.where(
            selected.reshape(-1, *[1] * (getattr(whole, name).ndim - 1)),
            getattr(whole, name),
            getattr(gaussians, name),
        )
        np.testing.assert_array_equal(getattr(moved, name), expected)


def test_an_empty_scene_is_transformed():
    nothing = random_gaussians(0, sh_degree=3)
    assert len(transform_gaussians(nothing, TO)) == 0
    assert isinstance(transform_scene(Scene(nothing), replace(TO)).gaussians, Gaussians)

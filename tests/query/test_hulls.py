"""Hulls: closed, turned outwards, around the thing and not its strays."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.query.instances import INNER, Instance, Mesh, hull, hulls
from langsplat_core.scene import Gaussians


def thing(points: Array) -> tuple[Instance, Gaussians]:
    n = len(points)
    gaussians = Gaussians(
        means=points,
        log_scales=np.full((n, 3), -4.0),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (n, 1)),
        opacity_logits=np.full(n, 3.0),
        sh=np.zeros((n, 1, 3)),
    )
    positions = gaussians.means.astype(np.float64)
    return Instance(np.arange(n), 0.9, 0.9, positions.mean(0), positions, 1.0), gaussians


def colours(n: int) -> Array:
    return np.tile([0.2, 0.4, 0.6], (n, 1))


def volume(mesh: Mesh) -> float:
    """Positive where the triangles are turned outwards; a closed mesh is needed."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)


def check_closed(mesh: Mesh) -> None:
    edges = [(int(t[k]), int(t[(k + 1) % 3])) for t in mesh.triangles for k in range(3)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)


def test_the_hull_of_a_cloud_is_its_convex_hull_within_the_box():
    points = np.random.default_rng(0).uniform(size=(3000, 3)) * [3, 2, 1]
    points[:5] += 100  # strays
    instance, gaussians = thing(points)
    mesh = hull(instance, gaussians, colours(3000), "cloud")
    check_closed(mesh)
    inside = instance.oriented.contains(gaussians.means.astype(np.float64))
    assert volume(mesh) == pytest.approx(ConvexHull(gaussians.means[inside]).volume, rel=1e-6)
    assert 0.85 * 6 * (INNER[1] - INNER[0]) ** 3 < volume(mesh) < 6
    np.testing.assert_allclose(mesh.colour, [0.2, 0.4, 0.6])
    assert (np.abs((mesh.vertices - instance.oriented.centre) @ instance.oriented.axes) < 1.6).all()


@pytest.mark.parametrize("flat", [[1, 1, 0], [1, 0, 0]], ids=["sheet", "line"])
def test_sheets_and_lines_are_given_a_thickness(flat):
    instance, gaussians = thing(np.random.default_rng(0).uniform(size=(200, 3)) * flat)
    mesh = hull(instance, gaussians, colours(200), "flat")
    check_closed(mesh)
    assert volume(mesh) > 0


def test_four_points_are_enough_and_all_of_them_count():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    assert volume(hull(*thing(points), colours(4), "four")) == pytest.approx(1 / 6)


def test_a_point_has_none():
    instance, gaussians = thing(np.ones((5, 3)))
    with pytest.raises(InputError, match="mug 1 is a single point"):
        hulls([instance], gaussians, colours(5), "mug")


def test_each_has_a_number():
    instance, gaussians = thing(np.random.default_rng(0).uniform(size=(50, 3)))
    found = hulls([instance, replace(instance)], gaussians, colours(50), "red mug")
    assert [mesh.name for mesh in found] == ["red mug 1", "red mug 2"]

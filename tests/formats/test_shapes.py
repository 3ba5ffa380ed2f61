"""Point clouds and meshes, read back by other programs."""

from types import SimpleNamespace

import numpy as np
import pytest
from plyfile import PlyData

from langsplat_core.errors import InputError
from langsplat_core.io.shapes import base_colours, write_meshes, write_points
from tests.support.scenes import random_gaussians

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def meshes():
    one = SimpleNamespace(
        name="red mug 1", vertices=TETRAHEDRON, triangles=FACES, colour=np.array([1, 0, 0.5])
    )
    two = SimpleNamespace(name="two", vertices=TETRAHEDRON + 5, triangles=FACES, colour=np.array([0, 1, 0]))
    return [one, two]


def test_points_have_colours_and_what_else_is_given(tmp_path):
    gaussians = random_gaussians(40, sh_degree=1)
    gaussians.means[7] = np.nan
    relevancy = np.linspace(0, 1, 40)
    assert write_points(tmp_path / "a.ply", gaussians, {"relevancy": relevancy}) == 39
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    kept = np.delete(np.arange(40), 7)
    np.testing.assert_array_equal(np.stack([vertex[k] for k in "xyz"], 1), gaussians.means[kept])
    colours = np.stack([vertex[name] for name in ("red", "green", "blue")], 1)
    want = np.clip(0.5 + 0.28209479177 * gaussians.sh[kept, 0].astype(np.float64), 0, 1)
    assert np.abs(colours / 255 - want).max() <= 0.5 / 255 + 1e-9
    np.testing.assert_allclose(vertex["relevancy"], relevancy[kept], atol=1e-7)


def test_colours_stay_colours():
    gaussians = random_gaussians(4)
    gaussians.sh[:, 0] = [[np.nan, np.inf, -np.inf], [9, -9, 0], [0, 0, 0], [1, 1, 1]]
    colours = base_colours(gaussians)
    assert ((colours >= 0) & (colours <= 1)).all()
    assert colours[1].tolist() == [1, 0, 0.5]


def test_a_ply_mesh_holds_all_of_them(tmp_path):
    write_meshes(tmp_path / "a.ply", meshes())
    data = PlyData.read(tmp_path / "a.ply")
    places = np.stack([data["vertex"][k] for k in "xyz"], 1)
    np.testing.assert_array_equal(places, np.concatenate([TETRAHEDRON, TETRAHEDRON + 5]))
    faces = np.stack(data["face"]["vertex_indices"])
    np.testing.assert_array_equal(faces, np.concatenate([FACES, FACES + 4]))
    assert data["vertex"]["red"].tolist() == [255] * 4 + [0] * 4


def test_an_obj_names_its_objects(tmp_path):
    write_meshes(tmp_path / "a.OBJ", meshes())
    lines = (tmp_path / "a.OBJ").read_text().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o red_mug_1", "o two"]
    assert lines[1] == "v 0 0 0 1.0000 0.0000 0.5000"
    faces = np.array([line.split()[1:] for line in lines if line.startswith("f ")], int)
    np.testing.assert_array_equal(faces, np.concatenate([FACES, FACES + 4]) + 1)


@pytest.mark.long
def test_open3d_reads_them(tmp_path):
    import open3d

    for name in ("a.ply", "a.obj"):
        write_meshes(tmp_path / name, meshes())
        mesh = open3d.io.read_triangle_mesh(str(tmp_path / name))
        assert len(mesh.triangles) == 8
        assert mesh.is_watertight()
        assert mesh.get_volume() == pytest.approx(1 / 3)
    write_points(tmp_path / "p.ply", random_gaussians(10))
    assert len(open3d.io.read_point_cloud(str(tmp_path / "p.ply")).points) == 10


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"\.ply; choose"):
        write_points(tmp_path / "a.obj", random_gaussians(3))
    with pytest.raises(InputError, match=r"\.ply or \.obj"):
        write_meshes(tmp_path / "a.stl", meshes())
    assert list(tmp_path.iterdir()) == []

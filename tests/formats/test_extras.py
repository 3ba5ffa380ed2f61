"""Further properties of a scene: they survive, in their own types, and cost their own memory only."""

import tracemalloc
from dataclasses import fields

import numpy as np
import plyfile
import pytest

from langsplat_core.errors import InputError
from langsplat_core.io import load_scene, read_ply_scene, save_scene, write_ply
from langsplat_core.scene import Scene
from tests.support.extras import random_extras
from tests.support.file_samples import (
    ascii_ply,
    columns,
    inria_names,
)
from tests.support.same import assert_same_extras
from tests.support.scenes import random_gaussians

N = 40


def test_extra_properties_survive_in_their_own_types(tmp_path):
    scene = Scene(random_gaussians(N, sh_degree=2), extras=random_extras())
    save_scene(tmp_path / "a.ply", scene)
    got = load_scene(tmp_path / "a.ply")
    assert_same_extras(got.extras, scene.extras)
    np.testing.assert_array_equal(got.gaussians.sh, scene.gaussians.sh)
    save_scene(tmp_path / "b.ply", got)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_another_reader_finds_them_behind_the_layout(tmp_path):
    scene, extras = random_gaussians(N, sh_degree=1), random_extras()
    write_ply(tmp_path / "a.ply", scene, extras=extras)
    vertex = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"]
    assert [prop.name for prop in vertex.properties] == [*inria_names(1), *extras]
    for name, values in (columns(scene) | extras).items():
        np.testing.assert_array_equal(vertex[name], values, name)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_extra_properties_of_another_writer(tmp_path, text, byte_order):
    """Anywhere among the others, in any encoding; normals are none of them."""
    scene, extras = random_gaussians(N), random_extras()
    values = columns(scene) | extras
    names = list(values)
    np.random.default_rng(0).shuffle(names)
    table = np.zeros(N, [(name, values[name].dtype) for name in names])
    for name in names:
        table[name] = values[name]
    element = plyfile.PlyElement.describe(table, "vertex")
    plyfile.PlyData([element], text=text, byte_order=byte_order).write(tmp_path / "a.ply")
    got = read_ply_scene(tmp_path / "a.ply")
    assert_same_extras(got.extras, {name: extras[name] for name in names if name in extras})
    np.testing.assert_array_equal(got.gaussians.quats_wxyz, scene.quats_wxyz)


def test_numbers_that_an_integer_column_cannot_hold_are_read_without_a_word(tmp_path, recwarn):
    content = ascii_ply(random_gaussians(1)).decode()
    content = content.replace("end_header", "property uchar extra\nend_header")
    for number in ("300", "-1", "nan", "1e300"):
        (tmp_path / "a.ply").write_text(f"{content} {number}")
        assert read_ply_scene(tmp_path / "a.ply").extras["extra"].dtype == np.uint8
    assert not recwarn.list


def test_rows_that_are_removed_take_their_extras_along(tmp_path):
    scene = Scene(random_gaussians(N), extras=random_extras())
    save_scene(tmp_path / "a.ply", scene)
    save_scene(tmp_path / "b.ply", load_scene(tmp_path / "a.ply").take(np.arange(N) % 3 == 0))
    got = load_scene(tmp_path / "b.ply")
    assert_same_extras(got.extras, {name: values[::3] for name, values in scene.extras.items()})


@pytest.mark.parametrize(
    ("name", "dtype", "says"),
    [
        ("x", "f4", "rename"),
        ("nx", "f4", "rename"),
        ("f_rest_3", "f4", "rename"),
        ("two words", "f4", "rename"),
        ("a\nend_header", "f4", "rename"),
        ("", "f4", "rename"),
        ("long", "i8", "type int64"),
        ("flag", "?", "type bool"),
        ("half", "f2", "type float16"),
    ],
)
def test_extras_that_no_ply_can_hold(tmp_path, name, dtype, says):
    with pytest.raises(InputError, match=says):
        write_ply(tmp_path / "a.ply", random_gaussians(3), extras={name: np.zeros(3, dtype)})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extra", ["", "f4", "u1"])
def test_loading_holds_little_beside_the_arrays_it_keeps(tmp_path, extra):
    gaussians = random_gaussians(50_000, sh_degree=3)
    extras = {"extra": np.zeros(len(gaussians), extra)} if extra else {}
    write_ply(tmp_path / "a.ply", gaussians, extras=extras)
    tracemalloc.start()
    scene = load_scene(tmp_path / "a.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    arrays = [getattr(scene.gaussians, field.name) for field in fields(scene.gaussians)]
    kept = sum(array.nbytes for array in (*arrays, *scene.extras.values()))
    assert kept > 50_000 * 4 * 58
    assert kept < peak < kept + 4e6  # a few chunks; a copy of the coefficients would be 10 MB

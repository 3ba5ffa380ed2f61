"""What a scene's file tells beside the layout: extra properties, antialiasing; and whole scenes converted."""

import json
import tracemalloc
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import plyfile
import pytest

from langsplat_core.cli import query
from langsplat_core.cli.convert import Convert
from langsplat_core.cli.query import QueryScene
from langsplat_core.config import INRIA, PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.formats import (
    companion_path,
    language,
    load_scene,
    read_ply_scene,
    read_sog_scene,
    save_scene,
    write_ply,
)
from langsplat_core.lab.rooms.scoring import ask, evaluate
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Scene
from langsplat_viewer.channels import ArrayChannels, Layers
from langsplat_viewer.frame import FrameRenderer
from tests.support.fakes import blobs
from tests.support.fakes import cameras as fake_cameras
from tests.support.fakes import language as fake_language
from tests.support.file_samples import (
    ascii_ply,
    columns,
    compressed_ply,
    inria_names,
    random_field,
    sog_files,
    write_folder,
)
from tests.support.scenes import random_camera, random_gaussians

N = 40
PICTURE = PictureConfig(display="alpha")
TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def random_extras(count: int = N) -> dict:
    """One property of every PLY type, each with its extremes in the first rows."""
    rng = np.random.default_rng(3)
    extras = {}
    for code in TYPES:
        dtype = np.dtype(code)
        values = rng.integers(0, 100, size=count).astype(dtype)
        limits = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(dtype)
        values[:2] = limits.min, limits.max
        extras[f"extra_{code}"] = values
    extras["extra_f4"][2:4] = np.nan, np.inf
    return extras


def assert_same_extras(got, want) -> None:
    assert list(got) == list(want)
    for name, values in want.items():
        assert got[name].dtype == values.dtype
        np.testing.assert_array_equal(got[name], values, name)


# ---- extra properties ----


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


# ---- antialiasing ----

MARKS = [
    ((), False),
    (("Exported from Brush", "SplatRenderMode: mip"), True),
    (("SplatRenderMode: default",), False),
    (("SplatRenderMode: 2dgs",), False),
    (("  SPLATRENDERMODE:   MIP ",), True),
    (("SplatRenderMode:mip",), True),
    (("antialiased 1",), True),
    (("antialiased 0",), False),
    (("antialiased",), False),
    (("the antialiased 1 of them",), False),
    (("train_flags exposure antialiasing",), True),
    (("train_flags exposure",), False),
    (("antialiased 1", "SplatRenderMode: default"), False),
    (("SplatRenderMode: default", "antialiased 1"), True),
]


@pytest.mark.parametrize(("comments", "antialiased"), MARKS)
def test_the_marks_of_other_programs(tmp_path, comments, antialiased):
    write_ply(tmp_path / "a.ply", random_gaussians(3), comments)
    assert load_scene(tmp_path / "a.ply").antialiased is antialiased


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_mark_is_written_back(tmp_path, antialiased):
    save_scene(tmp_path / "a.ply", Scene(random_gaussians(3), antialiased=antialiased))
    assert load_scene(tmp_path / "a.ply").antialiased is antialiased
    assert (b"comment SplatRenderMode: mip\n" in (tmp_path / "a.ply").read_bytes()) is antialiased


def test_the_mark_of_a_compressed_ply(tmp_path):
    content = compressed_ply(random_gaussians(300))
    (tmp_path / "a.ply").write_bytes(content.replace(b"made by a test", b"antialiased 1"))
    assert read_ply_scene(tmp_path / "a.ply").antialiased
    (tmp_path / "a.ply").write_bytes(content)
    assert not read_ply_scene(tmp_path / "a.ply").antialiased


@pytest.mark.parametrize(
    ("entry", "antialiased"),
    [
        ({}, False),
        ({"model": "antialiased"}, True),
        ({"model": "2dgs"}, False),
        ({"model": ["antialiased"]}, False),
        ({"antialias": True}, True),
        ({"antialias": False}, False),
        ({"antialias": "no"}, False),
    ],
)
def test_the_mark_of_a_sog(tmp_path, entry, antialiased):
    files = sog_files(random_gaussians(20))
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | entry).encode()
    assert read_sog_scene(write_folder(tmp_path / "a", files)).antialiased is antialiased


def small_scene(tmp_path, antialiased: bool) -> Scene:
    """Read from a file; its Gaussians are as small as pixels, where the compensation matters."""
    gaussians = random_gaussians(60, scale_range=(0.002, 0.02))
    write_ply(tmp_path / "a.ply", gaussians, ("SplatRenderMode: mip",) if antialiased else ())
    return load_scene(tmp_path / "a.ply")


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_marked_file_is_drawn_as_the_reference_draws_it(tmp_path, gl, antialiased):
    scene, camera = small_scene(tmp_path, antialiased), random_camera(1)
    settings = replace(INRIA, antialiased=antialiased)
    reference = ReferenceRasterizer().view(scene.gaussians, camera, settings)
    _, want = reference.splat(np.zeros((60, 0)))
    _, other = (
        ReferenceRasterizer()
        .view(scene.gaussians, camera, replace(INRIA, antialiased=not antialiased))
        .splat(np.zeros((60, 0)))
    )
    assert np.abs(want - other).max() > 0.05  # the mark is worth something
    channels = ArrayChannels(load_rasterizer("cpu"))
    drawn = channels.render(scene, Layers(), camera, "none")
    np.testing.assert_allclose(drawn.alpha, want, atol=1e-4)
    row, column = np.unravel_index(np.argmax(want), want.shape)
    np.testing.assert_allclose(
        channels.depth_at(scene, camera, int(column), int(row))[1], want.max(), atol=1e-4
    )
    frame = FrameRenderer(gl, "opengl", "single")
    frame.set_scene(scene)
    frame.draw(gl.simple_framebuffer((camera.width, camera.height)), camera, PICTURE)
    assert frame.depth_at(column + 0.5, row + 0.5) is not None
    alpha = frame.read(camera, PICTURE)[..., 0] / 255
    np.testing.assert_allclose(alpha, want, atol=0.5 / 255 + 1e-3)
    frame.release()


def test_the_same_gaussians_with_another_mark_are_projected_anew(tmp_path):
    scene, camera = small_scene(tmp_path, True), random_camera(1)
    channels = ArrayChannels(load_rasterizer("cpu"))
    first = channels.render(scene, Layers(), camera, "none").alpha
    second = channels.render(replace(scene, antialiased=False), Layers(), camera, "none").alpha
    assert np.abs(first - second).max() > 0.05


class Recorder:
    """The CPU rasterizer, which notes the settings it is given."""

    def __init__(self) -> None:
        self.seen: list = []

    def view(self, gaussians, camera, settings=INRIA):
        self.seen.append(settings)
        return load_rasterizer("cpu").view(gaussians, camera, settings)


@pytest.mark.parametrize("antialiased", [False, True])
def test_queries_and_evaluation_draw_as_the_file_says(tmp_path, monkeypatch, antialiased):
    scene = Scene(blobs(), fake_language(phrasebook=True), fake_cameras(1), None, antialiased)
    save_scene(tmp_path / "a.ply", scene)
    recorder = Recorder()
    monkeypatch.setattr(query, "load_rasterizer", lambda _: recorder)
    QueryScene(tmp_path / "a.ply", ("book",)).run()
    truth = SimpleNamespace(phrases=(), labels=lambda name: np.zeros((3, 120, 160), int))
    evaluate(ask(QueryEngine(load_scene(tmp_path / "a.ply")), ()), recorder, scene.cameras, truth)
    assert [settings.antialiased for settings in recorder.seen] == [antialiased] * 2


# ---- conversion ----


def test_rematch_keeps_cameras_mark_and_extras(tmp_path):
    whole = Scene(
        random_gaussians(N), random_field(N), (random_camera(), random_camera(1)), None, True, random_extras()
    )
    save_scene(tmp_path / "whole.ply", whole)
    save_scene(tmp_path / "edited.ply", replace(whole.take(np.arange(5, N)), language=None))
    old = companion_path(tmp_path / "whole.ply", language.SUFFIX)
    # a sidecar that does not fit lies beside the edited file, as an editor that saves in place leaves it
    companion_path(tmp_path / "edited.ply", language.SUFFIX).write_bytes(old.read_bytes())
    Convert(tmp_path / "edited.ply", tmp_path / "new.ply", rematch=old).run()
    got = load_scene(tmp_path / "new.ply")
    assert len(got.cameras) == 2
    np.testing.assert_allclose(got.cameras[1].world_to_camera, whole.cameras[1].world_to_camera, atol=1e-12)
    assert got.antialiased
    assert_same_extras(got.extras, {name: values[5:] for name, values in whole.extras.items()})
    assert got.language is not None
    np.testing.assert_array_equal(got.language.latents, whole.language.latents[:, 5:])


# ---- memory ----


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

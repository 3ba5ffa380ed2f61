"""For other programs: glTF with KHR_gaussian_splatting, written, placed by nodes, packed as .spz and hostile;
point clouds and meshes."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from plyfile import PlyData

from langsplat_core.arrays import sigmoid, unit
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.gltf import EXTENSION, PACKED, write_gltf
from langsplat_core.io.scenes import load_gaussians
from langsplat_core.io.shapes import gltf_axes, write_mesh, write_points
from langsplat_core.io.spz import write_spz
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import moving, rotating, scaling, transform_gaussians
from tests.support.comparing import assert_refused
from tests.support.scenes import covariances, random_gaussians

HALF_TURN = rotating(np.array([0, 0, 1]), 180)  # between the axes of glTF and those of the PLY


def parts(data: bytes) -> tuple[dict, bytes]:
    """JSON and binary chunk of a .glb."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def glb(content: dict, binary: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    header = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    return header + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def written(path: Path, scene: Gaussians, change: Callable[[dict], object] = lambda content: None) -> Path:
    """`scene` as a .glb whose JSON is changed in place."""
    write_gltf(path, scene)
    content, binary = parts(path.read_bytes())
    change(content)
    path.write_bytes(glb(content, binary))
    return path


def assert_alike(got: Gaussians, want: Gaussians, places: float = 1e-5) -> None:
    np.testing.assert_allclose(got.means, want.means, atol=places)
    np.testing.assert_allclose(got.log_scales, want.log_scales, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(got.sh, want.sh, atol=1e-5)
    np.testing.assert_allclose(sigmoid(got.opacity_logits), sigmoid(want.opacity_logits), atol=1e-6)
    one, other = (unit(rows.quats_wxyz.astype(np.float64)) for rows in (got, want))
    assert (np.abs((one * other).sum(1)) > 1 - 1e-9).all()


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("degree", range(4))
def test_scenes_are_read_back_in_their_order(tmp_path, degree, suffix):
    scene = random_gaussians(200, sh_degree=degree)
    write_gltf(tmp_path / f"a{suffix}", scene)
    got = load_gaussians(tmp_path / f"a{suffix}")
    assert_alike(got, scene)
    np.testing.assert_array_equal(got.means, scene.means)  # sidecars know them to the bit
    np.testing.assert_array_equal(got.sh, scene.sh)


def test_written_axes_are_those_of_the_standard(tmp_path):
    """The file itself, read by its own words, is the scene half a turn about z further."""
    scene = random_gaussians(50, sh_degree=3)
    write_gltf(tmp_path / "a.glb", scene)
    content, binary = parts((tmp_path / "a.glb").read_bytes())

    def column(name: str) -> np.ndarray:
        about = content["accessors"][splats(content)["attributes"][name]]
        view = content["bufferViews"][about["bufferView"]]
        data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(data, "<f4").reshape(50, -1)

    want = transform_gaussians(scene, HALF_TURN)
    np.testing.assert_allclose(column("POSITION"), want.means, atol=1e-6)
    np.testing.assert_allclose(column(f"{EXTENSION}:SCALE"), np.exp(want.log_scales), rtol=1e-5)
    for number, degree, coefficient in ((0, 0, 0), (1, 1, 0), (8, 2, 4), (9, 3, 0), (15, 3, 6)):
        found = column(f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{coefficient}")
        np.testing.assert_allclose(found, want.sh[:, number], atol=1e-5)
    # the shapes, of which quaternions are one way to say them
    made = replace(want, quats_wxyz=column(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]])
    np.testing.assert_allclose(covariances(made), covariances(want), atol=1e-5 * covariances(want).max())


def test_rows_that_cannot_be_drawn_are_transparent(tmp_path):
    scene = random_gaussians(8, sh_degree=1)
    scene.means[0], scene.means[1], scene.log_scales[2, 0] = np.nan, 1e30, -np.inf
    scene.quats_wxyz[3:5] *= [[0], [-7]]
    scene.opacity_logits[5:7] = np.inf, -np.inf
    write_gltf(tmp_path / "a.glb", scene)
    got = load_gaussians(tmp_path / "a.glb")
    assert got.valid().all()
    assert (sigmoid(got.opacity_logits)[[0, 3, 6]] == 0).all()
    assert got.opacity_logits[5] == np.inf
    assert got.log_scales[2, 0] == -np.inf
    assert got.means[1, 0] == np.float32(1e30)
    for count in (0, 1):
        write_gltf(tmp_path / "b.glb", scene.take(np.arange(count)))
        assert len(load_gaussians(tmp_path / "b.glb")) == count


def test_nodes_place_their_primitives(tmp_path):
    scene = random_gaussians(40, sh_degree=3)
    turn = rotating(np.array([1.0, 2, 3]), 70)

    def place(content: dict) -> None:
        half = np.radians(35)
        x, y, z = np.sin(half) * np.array([1, 2, 3]) / np.sqrt(14)
        content["nodes"] = [
            {"mesh": 0, "rotation": [x, y, z, np.cos(half)], "scale": [2, 2, 2]},
            {"children": [0], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
        ]
        content["scenes"] = [{"nodes": [1]}]

    there = scaling(2).then(turn).then(moving(np.array([5.0, 6, 7])))
    want = transform_gaussians(scene, HALF_TURN.then(there).then(HALF_TURN))
    assert_alike(load_gaussians(written(tmp_path / "a.glb", scene, place)), want, 1e-4)


def one_mesh(attributes: dict[str, int], extension: dict, size: int, **buffer: str) -> dict:
    """The JSON of a file of one primitive, its numbers in a buffer of `size` bytes; without its columns."""
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: extension}}
    return {
        "asset": {"version": "2.0"},
        "bufferViews": [{"buffer": 0, "byteLength": size}],
        "buffers": [{"byteLength": size, **buffer}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
    }


@pytest.mark.parametrize("name", PACKED)
def test_an_spz_inside_is_read(tmp_path, name):
    scene = random_gaussians(60, sh_degree=2)
    write_spz(tmp_path / "a.spz", scene)
    data = (tmp_path / "a.spz").read_bytes()
    inside = {"extensions": {name: {"bufferView": 0}}}
    content = one_mesh({"POSITION": 0}, inside, len(data)) | {
        "extensionsRequired": [EXTENSION, name],
        "accessors": [{"count": 60, "type": "VEC3", "componentType": 5126}],
    }
    (tmp_path / "a.glb").write_bytes(glb(content, data))
    assert_alike(load_gaussians(tmp_path / "a.glb"), load_gaussians(tmp_path / "a.spz"))
    content["nodes"] = [{"mesh": 0}] * 3
    (tmp_path / "a.glb").write_bytes(glb(content, data))
    with pytest.raises(FormatError, match="more Gaussians than"):
        load_gaussians(tmp_path / "a.glb")


def test_quantised_and_interleaved_columns_are_read(tmp_path):
    rows = np.zeros(3, [("p", "<f4", 3), ("q", "i1", 4), ("s", "i1", 4), ("o", "u1", 4)])
    rows["p"], rows["q"], rows["s"][:, :3], rows["o"][:, 0] = 1, [0, 0, 0, -127], [0, 1, 2], [0, 51, 255]
    offsets = {"POSITION": (0, 5126, "VEC3"), "ROTATION": (12, 5120, "VEC4"), "SCALE": (16, 5120, "VEC3")}
    offsets |= {"OPACITY": (20, 5121, "SCALAR"), "SH_DEGREE_0_COEF_0": (0, 5126, "VEC3")}
    names = [name if name == "POSITION" else f"{EXTENSION}:{name}" for name in offsets]
    content = one_mesh({name: i for i, name in enumerate(names)}, {}, 72, uri="b%20c.bin")
    content["bufferViews"][0]["byteStride"] = 24
    content["accessors"] = [
        {"bufferView": 0, "byteOffset": at, "componentType": kind, "type": shape, "count": 3}
        | {"normalized": name in ("ROTATION", "OPACITY")}
        for name, (at, kind, shape) in offsets.items()
    ]
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    (tmp_path / "b c.bin").write_bytes(rows.tobytes())
    got = load_gaussians(tmp_path / "a.gltf")
    np.testing.assert_allclose(np.exp(got.log_scales), [[0, 1, 2]] * 3)
    np.testing.assert_allclose(sigmoid(got.opacity_logits), [0, 0.2, 1], atol=1e-6)
    np.testing.assert_array_equal(np.abs(got.quats_wxyz), [[1, 0, 0, 0]] * 3)
    rows["s"][1] = -3  # of a draft of the extension: logarithms
    (tmp_path / "b c.bin").write_bytes(rows.tobytes())
    np.testing.assert_array_equal(load_gaussians(tmp_path / "a.gltf").log_scales[1], [-3, -3, -3])


def splats(content: dict) -> dict:
    """The one primitive of a file."""
    return content["meshes"][0]["primitives"][0]


MALFORMED = {
    "a path": lambda c: c["buffers"][0].update(uri="../../etc/passwd"),
    "beyond its buffer": lambda c: c["bufferViews"][0].update(byteOffset=2**30),
    "many rows": lambda c: [one.update(count=2**31) for one in c["accessors"]],
    "one count alone": lambda c: c["accessors"][2].update(count=9),
    "a sparse column": lambda c: c["accessors"][0].update(sparse={"count": 1}),
    "no buffer": lambda c: c["accessors"][0].pop("bufferView"),
    "a circle": lambda c: c["nodes"][0].update(children=[0]),
    "many instances": lambda c: c.update(nodes=[{"mesh": 0}] * 999, scenes=[{"nodes": list(range(999))}]),
    "a mirror": lambda c: c["nodes"][0].update(scale=[-1, 1, 1]),
    "an axis of its own": lambda c: c["nodes"][0].update(scale=[1, 2, 1]),
    "no numbers": lambda c: c["nodes"][0].update(translation=["a", 1, 1]),
    "huge numbers": lambda c: c["nodes"][0].update(translation=[10**400, 1, 1]),
    "meshopt": lambda c: c.update(extensionsRequired=["EXT_meshopt_compression"]),
    "triangles": lambda c: splats(c).update(mode=4),
    "linear colours": lambda c: splats(c)["extensions"][EXTENSION].update(colorSpace="lin_rec709_display"),
    "half a degree": lambda c: splats(c)["attributes"].pop(f"{EXTENSION}:SH_DEGREE_1_COEF_1"),
    "negative index": lambda c: c["nodes"][0].update(mesh=-1),
    "another version": lambda c: c.update(asset={"version": "1.0"}),
    "no Gaussians": lambda c: c.update(nodes=[], scenes=[], extensionsUsed=[]),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_refused_in_a_line(tmp_path, name):
    path = written(tmp_path / "a.glb", random_gaussians(20, sh_degree=1), MALFORMED[name])
    assert_refused(load_gaussians, path)


def test_written_files_keep_the_rules(tmp_path):
    """Of glTF: aligned views in one buffer, bounds of positions; of the extension: all that it requires."""
    write_gltf(tmp_path / "a.glb", random_gaussians(7, sh_degree=1))
    data = (tmp_path / "a.glb").read_bytes()
    content, binary = parts(data)
    assert struct.unpack_from("<I", data, 8)[0] == len(data)
    assert content["buffers"][0]["byteLength"] == len(binary)
    assert all(view["byteOffset"] % 4 == 0 for view in content["bufferViews"])
    says, attributes = splats(content)["extensions"][EXTENSION], splats(content)["attributes"]
    assert says["kernel"] == "ellipse"
    assert says["colorSpace"] == "srgb_rec709_display"
    coefficients = ("0_COEF_0", *(f"1_COEF_{n}" for n in range(3)))
    names = {"ROTATION", "SCALE", "OPACITY", *(f"SH_DEGREE_{name}" for name in coefficients)}
    assert set(attributes) == {"POSITION", "COLOR_0", *(f"{EXTENSION}:{name}" for name in names)}
    positions = content["accessors"][attributes["POSITION"]]
    assert np.less(positions["min"], positions["max"]).all()


# Point clouds and meshes, read back by other programs.

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
SHADES = np.array([[1.0, 0, 0], [0, 0.5, 0], [0, 0, 0], [0, 1, 0]])
MESH = SimpleNamespace(name="red mug", vertices=TETRAHEDRON, triangles=FACES, colour=SHADES)


def test_points_have_colours_and_extras(tmp_path):
    gaussians = random_gaussians(40, sh_degree=1)
    gaussians.means[7] = np.nan
    gaussians.sh[8, 0] = 9, -9, 0
    relevancy = np.linspace(0, 1, 40)
    assert write_points(tmp_path / "a.ply", gaussians, {"relevancy": relevancy}) == 39
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    kept = np.delete(np.arange(40), 7)
    np.testing.assert_array_equal(np.stack([vertex[k] for k in "xyz"], 1), gaussians.means[kept])
    colours = np.stack([vertex[name] for name in ("red", "green", "blue")], 1)
    want = np.clip(0.5 + 0.28209479177 * gaussians.sh[kept, 0].astype(np.float64), 0, 1)
    assert np.abs(colours / 255 - want).max() <= 0.5 / 255 + 1e-9
    np.testing.assert_allclose(vertex["relevancy"], relevancy[kept], atol=1e-7)


def test_a_ply_holds_a_mesh(tmp_path):
    write_mesh(tmp_path / "a.ply", MESH, np.eye(4))
    data = PlyData.read(tmp_path / "a.ply")
    np.testing.assert_array_equal(np.stack([data["vertex"][k] for k in "xyz"], 1), TETRAHEDRON)
    np.testing.assert_array_equal(np.stack(data["face"]["vertex_indices"]), FACES)
    assert data["vertex"]["red"].tolist() == [255, 0, 0, 0]


def test_a_glb_mesh_has_linear_colours_and_y_up(tmp_path):
    scene = Scene(random_gaussians(3), metres_per_unit=2.0)
    write_mesh(tmp_path / "a.glb", MESH, gltf_axes(scene))
    content, binary = parts((tmp_path / "a.glb").read_bytes())
    assert content["buffers"][0]["byteLength"] == len(binary)
    np.testing.assert_array_equal(np.frombuffer(binary[:48], "<f4").reshape(4, 3), TETRAHEDRON)
    colours = np.frombuffer(binary[48:80], "<u2").reshape(4, 4) / 65_535
    np.testing.assert_allclose(colours[:, :3].sum(1), [1, 0.2140, 0, 1], atol=1e-4)
    matrix = np.array(content["nodes"][0]["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix @ [*scene.up(), 1], [0, 2, 0, 1], atol=1e-6)  # up, metres


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(InputError):
        write_points(tmp_path / "a.obj", random_gaussians(3))
    with pytest.raises(InputError):
        write_mesh(tmp_path / "a.stl", MESH, np.eye(4))
    assert list(tmp_path.iterdir()) == []

"""glTF with KHR_gaussian_splatting: what is written, placed by nodes, packed as .spz; and hostile files."""

import json
import shutil
import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import sigmoid, unit
from langsplat_core.errors import FormatError
from langsplat_core.io.gltf import EXTENSION, PACKED, write_gltf
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import load_gaussians
from langsplat_core.io.spz import write_spz
from langsplat_core.scene import Gaussians
from langsplat_core.scene.transform import moving, rotating, scaling, transform_gaussians
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


def changed(path, change) -> None:
    """Rewrite a .glb with its JSON changed in place."""
    content, binary = parts(path.read_bytes())
    change(content)
    path.write_bytes(glb(content, binary))


def assert_alike(got: Gaussians, want: Gaussians, places: float = 1e-5) -> None:
    np.testing.assert_allclose(got.means, want.means, atol=places)
    np.testing.assert_allclose(got.log_scales, want.log_scales, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(got.sh, want.sh, atol=1e-5)
    np.testing.assert_allclose(sigmoid(got.opacity_logits), sigmoid(want.opacity_logits), atol=1e-6)
    one, other = (unit(rows.quats_wxyz.astype(np.float64)) for rows in (got, want))
    assert (np.abs((one * other).sum(1)) > 1 - 1e-9).all()


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("degree", range(4))
def test_rows_come_back_in_their_order(tmp_path, degree, suffix):
    scene = random_gaussians(200, sh_degree=degree)
    write_gltf(tmp_path / f"a{suffix}", scene)
    got = load_gaussians(tmp_path / f"a{suffix}")
    assert_alike(got, scene)
    np.testing.assert_array_equal(got.means, scene.means)  # sidecars know them to the bit
    np.testing.assert_array_equal(got.sh, scene.sh)


def test_axes_are_those_of_the_standard(tmp_path):
    """The file itself, read by its own words, is the scene half a turn about z further."""
    scene = random_gaussians(50, sh_degree=3)
    write_gltf(tmp_path / "a.glb", scene)
    content, binary = parts((tmp_path / "a.glb").read_bytes())
    attributes = content["meshes"][0]["primitives"][0]["attributes"]

    def column(name: str) -> np.ndarray:
        about = content["accessors"][attributes[name]]
        view = content["bufferViews"][about["bufferView"]]
        data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(data, "<f4").reshape(50, -1)

    want = transform_gaussians(scene, HALF_TURN)
    np.testing.assert_allclose(column("POSITION"), want.means, atol=1e-6)
    np.testing.assert_allclose(column(f"{EXTENSION}:SCALE"), np.exp(want.log_scales), rtol=1e-5)
    for number, name in (
        (0, "0_COEF_0"),
        (1, "1_COEF_0"),
        (8, "2_COEF_4"),
        (9, "3_COEF_0"),
        (15, "3_COEF_6"),
    ):
        np.testing.assert_allclose(column(f"{EXTENSION}:SH_DEGREE_{name}"), want.sh[:, number], atol=1e-5)
    # the shapes, of which quaternions are one way to say them
    made = replace(want, quats_wxyz=column(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]])
    np.testing.assert_allclose(covariances(made), covariances(want), atol=1e-5 * covariances(want).max())


def test_hard_rows_are_written(tmp_path):
    scene = random_gaussians(8, sh_degree=1)
    means, scales, quats = scene.means.copy(), scene.log_scales.copy(), scene.quats_wxyz.copy()
    means[0], means[1], scales[2, 0], quats[3], quats[4] = np.nan, 1e30, -np.inf, 0, quats[4] * -7
    logits = scene.opacity_logits.copy()
    logits[5], logits[6] = np.inf, -np.inf
    write_gltf(
        tmp_path / "a.glb",
        replace(scene, means=means, log_scales=scales, quats_wxyz=quats, opacity_logits=logits),
    )
    got = load_gaussians(tmp_path / "a.glb")
    assert got.valid().all()
    assert (sigmoid(got.opacity_logits)[[0, 3, 6]] == 0).all()
    assert got.opacity_logits[5] == np.inf
    assert got.log_scales[2, 0] == -np.inf
    assert got.means[1, 0] == np.float32(1e30)
    for count in (0, 1):
        write_gltf(tmp_path / "b.glb", scene.take(np.arange(count)))
        assert len(load_gaussians(tmp_path / "b.glb")) == count


def test_nodes_place_what_they_hold(tmp_path):
    scene = random_gaussians(40, sh_degree=3)
    write_gltf(tmp_path / "a.glb", scene)
    turn = rotating(np.array([1.0, 2, 3]), 70)

    def place(content: dict) -> None:
        half = np.radians(35)
        x, y, z = np.sin(half) * np.array([1, 2, 3]) / np.sqrt(14)
        content["nodes"] = [
            {"mesh": 0, "rotation": [x, y, z, np.cos(half)], "scale": [2, 2, 2]},
            {"children": [0], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
        ]
        content["scenes"] = [{"nodes": [1]}]

    changed(tmp_path / "a.glb", place)
    there = scaling(2).then(turn).then(moving(np.array([5.0, 6, 7])))
    want = transform_gaussians(scene, HALF_TURN.then(there).then(HALF_TURN))
    assert_alike(load_gaussians(tmp_path / "a.glb"), want, 1e-4)


@pytest.mark.parametrize("name", PACKED)
def test_an_spz_inside_is_read(tmp_path, name):
    scene = random_gaussians(60, sh_degree=2)
    write_spz(tmp_path / "a.spz", scene)
    data = (tmp_path / "a.spz").read_bytes()
    inside = {"extensions": {name: {"bufferView": 0}}}
    primitive = {"attributes": {"POSITION": 0}, "mode": 0, "extensions": {EXTENSION: inside}}
    content = {
        "asset": {"version": "2.0"},
        "extensionsRequired": [EXTENSION, name],
        "accessors": [{"count": 60, "type": "VEC3", "componentType": 5126}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data)}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
    }
    (tmp_path / "a.glb").write_bytes(glb(content, data))
    assert_alike(load_gaussians(tmp_path / "a.glb"), load_gaussians(tmp_path / "a.spz"))
    content["nodes"] = [{"mesh": 0}] * 3
    (tmp_path / "a.glb").write_bytes(glb(content, data))
    with pytest.raises(FormatError, match="more Gaussians than"):
        load_gaussians(tmp_path / "a.glb")


def test_quantised_and_interleaved_columns(tmp_path):
    rows = np.zeros(3, [("p", "<f4", 3), ("q", "i1", 4), ("s", "i1", 4), ("o", "u1", 4)])
    rows["p"], rows["q"], rows["s"][:, :3], rows["o"][:, 0] = 1, [0, 0, 0, -127], [0, 1, 2], [0, 51, 255]
    offsets = {"POSITION": (0, 5126, "VEC3"), "ROTATION": (12, 5120, "VEC4"), "SCALE": (16, 5120, "VEC3")}
    offsets |= {"OPACITY": (20, 5121, "SCALAR"), "SH_DEGREE_0_COEF_0": (0, 5126, "VEC3")}
    names = [name if name == "POSITION" else f"{EXTENSION}:{name}" for name in offsets]
    content = {
        "asset": {"version": "2.0"},
        "accessors": [
            {"bufferView": 0, "byteOffset": at, "componentType": kind, "type": shape, "count": 3}
            | {"normalized": name in ("ROTATION", "OPACITY")}
            for name, (at, kind, shape) in offsets.items()
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 72, "byteStride": 24}],
        "buffers": [{"byteLength": 72, "uri": "b%20c.bin"}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": {n: i for i, n in enumerate(names)}}]}],
        "nodes": [{"mesh": 0}],
    }
    content["meshes"][0]["primitives"][0]["extensions"] = {EXTENSION: {}}
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    (tmp_path / "b c.bin").write_bytes(rows.tobytes())
    got = load_gaussians(tmp_path / "a.gltf")
    np.testing.assert_allclose(np.exp(got.log_scales), [[0, 1, 2]] * 3)
    np.testing.assert_allclose(sigmoid(got.opacity_logits), [0, 0.2, 1], atol=1e-6)
    np.testing.assert_array_equal(np.abs(got.quats_wxyz), [[1, 0, 0, 0]] * 3)
    rows["s"][1] = -3  # of a draft of the extension: logarithms
    (tmp_path / "b c.bin").write_bytes(rows.tobytes())
    np.testing.assert_array_equal(load_gaussians(tmp_path / "a.gltf").log_scales[1], [-3, -3, -3])


HOSTILE = {
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
    "triangles": lambda c: c["meshes"][0]["primitives"][0].update(mode=4),
    "linear colours": lambda c: c["meshes"][0]["primitives"][0]["extensions"][EXTENSION].update(
        colorSpace="lin_rec709_display"
    ),
    "half a degree": lambda c: c["meshes"][0]["primitives"][0]["attributes"].pop(
        f"{EXTENSION}:SH_DEGREE_1_COEF_1"
    ),
    "negative index": lambda c: c["nodes"][0].update(mesh=-1),
    "another version": lambda c: c.update(asset={"version": "1.0"}),
    "no Gaussians": lambda c: c.update(nodes=[], scenes=[], extensionsUsed=[]),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_breaks_a_rule_is_refused_in_one_line(tmp_path, name):
    write_gltf(tmp_path / "a.glb", random_gaussians(20, sh_degree=1))
    changed(tmp_path / "a.glb", HOSTILE[name])
    with pytest.raises(FormatError) as error:
        load_gaussians(tmp_path / "a.glb")
    assert "\n" not in str(error.value)


def test_what_is_written_keeps_the_rules(tmp_path):
    """Of glTF: aligned views in one buffer, bounds of positions; of the extension: all that it requires."""
    write_gltf(tmp_path / "a.glb", random_gaussians(7, sh_degree=1))
    data = (tmp_path / "a.glb").read_bytes()
    content, binary = parts(data)
    assert struct.unpack_from("<I", data, 8)[0] == len(data)
    assert content["buffers"][0]["byteLength"] == len(binary)
    assert all(view["byteOffset"] % 4 == 0 for view in content["bufferViews"])
    primitive = content["meshes"][0]["primitives"][0]
    says = primitive["extensions"][EXTENSION]
    assert says["kernel"] == "ellipse"
    assert says["colorSpace"] == "srgb_rec709_display"
    names = {
        "ROTATION",
        "SCALE",
        "OPACITY",
        *(f"SH_DEGREE_1_COEF_{n}" for n in range(3)),
        "SH_DEGREE_0_COEF_0",
    }
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0", *(f"{EXTENSION}:{name}" for name in names)}
    positions = content["accessors"][primitive["attributes"]["POSITION"]]
    assert np.less(positions["min"], positions["max"]).all()


def test_what_splat_transform_writes_is_read_alike(tmp_path):
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("splat-transform of @playcanvas is not installed")
    scene = random_gaussians(500, sh_degree=3)
    write_ply(tmp_path / "a.ply", scene)
    subprocess.run([program, "-w", "-q", tmp_path / "a.ply", tmp_path / "b.glb"], check=True, timeout=120)
    got = load_gaussians(tmp_path / "b.glb")
    np.testing.assert_allclose(got.means, scene.means, atol=1e-5)
    np.testing.assert_allclose(got.log_scales, scene.log_scales, atol=1e-5)
    np.testing.assert_allclose(got.sh, scene.sh, atol=1e-5)
    np.testing.assert_allclose(covariances(got), covariances(scene), rtol=1e-4, atol=1e-5)

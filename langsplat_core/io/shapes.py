"""Coloured points and meshes, which other programs open without knowing Gaussians."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.gltf import GltfWriter
from langsplat_core.io.ply import write_table
from langsplat_core.io.quantised import to_bytes
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import AXES, C0, scaling, turning

POINT_SUFFIXES = (".ply",)
MESH_SUFFIXES = (".ply", ".obj", ".glb")
RGB = ("red", "green", "blue")
UNLIT = "KHR_materials_unlit"


class MeshLike(Protocol):
    """Triangles with a name, and one colour or one a vertex."""

    @property
    def name(self) -> str: ...
    @property
    def vertices(self) -> Array:
        """(V, 3) positions, world units."""

    @property
    def triangles(self) -> Array:
        """(T, 3) numbers of vertices."""

    @property
    def colour(self) -> Array:
        """(3,) or (V, 3) display values in [0, 1]."""


def base_colours(gaussians: Gaussians) -> Array:
    """Return (N, 3) float64 display values in [0, 1]: of every Gaussian, the same from all sides."""
    colours = 0.5 + C0 * gaussians.sh[:, 0].astype(np.float64)
    return np.clip(np.nan_to_num(colours), 0, 1)


def write_points(path: Path | str, gaussians: Gaussians, extras: Mapping[str, Array] | None = None) -> int:
    """Write the means of the Gaussians that can be drawn as a PLY point cloud, atomically.

    Red, green and blue are bytes, each of `extras`, name -> (N,), a float. Return the number of points.
    InputError for another suffix.
    """
    path = check_suffix(path, POINT_SUFFIXES)
    extras = extras or {}
    valid = gaussians.valid()
    columns = dict(zip("xyz", gaussians.means[valid].T, strict=True))
    columns |= zip(RGB, to_bytes(255 * base_colours(gaussians)[valid]).T, strict=True)
    columns |= {name: values[valid].astype(np.float32) for name, values in extras.items()}
    write_table(path, columns)
    return int(valid.sum())


def write_meshes(path: Path | str, meshes: Sequence[MeshLike], to_gltf: Array | None = None) -> None:
    """Write all meshes in one .ply, or in one .obj or .glb with an object each, atomically.

    InputError for another suffix. to_gltf: (4, 4) from world units to metres with y up, as glTF has them;
    nothing else is moved.
    """
    path = check_suffix(path, MESH_SUFFIXES)
    if path.suffix.lower() == ".obj":
        with atomic_path(path) as temporary:
            temporary.write_text(_obj(meshes), encoding="utf-8")
    elif path.suffix.lower() == ".glb":
        unlit = {"doubleSided": True, "extensions": {UNLIT: {}}}
        _gltf(meshes, np.eye(4) if to_gltf is None else to_gltf).write(path, materials=[unlit])
    else:
        write_table(path, *_joined(meshes))


def gltf_axes(scene: Scene) -> Array:
    """Return (4, 4) from world units to the axes of glTF: y up, in metres where the scale is known."""
    return turning(scene.up(), AXES["y"]).then(scaling(scene.metres_per_unit or 1.0)).matrix


def check_suffix(path: Path | str, suffixes: Sequence[str]) -> Path:
    """Return `path`; InputError unless it ends in one of `suffixes`."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(
            f"{path}: what is asked for is written as {' or '.join(suffixes)}; choose such a name"
        )
    return path


def _obj(meshes: Sequence[MeshLike]) -> str:
    lines, first = [], 1
    for mesh in meshes:
        lines.append(f"o {'_'.join(mesh.name.split())}")
        rows = np.column_stack([mesh.vertices, np.broadcast_to(mesh.colour, mesh.vertices.shape)])
        lines += [f"v {x:.9g} {y:.9g} {z:.9g} {r:.4f} {g:.4f} {b:.4f}" for x, y, z, r, g, b in rows.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.triangles + first]
        first += len(mesh.vertices)
    return "\n".join(lines) + "\n"


def _joined(meshes: Sequence[MeshLike]) -> tuple[dict[str, Array], Array]:
    """Columns of the vertices of all meshes, and (F, 3) numbers of them."""
    places = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
    colours = np.concatenate([np.broadcast_to(mesh.colour, mesh.vertices.shape) for mesh in meshes])
    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.triangles + first for mesh, first in zip(meshes, firsts, strict=True)]
    columns = dict(zip("xyz", places.T, strict=True)) | dict(zip(RGB, to_bytes(255 * colours).T, strict=True))
    return columns, np.concatenate(faces)


def _gltf(meshes: Sequence[MeshLike], to_gltf: Array) -> GltfWriter:
    """Colours are light as it was photographed, so the material is unlit, and linear."""
    file = GltfWriter(UNLIT)
    for mesh in meshes:
        display = np.broadcast_to(mesh.colour, mesh.vertices.shape)
        linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
        light = np.column_stack([linear, np.ones(len(linear))])
        attributes = {
            "POSITION": file.add(mesh.vertices.astype("<f4"), bounded=True),
            "COLOR_0": file.add(np.rint(65_535 * light).astype("<u2")),
        }
        corners = file.add(mesh.triangles.reshape(-1).astype("<u4"))
        primitive = {"attributes": attributes, "indices": corners, "material": 0}
        file.add_mesh(primitive, name=mesh.name, matrix=to_gltf.T.reshape(-1).tolist())
    return file

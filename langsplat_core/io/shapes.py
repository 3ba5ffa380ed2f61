"""Coloured points and meshes, which other programs open without knowing Gaussians."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array, linear_light
from langsplat_core.errors import InputError
from langsplat_core.io.gltf import GltfWriter
from langsplat_core.io.ply import CHANNELS, POSITION, write_table
from langsplat_core.io.quantised import to_bytes
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import AXES, C0, moving, scaling, turned_origin, turning

POINT_SUFFIXES = (".ply",)
MESH_SUFFIXES = (".ply", ".glb")


class MeshLike(Protocol):
    """Triangles with a name."""

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
        """(V, 3) display values in [0, 1]."""


def base_colours(gaussians: Gaussians) -> Array:
    """Return (N, 3) float64 display values in [0, 1]: of every Gaussian, the same from all sides."""
    colours = 0.5 + C0 * gaussians.sh[:, 0].astype(np.float64)
    return np.clip(np.nan_to_num(colours), 0, 1)


def write_points(path: Path | str, scene: Scene) -> int:
    """Write the means of the Gaussians that can be drawn, in the world, as a PLY point cloud, atomically.

    Red, green and blue are bytes. Return the number of points. InputError for another suffix.
    """
    path = check_suffix(path, POINT_SUFFIXES)
    gaussians, valid = scene.gaussians, scene.gaussians.valid()
    write_table(path, _coloured(scene, gaussians.means[valid], base_colours(gaussians)[valid]))
    return int(valid.sum())


def write_mesh(path: Path | str, mesh: MeshLike, scene: Scene) -> None:
    """Write a mesh of a scene, in the world, as .ply or .glb, atomically. InputError for another suffix.

    A .glb is y up, in metres where the scale is known.
    """
    path = check_suffix(path, MESH_SUFFIXES)
    if path.suffix.lower() == ".ply":
        write_table(path, _coloured(scene, mesh.vertices, mesh.colour), mesh.triangles)
        return
    # Colours are light as it was photographed, so the material is unlit, and linear.
    file = GltfWriter("KHR_materials_unlit")
    light = np.column_stack([linear_light(mesh.colour), np.ones(len(mesh.vertices))])
    attributes = {
        "POSITION": file.add(mesh.vertices.astype("<f4"), bounded=True),
        "COLOR_0": file.add(np.rint(65_535 * light).astype("<u2")),
    }
    corners = file.add(mesh.triangles.reshape(-1).astype("<u4"))
    primitive = {"attributes": attributes, "indices": corners, "material": 0}
    file.add_mesh(primitive, name=mesh.name, matrix=gltf_axes(scene).T.reshape(-1).tolist())
    file.write(path, materials=[{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}])


def gltf_axes(scene: Scene) -> Array:
    """Return (4, 4) from the scene to the axes of glTF: y up, in metres where the scale is known."""
    upright = turning(scene.up(), AXES["y"])
    place = moving(turned_origin(upright.rotation, scene.origin))
    return upright.then(place).then(scaling(scene.metres_per_unit or 1.0)).matrix


def check_suffix(path: Path | str, suffixes: Sequence[str]) -> Path:
    """Return `path`; InputError unless it ends in one of `suffixes`."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: this is written as {' or '.join(suffixes)}; choose such a name")
    return path


def _coloured(scene: Scene, places: Array, colours: Array) -> dict[str, Array]:
    """Columns of a PLY; places are float64 where the scene lies far away."""
    places = scene.in_world(places) if scene.origin.any() else places.astype(np.float32)
    columns = dict(zip(POSITION, places.T, strict=True))
    return columns | dict(zip(CHANNELS, to_bytes(255 * colours).T, strict=True))

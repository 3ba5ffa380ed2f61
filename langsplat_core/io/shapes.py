"""Coloured points and meshes, which other programs open without knowing Gaussians."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.ply import SH_C0
from langsplat_core.scene import Gaussians

POINT_SUFFIXES = (".ply",)
MESH_SUFFIXES = (".ply", ".obj")
RGB = ("red", "green", "blue")


class Mesh(Protocol):
    """Triangles with a name and one colour."""

    @property
    def name(self) -> str: ...
    @property
    def vertices(self) -> Array:
        """(V, 3) world units."""

    @property
    def triangles(self) -> Array:
        """(T, 3) numbers of vertices."""

    @property
    def colour(self) -> Array:
        """(3,) display values in [0, 1]."""


def base_colours(gaussians: Gaussians) -> Array:
    """(N, 3) float64 display values in [0, 1]: of every Gaussian, the same from all sides."""
    colours = 0.5 + SH_C0 * gaussians.sh[:, 0].astype(np.float64)
    return np.clip(np.nan_to_num(colours), 0, 1)


def write_points(path: Path | str, gaussians: Gaussians, extras: Mapping[str, Array] | None = None) -> int:
    """The means of the Gaussians that can be drawn as a PLY point cloud: red, green and blue as bytes, each
    of `extras`, name -> (N,), as a float. How many points. Atomic; InputError for another suffix."""
    from plyfile import PlyData, PlyElement

    path = check_suffix(path, POINT_SUFFIXES)
    extras = extras or {}
    valid = gaussians.valid()
    columns = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in RGB]
    table = np.empty(int(valid.sum()), [*columns, *((name, "<f4") for name in extras)])
    for k, axis in enumerate("xyz"):
        table[axis] = gaussians.means[valid, k]
    for name, values in zip(RGB, _bytes(base_colours(gaussians)[valid]).T, strict=True):
        table[name] = values
    for name, values in extras.items():
        table[name] = values[valid]
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(table, "vertex")]).write(str(temporary))
    return len(table)


def write_meshes(path: Path | str, meshes: Sequence[Mesh]) -> None:
    """All of them in one .ply, or in one .obj with an object each. Atomic; InputError for another suffix."""
    path = check_suffix(path, MESH_SUFFIXES)
    with atomic_path(path) as temporary:
        if path.suffix.lower() == ".obj":
            temporary.write_text(_obj(meshes), encoding="utf-8")
        else:
            _write_mesh_ply(temporary, meshes)


def check_suffix(path: Path | str, suffixes: Sequence[str]) -> Path:
    """`path`; InputError unless it ends in one of `suffixes`."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(
            f"{path}: what is asked for is written as {' or '.join(suffixes)}; choose such a name"
        )
    return path


def _obj(meshes: Sequence[Mesh]) -> str:
    lines, first = [], 1
    for mesh in meshes:
        lines.append(f"o {'_'.join(mesh.name.split())}")
        colour = " ".join(f"{value:.4f}" for value in mesh.colour)
        lines += [f"v {x:.9g} {y:.9g} {z:.9g} {colour}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.triangles + first]
        first += len(mesh.vertices)
    return "\n".join(lines) + "\n"


def _write_mesh_ply(path: Path, meshes: Sequence[Mesh]) -> None:
    from plyfile import PlyData, PlyElement

    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertex = np.empty(firsts[-1], [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in RGB])
    places = np.concatenate([mesh.vertices for mesh in meshes])
    colours = np.concatenate([np.tile(_bytes(mesh.colour), (len(mesh.vertices), 1)) for mesh in meshes])
    for names, values in (("xyz", places), (RGB, colours)):
        for k, name in enumerate(names):
            vertex[name] = values[:, k]
    triangles = [mesh.triangles + first for mesh, first in zip(meshes, firsts, strict=False)]
    face = np.empty(sum(map(len, triangles)), [("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = np.concatenate(triangles)
    elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]
    PlyData(elements).write(str(path))


def _bytes(colours: Array) -> Array:
    """Display values in [0, 1] -> uint8."""
    rounded: Array = np.rint(255 * colours).astype(np.uint8)
    return rounded

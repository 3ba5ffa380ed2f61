"""The convex hull of an instance, as a closed mesh."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.query.instances import Instance
from langsplat_core.scene import Gaussians

FEW = 8  # Gaussians in the box: of so few none is a stray
THICKNESS = 1e-3  # of the longest side: what is flatter than this is given it, since a hull needs a volume


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles that close around something."""

    name: str
    vertices: Array  # (V, 3) float64 world units
    triangles: Array  # (T, 3) int32 numbers of vertices, counter-clockwise seen from outside
    colour: Array  # (3,) display values in [0, 1], of the whole


def hulls(things: Sequence[Instance], gaussians: Gaussians, colours: Array, name: str) -> tuple[Mesh, ...]:
    """One around each, named `name` and its number from 1 on. Arguments and errors as of `hull`."""
    return tuple(hull(thing, gaussians, colours, f"{name} {k}") for k, thing in enumerate(things, 1))


def hull(instance: Instance, gaussians: Gaussians, colours: Array, name: str) -> Mesh:
    """Around the instance's Gaussians that lie in its oriented box: strays would stretch it.

    colours: (N, 3) of the scene's Gaussians, in [0, 1]; the mesh has the mean of its own. Raises InputError
    where all lie at one point.
    """
    box, rows = instance.oriented, instance.members
    means = gaussians.means[rows].astype(np.float64)
    inside = box.contains(means)
    if inside.sum() < FEW:
        inside[:] = True
    own = (means[inside] - box.centre) @ box.axes
    longest = 2 * float(box.half_extents[0])
    if longest <= 0:
        raise InputError(f"{name} is a single point, which has no hull; write it with --as points")
    flat = 2 * box.half_extents < THICKNESS * longest
    if flat.any():  # both sides of a sheet, all four of a line
        for axis in np.flatnonzero(flat):
            offset = np.eye(3)[axis] * THICKNESS * longest / 2
            own = np.concatenate([own - offset, own + offset])
    try:
        found = ConvexHull(own)
    except QhullError:
        raise InputError(f"{name} has too few points for a hull; write it with --as points") from None
    number = np.full(len(own), -1, np.int32)
    number[found.vertices] = np.arange(len(found.vertices))
    vertices = own[found.vertices]
    triangles = _outward(vertices, number[found.simplices], found.equations[:, :3])
    return Mesh(name, box.centre + vertices @ box.axes.T, triangles, colours[rows[inside]].mean(0))


def _outward(vertices: Array, triangles: Array, normals: Array) -> Array:
    """The triangles, turned where they run against their outward `normals` (T, 3)."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * normals).sum(1) < 0
    turned: Array = np.where(inward[:, None], triangles[:, [0, 2, 1]], triangles)
    return turned

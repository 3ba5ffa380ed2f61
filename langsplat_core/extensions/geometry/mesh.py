"""Meshes of a scene: rendered depth and colour, fused in a truncated signed distance field (Open3D).

The depth of a pixel is that at which the median Gaussian, where the transmittance falls to 0.5, is densest
along the ray. The depth of its centre, which `View.median_depth` returns, is wrong for a large Gaussian that
is seen at an angle.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, linear_light, rotation_matrices, unit
from langsplat_core.errors import InputError
from langsplat_core.extensions.geometry.registration import cloud, some_cameras
from langsplat_core.io.gltf import SIGNS, GltfWriter, node_of
from langsplat_core.io.ply import CHANNELS, POSITION, write_table
from langsplat_core.io.quantised import to_bytes
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import Camera, Gaussians, Scene

SIDE, MOST = 640, 160  # pixels of the longer side of an image, and images, at most
FINEST = 100  # voxels per radius of the scene, unless pixels are larger
TRUNCATION = 4  # voxels behind and in front of a surface
OVERSAMPLED = 8  # voxels per pixel, at most
SPECK = 128  # least triangles of a connected piece
FLATTEST = 1e-3  # least ratio of a Gaussian's shortest to its longest axis, for the depth where it is densest
DEVIATIONS = 3.0  # standard deviations from its centre within which a Gaussian has its surface
ROOM = 1.5  # extents of the cube in which holes are closed; a surface that leaves it stays open
BLOCK = 8  # voxels per side of a block
VIEWS = 48  # around a scene without cameras ...
ELEVATIONS = (-37.0, 64.0)  # ... in degrees above its horizon, so that a mesh has an underside
STAGE = "fusing depth images"
SUFFIXES = (".ply", ".glb")  # of mesh files

Depth = tuple[Camera, Array, Array]  # (H, W) float32 depth along z, 0 for none, and (H, W, 3) uint8 colours


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, counterclockwise as seen from outside, with a colour at each vertex."""

    vertices: Array  # (V, 3) float64 world units
    triangles: Array  # (T, 3) int64
    colour: Array  # (V, 3) float64 display values in [0, 1]

    def holes(self) -> int:
        """Return the number of holes: loops of edges with a triangle on one side only."""
        return int(_rims(self.triangles)[1].max(initial=-1)) + 1

    def hollows(self) -> int:
        """Return the number of pieces of negative volume, which are cavities of a watertight mesh."""
        a, b, c = self.vertices[self.triangles.T]
        volumes = np.bincount(self.pieces(), (np.cross(a, b) * c).sum(1))
        return int(np.count_nonzero(volumes < 0))

    def pieces(self) -> Array:
        """Return the (T,) number of the connected piece of each triangle."""
        piece = _pieces(self.triangles[:, [0, 1, 1, 2]].reshape(-1, 2), len(self.vertices))
        return np.asarray(piece[self.triangles[:, 0]])

    def areas(self) -> Array:
        """Return (T,) areas of the triangles, square world units."""
        a, b, c = self.vertices[self.triangles.T]
        return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def surface_depth(gaussians: Gaussians, camera: Camera, rows: Array) -> Array:
    """Return the (H, W) float32 depth at which the Gaussian of each pixel is densest along its ray.

    rows: (H, W) Gaussian of each pixel, -1 for none. The ray runs through the pixel's centre; depth is along
    z, world units, and 0 without a Gaussian or behind the camera.
    """
    found = np.flatnonzero(rows >= 0)
    chosen, place = np.unique(rows.reshape(-1)[found], return_inverse=True)
    ahead = camera.unproject(camera.pixel_centres().reshape(-1, 2)[found], 1.0)
    rays = (ahead - camera.position) @ camera.rotation.T  # of depth 1, in the camera's frame
    means = gaussians.means[chosen] @ camera.rotation.T + camera.world_to_camera[:3, 3]
    axes = camera.rotation @ rotation_matrices(gaussians.quats_wxyz[chosen].astype(np.float64))  # columns
    scales = np.exp(gaussians.log_scales[chosen].astype(np.float64))
    scales = np.maximum(scales, np.maximum(FLATTEST * scales.max(1, keepdims=True), 1e-12))
    whitening = (axes / scales[:, None]).swapaxes(1, 2)
    ray = np.einsum("nij,nj->ni", whitening[place], rays)
    centre = np.einsum("nij,nj->ni", whitening, means)[place]
    depth = (ray * centre).sum(1) / (ray * ray).sum(1)
    reach = DEVIATIONS * np.sqrt(np.square(axes[:, 2] * scales).sum(1))
    depth = np.clip(depth, (means[:, 2] - reach)[place], (means[:, 2] + reach)[place])
    image = np.zeros(rows.size, np.float32)
    image[found] = np.maximum(depth, 0)
    return image.reshape(rows.shape)


def fuse(
    scene: Scene,
    resolution: float | None = None,
    views: int = 2,
    cameras: tuple[Camera, ...] = (),
    progress: Progress = silent,
) -> tuple[Mesh, float]:
    """Return the surface of a scene, and the side of its voxels, world units.

    resolution: side of the voxels, by default 1 / `FINEST` of the scene's radius, but at least 1.5 pixels;
    views: least number of views of a surface, >= 1: more leave more holes and fewer errors; cameras: to
    render, by default the scene's own, or generated ones. Raises InputError if nothing is visible.
    """
    import open3d  # before images are rendered, as it is optional

    every = cameras or scene.cameras or scene.spiral_cameras(VIEWS, (SIDE, SIDE * 3 // 4), ELEVATIONS)
    chosen, images, pixels = some_cameras(every, MOST, SIDE), [], []
    for number, each in enumerate(chosen):
        progress(STAGE, number / (2 * len(chosen)))
        images.append(_rendered(scene, each))
        camera, depth, _ = images[-1]
        pixels.append(depth[depth > 0] / camera.fx)
    if not any(map(len, pixels)):
        raise InputError("the cameras see no surface, opaque by half at least; nothing to mesh")
    pixel = float(np.median(np.concatenate(pixels)))
    if resolution is None:
        resolution = max(scene.bounds()[1] / FINEST, 1.5 * pixel)
    if resolution < pixel / OVERSAMPLED:
        least = f"take {pixel / OVERSAMPLED:.2g} or more"
        raise InputError(f"voxels of {resolution:g} units are finer than the images can tell; {least}")
    return _cleaned(_fused(open3d, images, scene.bounds()[0], resolution, views, progress)), resolution


def _rendered(scene: Scene, camera: Camera) -> Depth:
    view = CpuRasterizer().view(scene.gaussians, camera, scene.raster_settings())
    image = splat_colours(view, scene.gaussians)
    colours = np.clip(image.colours / np.maximum(image.alpha, 0.5)[..., None], 0, 1)
    depth = surface_depth(scene.gaussians, camera, view.median_rows())
    return camera, depth, np.rint(255 * colours).astype(np.uint8)


def _fused(
    o3d: Any, images: list[Depth], centre: Array, resolution: float, views: int, progress: Progress
) -> Mesh:
    """Return the mesh from a grid of voxels with its origin at `centre` (3,), which moves with the scene."""
    core, kinds = o3d.core, (o3d.core.float32, o3d.core.uint16, o3d.core.uint16)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), kinds, ((1), (1), (3)), resolution, BLOCK, 10_000
    )
    for number, (camera, depth, colours) in enumerate(images):
        progress(STAGE, 0.5 + number / (2 * len(images)))
        farthest = float(depth.max())
        if farthest == 0:
            continue
        inner = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
        pose = core.Tensor(inner), core.Tensor(camera.moved(-centre).world_to_camera)
        limits = 1.0, farthest * 1.001, float(TRUNCATION)
        image = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(depth[..., None])))
        blocks = grid.compute_unique_block_coordinates(image, *pose, *limits)
        light = o3d.t.geometry.Image(core.Tensor((colours / 255).astype(np.float32)))  # Open3D takes no bytes
        grid.integrate(blocks, image, light, *pose, *limits)
    progress(STAGE, 1.0)
    mesh = _taken(grid.extract_triangle_mesh(views - 0.5).to_legacy())
    return replace(mesh, vertices=mesh.vertices + centre)


def _taken(mesh: Any) -> Mesh:
    """Return a legacy mesh of Open3D as arrays."""
    vertices, triangles, colours = (
        np.asarray(getattr(mesh, name)) for name in ("vertices", "triangles", "vertex_colors")
    )
    return Mesh(vertices, triangles.astype(np.int64), colours.clip(0, 1))


def _cleaned(mesh: Mesh) -> Mesh:
    """Return the mesh without pieces of fewer than `SPECK` triangles. InputError if nothing is left."""
    piece = mesh.pieces()
    kept = mesh.triangles[np.bincount(piece)[piece] >= SPECK]
    if len(kept) == 0:
        raise InputError("too few views show the same surface; take fewer --views, or a coarser --resolution")
    used, triangles = np.unique(kept, return_inverse=True)
    return Mesh(mesh.vertices[used], triangles.reshape(-1, 3), mesh.colour[used])


def _pieces(edges: Array, count: int) -> Array:
    """Return the (count,) number of the connected piece of each vertex, from (E, 2) edges."""
    links = coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1])


def _distinct(rows: Array) -> tuple[Array, Array]:
    """Return the distinct rows of (N, k) integers >= 0, sorted, and the (N,) index of each row in them."""
    kind = first = np.zeros(len(rows), np.int64)
    for column in rows.T:  # np.unique of single numbers is twenty times as fast as along an axis
        keys = kind * (column.max(initial=0) + 1) + column
        _, first, kind = np.unique(keys, return_index=True, return_inverse=True)
    return rows[first], kind


def _rims(triangles: Array) -> tuple[Array, Array]:
    """Return (R, 2) directed edges without a triangle on one side, and the (R,) number of their loop."""
    sides = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges, which = _distinct(np.sort(sides, axis=1))
    net = np.bincount(which, np.where(sides[:, 0] < sides[:, 1], 1, -1)).astype(int)
    rims = np.repeat(np.where(net[:, None] > 0, edges, edges[:, ::-1]), np.abs(net), axis=0)
    ends, at = np.unique(rims, return_inverse=True)
    at = at.reshape(-1, 2)
    return rims, np.unique(_pieces(at, len(ends))[at[:, 0]], return_inverse=True)[1]


def watertight(points: Array, triangles: Array, near: float) -> tuple[Array, Array]:
    """Return a surface of which every edge has two triangles, with opposite directions along it.

    points: (V, D) positions, with or without colours after them; near: distance at which points are merged.
    """
    cells = np.rint((points[:, :3] - points[:, :3].min(axis=0, initial=0)) / near).astype(np.int64)
    place = _distinct(cells)[1]
    points = points[np.unique(place, return_index=True)[1]]
    used, triangles = np.unique(_once(place[triangles]), return_inverse=True)
    points, triangles = _closed(points[used], triangles.reshape(-1, 3))
    # Triangles without an area get one: their last point is moved.
    a, b, c = points[triangles.T, :3]
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    sides = np.linalg.norm([b - a, c - a], axis=2)
    flat = triangles[areas < 1e-2 * near * sides.sum(0), 2]
    points[flat, :3] += near * np.random.default_rng(0).normal(size=(len(flat), 3))
    return _unpinched(points, triangles)


def _once(triangles: Array) -> Array:
    """Return triangles without those that have no area or their own reverse, and without repetitions."""
    turns = np.sign(triangles - np.roll(triangles, 1, axis=1)).prod(axis=1)  # 0: without an area
    faces, which = _distinct(np.sort(triangles, axis=1))
    net = np.bincount(which, -turns)
    return np.where(net[:, None] > 0, faces, faces[:, ::-1])[net != 0]


def _closed(points: Array, triangles: Array) -> tuple[Array, Array]:
    """Close every rim by a fan: every edge then has as many triangles in one direction as in the other."""
    rims, loops = _rims(triangles)
    middles = [points[rims[loops == loop, 0]].mean(0) for loop in range(loops.max(initial=-1) + 1)]
    fans = np.column_stack([rims[:, ::-1], len(points) + loops])
    points = np.concatenate([points, np.reshape(middles, (-1, points.shape[1]))])
    return points, np.concatenate([triangles, fans])


def _unpinched(points: Array, triangles: Array) -> tuple[Array, Array]:
    """Part the pairs of triangles, of opposite directions, at edges that have several.

    Each pair gets a vertex of its own near the edge's middle, and its triangles become fans.
    """
    start, end, third = (np.roll(triangles, -step, axis=1).reshape(-1) for step in range(3))
    edge = _distinct(np.sort(np.column_stack([start, end]), axis=1))[1]
    many = np.flatnonzero(np.bincount(edge)[edge] > 2)
    many = many[np.argsort(edge[many], kind="stable")]
    pairs = np.column_stack([many[start[many] > end[many]], many[start[many] < end[many]]])
    middles = 0.475 * points[start[pairs]].sum(1) + 0.05 * points[third[pairs]].mean(1)
    on = np.full(triangles.size, -1)  # the vertex on each side of a triangle
    on[pairs] = (len(points) + np.arange(len(pairs)))[:, None]
    cut = np.zeros(len(triangles), bool)
    cut[pairs // 3] = True
    centres = np.repeat(len(points) + len(pairs) + np.cumsum(cut) - 1, 3)
    fans = np.column_stack([start, np.where(on < 0, end, on), centres])[np.repeat(cut, 3)]
    halves = np.column_stack([on, end, centres])[on >= 0]
    points = np.concatenate([points, middles, points[triangles[cut]].mean(1)])
    return points, np.concatenate([triangles[~cut], fans, halves])


def close_holes(mesh: Mesh, resolution: float) -> tuple[Mesh, float]:
    """Return a watertight surface (Poisson), and its area more than two voxels from any vertex, units^2."""
    import open3d

    a, b, c = mesh.vertices[mesh.triangles.T]
    normals = np.zeros_like(mesh.vertices)
    np.add.at(normals, mesh.triangles.T, np.cross(b - a, c - a))
    points = cloud(mesh.vertices, unit(normals, 1e-30))
    points.colors = open3d.utility.Vector3dVector(mesh.colour)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    depth = int(np.clip(np.ceil(np.log2(ROOM * extent / resolution)), 5, 10))
    poisson = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    with _silenced():
        rough = _taken(poisson(points, depth=depth, scale=ROOM, n_threads=1)[0])
    values, triangles = watertight(
        np.concatenate([rough.vertices, rough.colour], axis=1), rough.triangles, 1e-3 * resolution
    )
    closed = Mesh(values[:, :3], triangles, values[:, 3:])
    middles = closed.vertices[closed.triangles].mean(1)
    gaps = cKDTree(mesh.vertices).query(middles, workers=-1)[0]
    return closed, float(closed.areas()[gaps > 2 * resolution].sum())


@contextmanager
def _silenced() -> Iterator[None]:
    """Drop output of native code: PoissonRecon prints harmless warnings about roots that it does not find."""
    sys.stdout.flush()
    nowhere, kept = os.open(os.devnull, os.O_WRONLY), {number: os.dup(number) for number in (1, 2)}
    try:
        for number in kept:
            os.dup2(nowhere, number)
        yield
    finally:
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)
        os.close(nowhere)


# Files of meshes.


def check_suffix(path: Path | str) -> Path:
    """Return `path`; InputError unless it ends in one of `SUFFIXES`."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: this is written as {' or '.join(SUFFIXES)}; choose such a name")
    return path


def write_mesh(path: Path | str, mesh: Mesh, scene: Scene, name: str = "scene") -> None:
    """Write a mesh of a scene, in the world, as .ply or .glb, atomically. InputError for another suffix.

    A .glb has the axes and the node that `write_gltf` writes for the scene's Gaussians, and the `name`.
    """
    path = check_suffix(path)
    if path.suffix.lower() == ".ply":
        far = scene.origin.any()  # positions are then float64
        places = scene.in_world(mesh.vertices) if far else mesh.vertices.astype(np.float32)
        columns = dict(zip(POSITION, places.T, strict=True))
        columns |= dict(zip(CHANNELS, to_bytes(255 * mesh.colour).T, strict=True))
        write_table(path, columns, mesh.triangles)
        return
    # Photographed colours include the lighting, so the material is unlit; glTF has linear colours.
    file = GltfWriter("KHR_materials_unlit")
    light = np.column_stack([linear_light(mesh.colour), np.ones(len(mesh.vertices))])
    attributes = {
        "POSITION": file.add((SIGNS * mesh.vertices).astype("<f4"), bounded=True),
        "COLOR_0": file.add(np.rint(65_535 * light).astype("<u2")),
    }
    corners = file.add(mesh.triangles.reshape(-1).astype("<u4"))
    primitive = {"attributes": attributes, "indices": corners, "material": 0}
    file.add_mesh(primitive, name=name, **node_of(scene))
    file.write(path, materials=[{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}])

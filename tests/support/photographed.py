"""A small textured world that can be photographed through any lens: the ground truth of dataset tests."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from langsplat_core import arrays
from langsplat_core.arrays import Array
from langsplat_core.datasets.intrinsics import PhotoIntrinsics, undistorted_points
from langsplat_core.scene import Camera, look_at

ROOM = 4.0  # world units; the floor is z = 0, the walls are x = ROOM and y = ROOM, all seen from inside
TEXELS = 512


def _texture(seed: int) -> Array:
    """(TEXELS, TEXELS, 3) in [0, 255]: blobs of several sizes, so that features are found at any scale."""
    rng = np.random.default_rng(seed)
    total = np.zeros((TEXELS, TEXELS, 3))
    for sigma in (2.5, 6.0, 16.0):
        layer = gaussian_filter(rng.normal(size=total.shape), (sigma, sigma, 0), mode="wrap")
        total += layer / layer.std()
    return np.clip(128 + 40 * total, 0, 255)


TEXTURES = [_texture(seed) for seed in range(3)]


def photograph(intrinsics: PhotoIntrinsics, world_to_camera: Array) -> Array:
    """(H, W, 3) uint8: what a camera in the room sees, sampled at pixel centres."""
    y, x = np.mgrid[: intrinsics.height, : intrinsics.width] + 0.5
    xy = np.stack([(x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy], -1).reshape(
        -1, 2
    )
    if intrinsics.distortion is not None:
        xy = undistorted_points(intrinsics.distortion, xy)
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    origin = -rotation.T @ translation
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1) @ rotation
    planes = [(2, 0.0), (0, ROOM), (1, ROOM)]
    with np.errstate(divide="ignore"):
        depth = np.stack([(at - origin[axis]) / rays[:, axis] for axis, at in planes], 1)
    depth[depth <= 1e-6] = np.inf
    nearest = depth.argmin(1)
    hit = origin + rays * depth.min(1)[:, None]
    picture = np.zeros((len(xy), 3))
    for index, (axis, _) in enumerate(planes):
        chosen = nearest == index
        uv = np.delete(hit[chosen], axis, axis=1).T * (TEXELS / ROOM)
        for channel in range(3):
            picture[chosen, channel] = map_coordinates(
                TEXTURES[index][..., channel], uv, order=1, mode="grid-wrap"
            )
    return np.rint(picture).astype(np.uint8).reshape(intrinsics.height, intrinsics.width, 3)


def poses(count: int) -> list[Array]:
    """World-to-camera matrices on an arc in the room, looking into its corner."""
    found = []
    for angle in np.radians(np.linspace(15, 75, count)):
        eye = np.array([ROOM - 3 * np.cos(angle), ROOM - 3 * np.sin(angle), 1.2 + 0.3 * np.sin(3 * angle)])
        found.append(look_at(eye, np.array([3.2, 3.2, 0.7]), np.array([0, 0, 1.0]), (8, 8)).world_to_camera)
    return found


def distance_to_room(points: Array) -> Array:
    """(N,) distance of points from the nearest of the room's planes."""
    return np.abs(points - (ROOM, ROOM, 0.0)).min(1)


def psnr(a: Array, b: Array) -> float:
    """dB, of two uint8 pictures."""
    return arrays.psnr(a / 255, b / 255)


def pinhole_picture(camera: Camera, samples: int = 1) -> Array:
    """What `camera` ought to show, with `samples` x `samples` samples averaged in every pixel."""
    fine = camera.resized(camera.width * samples, camera.height * samples)
    intrinsics = PhotoIntrinsics(fine.width, fine.height, fine.fx, fine.fy, fine.cx, fine.cy)
    picture = photograph(intrinsics, camera.world_to_camera).astype(np.float64)
    blocks = picture.reshape(camera.height, samples, camera.width, samples, 3)
    return np.rint(blocks.mean((1, 3))).astype(np.uint8)


@lru_cache(maxsize=64)  # the same few photographs serve many tests
def sensor_picture(intrinsics: PhotoIntrinsics, pose: bytes) -> Image.Image:
    """`photograph` with 3x3 samples averaged per pixel, as a sensor does; small pictures alias without.

    `pose` holds the bytes of a float64 world-to-camera matrix.
    """
    matrix = np.frombuffer(pose).reshape(4, 4)
    return Image.fromarray(
        photograph(intrinsics.regridded(3 * intrinsics.width, 3 * intrinsics.height), matrix)
    ).reduce(3)


def write_photos(
    folder: Path, intrinsics: PhotoIntrinsics, matrices: list[Array], stem: str = "view"
) -> list[str]:
    """PNG files ``<stem>_<index>.png`` in `folder`; returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{stem}_{index}.png" for index in range(len(matrices))]
    for name, matrix in zip(names, matrices, strict=True):
        sensor_picture(intrinsics, matrix.tobytes()).save(folder / name)
    return names


def colmap_reconstruction(
    model: str, size: tuple[int, int], params: list[float], names: list[str], matrices: list[Array]
) -> "pycolmap.Reconstruction":
    """One shared camera, one image per name, no points."""
    result = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params, camera_id=1)
    result.add_camera_with_trivial_rig(camera)
    for index, (name, matrix) in enumerate(zip(names, matrices, strict=True), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=index)
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(matrix[:3])))
    return result

"""Photographs of a small textured world, tiny datasets that tests spoil, and label folders."""

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from langsplat_core import arrays
from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.intrinsics import PhotoIntrinsics, undistorted_points
from langsplat_core.errors import InputError
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
    """Return (H, W, 3) uint8: what a camera in the room sees, sampled at pixel centres."""
    y, x = np.mgrid[: intrinsics.height, : intrinsics.width].reshape(2, -1) + 0.5
    xy = np.stack([(x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy], -1)
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
        for channel, texture in enumerate(np.moveaxis(TEXTURES[index], -1, 0)):
            picture[chosen, channel] = map_coordinates(texture, uv, order=1, mode="grid-wrap")
    return np.rint(picture).astype(np.uint8).reshape(intrinsics.height, intrinsics.width, 3)


def poses(count: int) -> list[Array]:
    """World-to-camera matrices on an arc in the room, looking into its corner."""
    found = []
    for angle in np.radians(np.linspace(15, 75, count)):
        eye = np.array([ROOM - 3 * np.cos(angle), ROOM - 3 * np.sin(angle), 1.2 + 0.3 * np.sin(3 * angle)])
        found.append(look_at(eye, np.array([3.2, 3.2, 0.7]), np.array([0, 0, 1.0]), (8, 8)).world_to_camera)
    return found


def distance_to_room(points: Array) -> Array:
    """Return (N,) distance of points from the nearest of the room's planes."""
    return np.abs(points - (ROOM, ROOM, 0.0)).min(1)


def psnr(a: Array, b: Array) -> float:
    """dB, of two uint8 pictures."""
    return arrays.psnr(a / 255, b / 255)


def pinhole_picture(camera: Camera, samples: int = 1) -> Array:
    """Return what `camera` ought to show, with `samples` x `samples` samples averaged in every pixel."""
    fine = camera.resized(camera.width * samples, camera.height * samples)
    intrinsics = PhotoIntrinsics(fine.width, fine.height, fine.fx, fine.fy, fine.cx, fine.cy)
    picture = photograph(intrinsics, camera.world_to_camera).astype(np.float64)
    blocks = picture.reshape(camera.height, samples, camera.width, samples, 3)
    return np.rint(blocks.mean((1, 3))).astype(np.uint8)


@lru_cache(maxsize=64)  # the same few photographs serve many tests
def sensor_picture(intrinsics: PhotoIntrinsics, pose: bytes) -> Image.Image:
    """`photograph` by a pose of these float64 bytes, 3x3 samples averaged per pixel against aliasing."""
    fine = intrinsics.resized(3 * intrinsics.width, 3 * intrinsics.height)
    return Image.fromarray(photograph(fine, np.frombuffer(pose).reshape(4, 4))).reduce(3)


def write_photos(folder: Path, intrinsics: PhotoIntrinsics, matrices: list[Array]) -> list[str]:
    """PNG files ``view_<index>.png`` in `folder`; returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"view_{index}.png" for index in range(len(matrices))]
    for name, matrix in zip(names, matrices, strict=True):
        sensor_picture(intrinsics, matrix.tobytes()).save(folder / name)
    return names


def lens_params(lens: PhotoIntrinsics) -> list[float]:
    """In the order of COLMAP's PINHOLE or OPENCV, which is nerfstudio's too."""
    curve = lens.distortion
    known = [] if curve is None else [getattr(curve, name) for name in ("k1", "k2", "p1", "p2")]
    return [lens.fx, lens.fy, lens.cx, lens.cy, *known]


def write_model(
    out: Path,
    lens: PhotoIntrinsics,
    names: list[str],
    matrices: Sequence[Array],
    points: Array | None = None,
    form: str = "bin",
) -> Path:
    """A COLMAP model, "bin" or "txt": one camera, an image per name, (M, 3) points; returns its folder."""
    result, kind = pycolmap.Reconstruction(), "PINHOLE" if lens.distortion is None else "OPENCV"
    camera = pycolmap.Camera(
        model=kind, width=lens.width, height=lens.height, params=lens_params(lens), camera_id=1
    )
    result.add_camera_with_trivial_rig(camera)
    for index, (name, matrix) in enumerate(zip(names, matrices, strict=True), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=index)
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(matrix[:3])))
    for index, point in enumerate(() if points is None else points):
        result.add_point3D(point, pycolmap.Track(), np.array([index, 2, 3], np.uint8))
    out.mkdir(parents=True, exist_ok=True)
    (result.write_binary if form == "bin" else result.write_text)(out)
    return out


CONFIG = DatasetConfig(max_side=64)
IDENTITY = np.eye(4).tolist()


def refuse(path: Path, work: Path) -> str:
    """The one line with which `path` is refused."""
    with pytest.raises(InputError) as caught:
        load_capture(path, CONFIG, work)
    return str(caught.value)


def write_picture(path: Path, size: tuple[int, int] = (40, 30), seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def mask_file(path: Path, mask: Array) -> Path:
    """White where a photograph counts."""
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(path)
    return path


def write_colmap(folder: Path, form: str = "bin") -> Path:
    """Two photographs and a model with three points; returns the model's folder."""
    names = ["a.png", "b.png"]
    for name in names:
        write_picture(folder / "images" / name)
    lens, points = PhotoIntrinsics(40, 30, 50.0, 50.0, 20.0, 15.0), np.array([[x, 0, 3.0] for x in range(3)])
    return write_model(folder / "sparse" / "0", lens, names, [np.eye(4)] * 2, points, form)


def write_nerfstudio(folder: Path, **top: object) -> None:
    write_picture(folder / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": IDENTITY}
    text = json.dumps({"fl_x": 50.0, "fl_y": 50.0, "cx": 20.0, "cy": 15.0, "frames": [frame], **top})
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig")  # some editors add the mark


Polygon = list[list[float]]
SIZE = (40, 30)  # width and height, pixels


def rectangle(left: int, top: int, right: int, bottom: int) -> Polygon:
    """Corners, all of them inside the mask."""
    return [[left, top], [right, top], [right, bottom], [left, bottom]]


def block(left: int, top: int, right: int, bottom: int, size: tuple[int, int] = SIZE) -> Array:
    """The mask of `rectangle`."""
    mask = np.zeros((size[1], size[0]), bool)
    mask[top : bottom + 1, left : right + 1] = True
    return mask


def lerf_frame(folder: Path, name: str, objects: Sequence[tuple[str, Polygon]]) -> Path:
    """label file `name`.json in `folder`; boxes are the polygons' own."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for category, polygon in objects:
        corners = np.array(polygon or [[0, 0]])
        box = [*corners.min(0).tolist(), *corners.max(0).tolist()]
        rows.append({"category": category, "bbox": box, "segmentation": polygon, "group": 1})
    path = folder / f"{name}.json"
    info = {"name": f"{name}.jpg", "width": SIZE[0], "height": SIZE[1], "depth": 3, "note": ""}
    path.write_text(json.dumps({"info": info, "objects": rows}))
    return path


def ovs_view(scene: Path, name: str, masks: Mapping[str, Array], photo: tuple[int, int] = SIZE) -> None:
    """segmentations/`name`/<class>.png and images/`name`.jpg; classes.txt is extended by what is new."""
    for phrase, mask in masks.items():
        silhouette(scene / "segmentations" / name, phrase, mask)
    listed = scene / "segmentations" / "classes.txt"
    known = listed.read_text().splitlines() if listed.exists() else []
    listed.write_text("\n".join([*known, *(phrase for phrase in masks if phrase not in known)]) + "\n")
    (scene / "images").mkdir(exist_ok=True)
    Image.new("RGB", photo).save(scene / "images" / f"{name}.jpg")


def mask_map(folder: Path, phrase: str, mask: Array) -> None:
    """A relevancy map that is 1 in the mask and 0 outside, as another system might have rendered it."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"{phrase}.npy", mask.astype(np.float32))


def silhouette(folder: Path, phrase: str, mask: Array) -> None:
    """The drawn selection, white on black."""
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * mask).astype(np.uint8)).save(folder / f"{phrase}.png")

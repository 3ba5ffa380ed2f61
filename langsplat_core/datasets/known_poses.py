"""Points for datasets that bring cameras but no points: triangulated, or at the worst random."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.datasets import sfm
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.colmap import good_points
from langsplat_core.datasets.colmap_model import has_model, read_model
from langsplat_core.datasets.images import developer
from langsplat_core.datasets.random_points import random_points
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

log = logging.getLogger("langsplat")

POINTS_SIDE = 1600  # px, longer side of the pictures that features are sought in
MIN_POINTS = 100
RANDOM_POINTS = 20_000
NEIGHBOURS = 12  # views that each view is matched with
MAX_ANGLE = 75.0  # degrees between the axes of views that are matched


def add_points(capture: Capture, views: Sequence[int], work: Path, progress: Progress) -> Capture:
    """The capture with points in its own world, from the photographs at `views`: triangulated ones (kept in
    ``work/sfm-*``), or random ones in front of the cameras when fewer than `MIN_POINTS` can be."""
    points, colours = _triangulated(capture, views, work, progress)
    if len(points) < MIN_POINTS:
        log.warning(
            "only %d points could be triangulated; starting from %d random ones", len(points), RANDOM_POINTS
        )
        generator = np.random.default_rng(0)
        cameras, images = [capture.cameras[i] for i in views], [capture.images[i] for i in views]
        points, colours = random_points(RANDOM_POINTS, points, cameras, images, generator)
    return replace(capture, points=points, colours=colours)


def _triangulated(
    capture: Capture, views: Sequence[int], work: Path, progress: Progress
) -> tuple[Array, Array]:
    workspace = sfm.open_workspace(work, ["known poses", 3, POINTS_SIDE, capture.digest(views)])
    try:
        if not has_model(workspace / "sparse"):
            names = [f"{index:05d}.png" for index in range(len(views))]
            cameras = _write_pictures(workspace / "images", names, capture, views, progress)
            sfm.extract_features(workspace, _groups(names, cameras), progress)
            pairs = [(names[i], names[j]) for i, j in neighbouring_views(cameras)]
            sfm.match_features(workspace, pairs, progress)
            progress("triangulating points", 0.0)
            sfm.triangulate(workspace, names, cameras)
            progress("triangulating points", 1.0)
        return good_points(read_model(workspace / "sparse"))
    except (*sfm.FAILURES, InputError) as error:
        log.warning("points could not be triangulated: %s", str(error).splitlines()[0])
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def _write_pictures(
    folder: Path, names: Sequence[str], capture: Capture, views: Sequence[int], progress: Progress
) -> tuple[Camera, ...]:
    """Pictures to seek features in, one after the other; returns their cameras. They are made from the files
    again, larger than what is trained on: small pictures lack the details that features are found at."""
    enlarge = developer(POINTS_SIDE)
    cameras = []
    for count, (name, index) in enumerate(zip(names, views, strict=True)):
        progress("preparing photographs", count / len(views))
        camera, image = capture.cameras[index], capture.images[index]
        if capture.photos:
            camera, image = enlarge(capture.photos[index])
        Image.fromarray(image).save(folder / name, compress_level=1)
        cameras.append(camera)
    progress("preparing photographs", 1.0)
    return tuple(cameras)


def _params(camera: Camera) -> str:
    """As COLMAP's PINHOLE takes them."""
    return ",".join(repr(float(value)) for value in (camera.fx, camera.fy, camera.cx, camera.cy))


def _groups(names: list[str], cameras: tuple[Camera, ...]) -> list[sfm.Group]:
    members: dict[tuple[str, int], list[str]] = {}
    for name, camera in zip(names, cameras, strict=True):
        members.setdefault((_params(camera), max(camera.width, camera.height)), []).append(name)
    return [sfm.Group(tuple(group), "PINHOLE", params, side) for (params, side), group in members.items()]


def neighbouring_views(cameras: tuple[Camera, ...]) -> list[tuple[int, int]]:
    """Pairs (i < j) worth matching: for every view the nearest `NEIGHBOURS` that look a similar way."""
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    distance[axes @ axes.T < np.cos(np.radians(MAX_ANGLE))] = np.inf
    np.fill_diagonal(distance, np.inf)
    pairs = set()
    for i, row in enumerate(distance):
        for j in np.argsort(row, kind="stable")[:NEIGHBOURS]:
            if np.isfinite(row[j]):
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)

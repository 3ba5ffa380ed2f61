"""Points for datasets that bring cameras but no points: triangulated, or at the worst random."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.datasets import sfm
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.colmap import good_points
from langsplat_core.datasets.colmap_model import has_model, read_model
from langsplat_core.datasets.random_points import random_points
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

log = logging.getLogger("langsplat")

MIN_POINTS = 100
RANDOM_POINTS = 20_000
NEIGHBOURS = 12  # views that each view is matched with
MAX_ANGLE = 75.0  # degrees between the axes of views that are matched


def add_points(capture: Capture, work: Path, progress: Progress) -> Capture:
    """The capture with points in its own world: triangulated ones (kept in ``work/sfm-*``), or random ones
    in front of the cameras when fewer than `MIN_POINTS` can be triangulated."""
    points, colours = _triangulated(capture, work, progress)
    if len(points) < MIN_POINTS:
        log.warning(
            "only %d points could be triangulated; starting from %d random ones", len(points), RANDOM_POINTS
        )
        generator = np.random.default_rng(0)
        points, colours = random_points(RANDOM_POINTS, points, capture.cameras, capture.images, generator)
    return replace(capture, points=points, colours=colours)


def _triangulated(capture: Capture, work: Path, progress: Progress) -> tuple[Array, Array]:
    names = [f"{index:05d}.png" for index in range(len(capture))]
    workspace = sfm.open_workspace(work, ["known poses", 2, capture.digest(range(len(capture)))])
    try:
        if not has_model(workspace / "sparse"):
            for name, image in zip(names, capture.images, strict=True):
                Image.fromarray(image).save(workspace / "images" / name, compress_level=1)
            sfm.extract_features(workspace, _groups(names, capture.cameras), progress)
            pairs = [(names[i], names[j]) for i, j in neighbouring_views(capture.cameras)]
            sfm.match_features(workspace, pairs, progress)
            progress("triangulating points", 0.0)
            sfm.triangulate(workspace, names, capture.cameras)
            progress("triangulating points", 1.0)
        return good_points(read_model(workspace / "sparse"))
    except (*sfm.FAILURES, InputError) as error:
        log.warning("points could not be triangulated: %s", str(error).splitlines()[0])
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


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

"""Points to begin with where structure from motion gave none, or too few."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.colmap import good_points, has_model, read_model
from langsplat_core.datasets.photos import developer
from langsplat_core.datasets.workspace import FAILURES, MASKS, CameraGroup, open_workspace, run_apart
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

NEAREST, FARTHEST = 0.3, 3.0  # random depths, as multiples of the distance to what the cameras look at
TELLING_POINTS = 50  # from this many known points on, depths follow theirs


def look_distance(cameras: Sequence[Camera]) -> float:
    """Return the typical distance from the cameras to the place they look at, world units, > 0.

    That place is nearest to all optical axes in the least-squares sense; a small pull to the cameras'
    own mean keeps parallel axes from running to infinity.
    """
    positions = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    spread = max(float(np.linalg.norm(positions - positions.mean(0), axis=1).max()), 1e-3)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    pull = 1e-3 * np.eye(3)
    centre = np.linalg.solve(
        across.mean(0) + pull,
        np.einsum("nij,nj->i", across, positions) / len(axes) + pull @ positions.mean(0),
    )
    distance = float(np.median(((centre - positions) * axes).sum(1)))
    return distance if distance > 0.1 * spread else 2 * spread


def random_points(
    count: int,
    known: Array,
    cameras: Sequence[Camera],
    images: Sequence[Array],
    rng: np.random.Generator,
    masks: Sequence[Array | None] = (),
) -> tuple[Array, Array]:
    """Draw (count, 3) points in the cameras' view volume, with the (count, 3) uint8 colours of their pixels.

    images: (H, W, 3) uint8, one per camera; masks: (H, W) bool each, pixels that count; known: (M, 3) points
    whose depths tell where the scene is, M may be 0. Depths are uniform in 1/z, so that near and far are
    equally dense in the images. Twice as many are drawn and those in sight of at least half the cameras
    preferred: one view alone teaches no depth.
    """
    distance = look_distance(cameras)
    near, far = NEAREST * distance, FARTHEST * distance
    if len(known) >= TELLING_POINTS:
        seen = [camera.project(known) for camera in cameras]
        depths = [z[camera.in_image(pixels, z)] for camera, (pixels, z) in zip(cameras, seen, strict=True)]
        near, far = (float(z) for z in np.quantile(np.concatenate(depths), (0.02, 0.98)))
    drawn = np.zeros((2 * count, 3))
    colours = np.zeros((2 * count, 3), np.uint8)
    owner = rng.integers(len(cameras), size=2 * count)
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(owner == index)
        x = rng.uniform(0, camera.width, len(rows))
        y = rng.uniform(0, camera.height, len(rows))
        mask = masks[index] if masks else None
        if mask is not None and mask.any():
            at = np.divmod(rng.choice(np.flatnonzero(mask), len(rows)), camera.width)
            y, x = (whole + part % 1 for whole, part in zip(at, (y, x), strict=True))
        z = 1 / rng.uniform(1 / far, 1 / near, len(rows))
        drawn[rows] = camera.unproject(np.stack([x, y], -1), z)
        colours[rows] = images[index][y.astype(int), x.astype(int)]
    shared = np.sum([camera.in_image(*camera.project(drawn)) for camera in cameras], axis=0)
    best = np.argsort(shared < len(cameras) / 2, kind="stable")[:count]
    return drawn[best], colours[best]


# Points for datasets that bring cameras but no points: triangulated, or at the worst random.

log = logging.getLogger("langsplat")

POINTS_SIDE = 1600  # px, longer side of the images that features are sought in
MIN_POINTS = 100
RANDOM_POINTS = 20_000
NEIGHBOURS = 12  # views that each view is matched with
MAX_ANGLE = 75.0  # degrees between the axes of views that are matched


def add_points(capture: Capture, views: Sequence[int], work: Path, progress: Progress) -> Capture:
    """Return the capture with points in its own world, from the photographs at `views`.

    They are triangulated (kept in ``work/sfm-*``), or random ones in front of the cameras when fewer than
    `MIN_POINTS` can be.
    """
    points, colours = _triangulated(capture, views, work, progress)
    if len(points) < MIN_POINTS:
        log.warning(
            "only %d points could be triangulated; starting from %d random ones", len(points), RANDOM_POINTS
        )
        generator = np.random.default_rng(0)
        cameras, images = [capture.cameras[i] for i in views], [capture.images[i] for i in views]
        masks = [capture.mask(i) for i in views]
        points, colours = random_points(RANDOM_POINTS, points, cameras, images, generator, masks)
    return replace(capture, points=points, colours=colours)


def _triangulated(
    capture: Capture, views: Sequence[int], work: Path, progress: Progress
) -> tuple[Array, Array]:
    workspace = open_workspace(work, ["known poses", 3, POINTS_SIDE, capture.digest(views)])
    try:
        if not has_model(workspace / "sparse"):
            names = [f"{index:05d}.png" for index in range(len(views))]
            cameras = _write_images(workspace / "images", names, capture, views, progress)
            run_apart(
                _match_and_triangulate, workspace, names, cameras, workspace=workspace, progress=progress
            )
        return good_points(read_model(workspace / "sparse"))
    except (*FAILURES, InputError) as error:
        log.warning("points could not be triangulated: %s", str(error).splitlines()[0])
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def _match_and_triangulate(
    workspace: Path, names: Sequence[str], cameras: Sequence[Camera], progress: Progress
) -> None:
    """Write points from the images of a workspace; in the process of its own."""
    from langsplat_core.datasets.reconstruction import extract_features, match_features, triangulate

    members: dict[tuple[str, int], list[str]] = {}
    for name, camera in zip(names, cameras, strict=True):
        params = ",".join(repr(float(value)) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        members.setdefault((params, max(camera.width, camera.height)), []).append(name)
    groups = [CameraGroup(tuple(group), "PINHOLE", params, side) for (params, side), group in members.items()]
    extract_features(workspace, groups, progress)
    pairs = [(names[i], names[j]) for i, j in neighbouring_views(cameras)]
    match_features(workspace, pairs, progress)
    progress("triangulating points", 0.0)
    triangulate(workspace, names, cameras)
    progress("triangulating points", 1.0)


def _write_images(
    folder: Path, names: Sequence[str], capture: Capture, views: Sequence[int], progress: Progress
) -> tuple[Camera, ...]:
    """Write images to seek features in, one after the other, and return their cameras.

    They are made from the files again, larger than what is trained on: small images lack the details that
    features are found at.
    """
    enlarge = developer(POINTS_SIDE)
    cameras = []
    for count, (name, index) in enumerate(zip(names, views, strict=True)):
        progress("preparing photographs", count / len(views))
        camera, image, mask = capture.cameras[index], capture.images[index], capture.mask(index)
        if capture.photos:
            camera, image, mask = enlarge(capture.photos[index])
        Image.fromarray(image).save(folder / name, compress_level=1)
        if capture.masks:  # one each: COLMAP finds nothing in a photograph that lacks its own
            counted = np.ones(image.shape[:2], bool) if mask is None else mask
            folder.with_name(MASKS).mkdir(exist_ok=True)
            Image.fromarray(counted).save(folder.with_name(MASKS) / f"{name}.png")
        cameras.append(camera)
    progress("preparing photographs", 1.0)
    return tuple(cameras)


def neighbouring_views(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Return pairs (i < j) to match: every view with the nearest `NEIGHBOURS` that look a similar way."""
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

"""Cameras of a plain folder of photographs, and points for cameras that came without any.

Both are found by structure from motion in a process of its own (`reconstruction`), kept in ``work/sfm-*``.
"""

import logging
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy
from PIL import ExifTags, Image

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import photos
from langsplat_core.datasets import workspace as workspaces
from langsplat_core.datasets.capture import Capture, develop, on_ground, random_points
from langsplat_core.datasets.colmap import SparseModel, good_points, located_photos, model_suffix, read_model
from langsplat_core.errors import FormatError, InputError, printable_line, report_loss, shortened
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import PictureError, opened
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

SIDE = 1600  # px, longer side of the images that features are sought in
SMALL = 1000  # px, the same in a first attempt; images up to this size are doubled in the second
TRIED = "small.tried"  # file in a workspace that marks the attempt with small images as done
MIN_PHOTOS = 3
LEAST_LOCATED = 0.5  # share of the photographs that must be located

log = logging.getLogger("langsplat")


def load_photos(
    folder: Path, paths: Sequence[Path], config: DatasetConfig, work: Path, progress: Progress
) -> Capture:
    """Locate photographs in or below `folder` (kept in ``work/sfm-*``) and load them; see `load_capture`."""
    if len(paths) < MIN_PHOTOS:
        needed = f"at least {MIN_PHOTOS} are needed, {workspaces.SHARING}"
        raise InputError(f"{folder} has {len(paths)} photographs; {needed}")
    labels = {path: path.relative_to(folder).as_posix() for path in paths}
    contents = [(labels[path], photos.content(path)) for path in paths]
    masked = [(labels[path], photos.content(mask)) for path in paths if (mask := photos.mask_beside(path))]
    workspace = workspaces.open_workspace(work, ["photographs", 5, SMALL, SIDE, contents, masked])
    files = numbered(paths)
    told = (workspace / TRIED).exists()
    if not model_suffix(workspace / "sparse"):
        try:
            workspaces.run_apart(_locate, workspace, files, workspace=workspace, progress=progress)
        except workspaces.FAILURES as error:
            reason = str(error).partition("\n")[0]
            raise InputError(f"no cameras were found ({reason}); remove {workspace} and try again") from None
    model = _stored_model(workspace) if model_suffix(workspace / "sparse") else None
    placed = {image.name for image in model.images} if model else set()
    matches = workspaces.read_matches(workspace, files, placed)
    lost: dict[str, list[str]] = {}  # by the reason
    for row, name in enumerate(labels.values()):
        if row not in matches.located:
            lost.setdefault(matches.why(row), []).append(name)
    found = len(matches.located)
    few = found < max(MIN_PHOTOS, LEAST_LOCATED * len(files)) and not config.allow_few_cameras
    if model is None or few:
        anyway = "" if model is None else ", or go on without these with --dataset.allow-few-cameras"
        raise InputError(
            f"only {found} of {len(files)} photographs could be located together "
            f"({_listed(lost, 10)}); {matches.advice()}{anyway}"
        )
    unread = lost.pop(workspaces.UNREADABLE, [])
    if told and unread:  # else the process has told of them, with the reasons
        report_loss("%d of %d photographs cannot be read: %s", len(unread), len(files), shortened(unread))
    if lost:
        share = f"{sum(map(len, lost.values()))} of {len(files)} photographs"
        what = "could not be located and are left out"
        report_loss("%s %s (%s); %s", share, what, _listed(lost, 5), matches.advice())
    located = []
    for copy in located_photos(model, workspace / "images"):
        path = files[copy.label]
        mask = photos.mask_beside(path)
        located.append(replace(copy, path=path, label=labels[path], upright=True, mask=mask))
    return replace(develop(located, config, progress, *good_points(model)), matches=matches)


def numbered(paths: Sequence[Path]) -> dict[str, Path]:
    """Return photographs by their names in the workspace."""
    return {f"{index:05d}.jpg": path for index, path in enumerate(paths)}


def _listed(lost: dict[str, list[str]], limit: int) -> str:
    """Return ``no features: a.jpg, b.jpg; no matches with any other: c.jpg``."""
    return "; ".join(f"{reason}: {shortened(names, limit)}" for reason, names in lost.items())


def _locate(workspace: Path, files: dict[str, Path], progress: Progress) -> None:
    """Locate the photographs `files` and write their model; runs in the process of its own.

    Small images, which take a quarter of the time, are enough where they locate every photograph firmly.
    """
    from langsplat_core.datasets.reconstruction import map_cameras

    if not (workspace / TRIED).exists():
        small = workspace / "small"
        if map_cameras(small, match_photos(small, files, progress, SMALL), progress, firmly=True):
            for name in (workspaces.MATCHES, "sparse"):  # the model last, with which the workspace is whole
                (small / name).replace(workspace / name)
        (workspace / TRIED).touch()
        shutil.rmtree(small, ignore_errors=True)
    if not model_suffix(workspace / "sparse"):
        map_cameras(workspace, match_photos(workspace, files, progress), progress)


def match_photos(workspace: Path, files: dict[str, Path], progress: Progress, side: int = SIDE) -> int:
    """Put features and matches of photographs into the workspace's database; return how many can be read."""
    from langsplat_core.datasets.reconstruction import extract_features, match_features

    groups = _small_copies(workspace / "images", files, side, progress)
    names = sorted(name for group in groups for name in group.names)
    extract_features(workspace, groups, progress)
    places = np.array([photos.exif_facts(files[name]).place for name in names])
    match_features(workspace, pairs_to_match(names, places), progress)
    return len(names)


def _small_copies(
    folder: Path, files: dict[str, Path], side: int, progress: Progress
) -> list[workspaces.CameraGroup]:
    """Write copies of at most `side` pixels that COLMAP can read and finds the same way up as we do.

    Photographs of one size and optics (maker, model, focal length) share a camera. Damaged ones are left out.
    """
    members: dict[tuple[tuple[int, int], str], list[str]] = {}
    broken = []
    any_masks = any(map(photos.mask_beside, files.values()))
    for index, (name, path) in enumerate(files.items()):
        progress("preparing photographs", index / len(files))
        try:
            if not (folder / name).is_file():
                image = photos.over_black(photos.read_photo(path, upright=True))
                image.thumbnail((side, side), Image.Resampling.LANCZOS)
                with atomic_path(folder / name) as temporary:
                    image.save(temporary, quality=95, exif=photos.optics(path))
            with opened(folder / name) as copy:
                exif, size = copy.getexif(), copy.size
                lens = str(dict(exif) | dict(exif.get_ifd(ExifTags.IFD.Exif)))
            if any_masks:
                mask = photos.mask_beside(path)
                given = Image.new("RGB", size, "white") if mask is None else photos.read_photo(mask, False)
                counted = photos.over_black(given).convert("L")
                _write_mask(folder, name, counted.resize(size, Image.Resampling.NEAREST))
            members.setdefault((size, lens), []).append(name)
        except PictureError as error:
            broken.append(f"{path.name} ({error.reason})")
    progress("preparing photographs", 1.0)
    count = len(files) - len(broken)
    if count < MIN_PHOTOS:
        raise InputError(f"only {count} photographs can be read, of {MIN_PHOTOS} needed: {shortened(broken)}")
    if broken and side == SMALL:
        share = f"{len(broken)} of {len(files)} photographs"
        report_loss("%s cannot be read and are left out: %s", share, shortened(broken))
    return [
        workspaces.CameraGroup(tuple(names), "SIMPLE_RADIAL", doubled=max(size) <= SMALL < side)
        for (size, _), names in members.items()
    ]


def _write_mask(images: Path, name: str, mask: Image.Image) -> None:
    """Write an image's mask for COLMAP; images without one need a white mask, or get no features."""
    path = images.with_name(workspaces.MASKS) / f"{name}.png"
    path.parent.mkdir(exist_ok=True)
    with atomic_path(path) as temporary:
        mask.save(temporary)


def pairs_to_match(names: Sequence[str], places: Array) -> list[workspaces.Pair]:
    """Return every pair of up to 80 photographs; of more, all would cost too much.

    Then each is paired with its next 10 neighbours in name order, with those at distances 16, 32, 64 ...,
    which closes loops, and with the `NEIGHBOURS` nearest by `places` (K, 2), degrees, NaN where unknown.
    """
    count, named = len(names), np.flatnonzero(np.isfinite(places).all(1))
    steps = [*range(1, 11), *(1 << k for k in range(4, 32))] if count > 80 else range(1, count)
    pairs = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    if count > 80 and len(named) > 1:
        at = on_ground(places[named])
        rows = scipy.spatial.cKDTree(at).query(at, min(len(named), NEIGHBOURS + 1))[1]
        near = zip(np.repeat(named, rows.shape[1]).tolist(), named[rows].ravel().tolist(), strict=True)
        pairs |= {(min(ends), max(ends)) for ends in near if ends[0] != ends[1]}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


# Points for datasets that bring cameras but no points: triangulated, or at the worst random.

MIN_POINTS = 100
RANDOM_POINTS = 20_000
NEIGHBOURS = 12  # nearest views that each view is matched with
MAX_ANGLE = 75.0  # degrees between the axes of views that are matched


def add_points(capture: Capture, views: Sequence[int], work: Path, progress: Progress) -> Capture:
    """Return the capture with points triangulated from the photographs at `views`, or random ones."""
    log.info("the dataset has no points; they are triangulated")
    points, colours, why = _triangulated(capture, views, work, progress)
    if len(points) < MIN_POINTS:
        report_loss("only %d points could be triangulated%s; %d are random", len(points), why, RANDOM_POINTS)
        points, colours = random_points(RANDOM_POINTS, points, capture, views, np.random.default_rng(0))
    return replace(capture, points=points, colours=colours)


def _triangulated(
    capture: Capture, views: Sequence[int], work: Path, progress: Progress
) -> tuple[Array, Array, str]:
    """Return points, their colours, and why there are none, in words; "" where nothing failed."""
    workspace = workspaces.open_workspace(work, ["known poses", 3, SIDE, capture.digest(views)])
    try:
        if not model_suffix(workspace / "sparse"):
            names = [f"{index:05d}.png" for index in range(len(views))]
            cameras = _write_images(workspace / "images", names, capture, views, progress)
            workspaces.run_apart(
                _match_and_triangulate, workspace, names, cameras, workspace=workspace, progress=progress
            )
    except (*workspaces.FAILURES, InputError) as error:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), f" ({printable_line(error, 200)})"
    return *good_points(_stored_model(workspace)), ""


def _stored_model(workspace: Path) -> SparseModel:
    """Return the finished model of a workspace; FormatError where its files changed since it was written."""
    folder = workspace / "sparse"
    stated = folder / workspaces.DIGEST  # none in earlier versions
    if stated.is_file() and stated.read_bytes() != workspaces.digest_of_model(folder).encode():
        raise FormatError(f"{workspace}: its model changed since it was written; delete it and run again")
    return read_model(folder)


def _match_and_triangulate(
    workspace: Path, names: Sequence[str], cameras: Sequence[Camera], progress: Progress
) -> None:
    """Write points from the images of a workspace; in the process of its own."""
    from langsplat_core.datasets.reconstruction import extract_features, match_features, triangulate

    members: dict[tuple[str, int], list[str]] = {}
    for name, camera in zip(names, cameras, strict=True):
        params = ",".join(repr(float(value)) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        members.setdefault((params, max(camera.width, camera.height)), []).append(name)
    groups = [
        workspaces.CameraGroup(tuple(group), "PINHOLE", params, doubled=side <= SMALL)
        for (params, side), group in members.items()
    ]
    extract_features(workspace, groups, progress)
    pairs = [(names[i], names[j]) for i, j in neighbouring_pairs(cameras)]
    match_features(workspace, pairs, progress)
    progress("triangulating points", 0.0)
    triangulate(workspace, names, cameras)
    progress("triangulating points", 1.0)


def _write_images(
    folder: Path, names: Sequence[str], capture: Capture, views: Sequence[int], progress: Progress
) -> tuple[Camera, ...]:
    """Write images to seek features in and return their cameras: from the files, larger than for training."""
    enlarge = photos.Developer(SIDE)
    cameras = []
    for count, (name, index) in enumerate(zip(names, views, strict=True)):
        progress("preparing photographs", count / len(views))
        camera, image, mask = capture.cameras[index], capture.images[index], capture.mask(index)
        if capture.photos:
            camera, image, mask = enlarge(capture.photos[index]).view(capture.cut_out)
        Image.fromarray(image).save(folder / name, compress_level=1)
        if capture.masks:
            counted = np.ones(image.shape[:2], bool) if mask is None else mask
            _write_mask(folder, name, Image.fromarray(counted))
        cameras.append(camera)
    progress("preparing photographs", 1.0)
    return tuple(cameras)


def neighbouring_pairs(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Return pairs (i < j) to match: every view with the nearest `NEIGHBOURS` that look a similar way."""
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    distance[axes @ axes.T < np.cos(np.radians(MAX_ANGLE))] = np.inf
    np.fill_diagonal(distance, np.inf)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :NEIGHBOURS].tolist()
    return sorted(
        {(min(i, j), max(i, j)) for i, row in enumerate(nearest) for j in row if np.isfinite(distance[i, j])}
    )

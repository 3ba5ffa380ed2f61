"""Structure from motion (pycolmap): features and matches, cameras, points."""

import errno
import hashlib
import json
import logging
import math
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from PIL import Image

from langsplat_core.datasets.capture import (
    EXIF_IFD,
    Capture,
    Photo,
    develop,
    find_photos,
    mask_beside,
    optics,
    read_photo,
)
from langsplat_core.datasets.colmap import good_points, has_model, located_photos, read_model
from langsplat_core.datasets.intrinsics import pycolmap
from langsplat_core.datasets.matches import FEWEST_MATCHES, MATCHES, Matches, NotLocatedError, read_matches
from langsplat_core.errors import FormatError, InputError, shortened
from langsplat_core.io import apart
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import PictureError, opened
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

# Features, matches and triangulation by pycolmap, in steps that report and resume.
#
# A *workspace* is a folder with small copies of the photographs (``images``), COLMAP's ``database.db`` and,
# in the end, the model (``sparse``). It is named by a digest of all that it is made from; the database
# keeps what was computed, so an interrupted run goes on, and within one machine ends with the same cameras,
# byte for byte: photographs are numbered in the order of their names, every random choice has its seed, and
# what adds up over photographs runs on one thread. Extraction and matching use all cores: one thread does a
# whole photograph or pair, and the database is the same. Another processor may round otherwise, and find
# other matches.

EXHAUSTIVE_LIMIT = 80  # photographs; beyond, matching every pair costs too much
SEQUENTIAL_OVERLAP = 10  # neighbours in name order that each photograph is matched with
FEATURES = 8192  # per photograph
MASKS = "masks"  # in the workspace: black where no features are wanted
SMALL_SIDE = 1000  # px; smaller photographs are doubled before features are sought, as SIFT proposes
EXTRACT_BATCH = 8  # photographs per step: a step is the unit of progress and of resuming
MATCH_BATCH = 64  # pairs per step
FAILURES = (RuntimeError, ValueError, IndexError)  # what pycolmap raises
ROOM = 64_000_000  # bytes that a step may want: 8 photographs of 8192 features take 20 MB, with the journal

Pair = tuple[str, str]


@dataclass(frozen=True)
class Group:
    """Photographs of one size that share one camera."""

    names: tuple[str, ...]  # file names in the workspace's images folder
    model: str  # COLMAP's camera model
    params: str = ""  # its parameters, comma-separated; empty: guessed from EXIF data or the size
    side: int = 0  # longer side, pixels


def open_workspace(work: Path, inputs: object) -> Path:
    """``work/sfm-<digest>`` of `inputs`, anything that JSON can hold; those of others are left alone."""
    digest = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    folder = work / f"sfm-{digest}"
    if not (folder / "sparse").is_dir():
        (folder / "images").mkdir(parents=True, exist_ok=True)
    return folder


def run_apart(function: Callable[..., Any], *arguments: Any, workspace: Path, progress: Progress) -> Any:
    """``function(*arguments, progress)`` in a process of its own, which pycolmap may end: RuntimeError then,
    and OSError for whatever fails where the disk is about full."""
    try:
        return apart.run(function, *arguments, progress=progress)
    except (apart.AbortedError, *FAILURES) as error:
        if shutil.disk_usage(workspace).free < ROOM:
            raise _disk_full(workspace) from None
        raise error if isinstance(error, FAILURES) else RuntimeError(f"it {error}") from None


def _disk_full(folder: Path) -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def extract_features(folder: Path, groups: Sequence[Group], progress: Progress) -> None:
    """SIFT features of every photograph of `groups` into the database; those it has are kept."""
    database = folder / "database.db"
    total, done = sum(len(group.names) for group in groups), 0
    for group in groups:
        _register(database, folder / "images", group)
    for group in groups:
        for start in range(0, len(group.names), EXTRACT_BATCH):
            progress("finding features", done / total)
            names = group.names[start : start + EXTRACT_BATCH]
            _extract(database, folder / "images", group, names)
            done += len(names)
    progress("finding features", 1.0)


def _register(database: Path, images: Path, group: Group) -> None:
    """Rows for the photographs of a group, in their order: extraction on several threads would number them
    as it happens, and what follows depends on the numbers."""
    with pycolmap.Database.open(database) as opened:
        known = {image.name: image.camera_id for image in opened.read_all_images()}
    lacking = [name for name in group.names if name not in known]
    if lacking:
        pycolmap.import_images(
            database_path=database,
            image_path=images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=lacking,
            options=_reader(group, known.get(group.names[0], -1), images.with_name(MASKS)),
        )


def _reader(group: Group, camera_id: int, masks: Path) -> "pycolmap.ImageReaderOptions":
    """Options to take in photographs of a group; with -1 COLMAP makes a new camera for them."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = group.model
    reader.camera_params = group.params
    reader.existing_camera_id = camera_id
    if masks.is_dir():
        reader.mask_path = masks
    return reader


def _extract(database: Path, images: Path, group: Group, names: Sequence[str]) -> None:
    with pycolmap.Database.open(database) as opened:
        known = {image.name: image for image in opened.read_all_images()}
        lacking = [n for n in names if n not in known or not opened.exists_keypoints(known[n].image_id)]
    if not lacking:
        return
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = FEATURES
    options.sift.first_octave = -1 if group.side <= SMALL_SIDE else 0
    pycolmap.extract_features(
        database_path=database,
        image_path=images,
        image_names=lacking,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=_reader(group, known[group.names[0]].camera_id, images.with_name(MASKS)),
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def pairs_by_name(names: Sequence[str]) -> list[Pair]:
    """Every pair of up to `EXHAUSTIVE_LIMIT` photographs; of more, each with its next neighbours in name
    order and with those at distances 16, 32, 64 ..., which closes loops."""
    count = len(names)
    if count <= EXHAUSTIVE_LIMIT:
        return [(names[i], names[j]) for i in range(count) for j in range(i + 1, count)]
    steps = [*range(1, SEQUENTIAL_OVERLAP + 1), *(1 << k for k in range(4, count.bit_length()))]
    return [(names[i], names[i + step]) for i in range(count) for step in steps if i + step < count]


def match_features(folder: Path, pairs: Sequence[Pair], progress: Progress) -> None:
    """Match and verify `pairs` into the database; pairs it has are kept."""
    lacking = _unmatched(folder / "database.db", pairs)
    done = len(pairs) - len(lacking)
    for start in range(0, len(lacking), MATCH_BATCH):
        progress("matching photographs", (done + start) / len(pairs))
        batch = lacking[start : start + MATCH_BATCH]
        listing = folder / "pairs.txt"
        listing.write_text("".join(f"{first} {second}\n" for first, second in batch))
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listing
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = 0
        pycolmap.match_image_pairs(
            database_path=folder / "database.db",
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    progress("matching photographs", 1.0)


def _unmatched(database: Path, pairs: Sequence[Pair]) -> list[Pair]:
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        return [(a, b) for a, b in pairs if not opened.exists_two_view_geometry(ids[a], ids[b])]


def triangulate(folder: Path, names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """Points from matched features and known pinhole cameras, which stay fixed; written to ``sparse``."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(folder / "database.db") as database:
        for name, camera in zip(names, cameras, strict=True):
            row = database.read_image_with_name(name)
            if row.camera_id not in model.cameras:
                model.add_camera_with_trivial_rig(database.read_camera(row.camera_id))
            image = pycolmap.Image(name=name, camera_id=row.camera_id, image_id=row.image_id)
            pose = pycolmap.Rigid3d(np.ascontiguousarray(camera.world_to_camera[:3]))
            model.add_image_with_trivial_frame(image, pose)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.triangulation.random_seed = 0
    options.num_threads = 1
    attempts = folder / "attempts"
    attempts.mkdir(exist_ok=True)
    result = pycolmap.triangulate_points(
        reconstruction=model,
        database_path=folder / "database.db",
        image_path=folder / "images",
        output_path=attempts,
        options=options,
    )
    store_model(result, folder)


def store_model(model: "pycolmap.Reconstruction", folder: Path) -> None:
    """Write the model as ``sparse``, which exists only when it is whole, and drop what led to it.

    pycolmap says nothing where the disk takes only a part, so that what was written is read. OSError then.
    """
    unfinished = folder / "sparse.part"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    model.write_binary(unfinished)
    try:
        written = read_model(unfinished)
    except FormatError:
        raise _disk_full(folder) from None
    if len(written.points) != model.num_points3D():
        raise _disk_full(folder)
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    unfinished.rename(folder / "sparse")
    for name in ("database.db", "pairs.txt"):
        (folder / name).unlink(missing_ok=True)
    for name in ("images", MASKS, "attempts"):
        shutil.rmtree(folder / name, ignore_errors=True)


# Cameras from matched photographs: COLMAP's mapper in several ways, of which the best result is kept.
#
# The usual way begins with two photographs that see the same things from well apart, which a walk straight
# ahead does not have; the others begin with less, or place all photographs at once.

ENOUGH = 0.9  # share of the photographs; with fewer located the next way is tried
ASTRAY, ASTRAY_GUESS = 2.0, 4.0  # times the focal length of EXIF data, and a normal lens's without them
TIE = 0.05  # of the reprojection error: ways that end at the same cameras differ by 1 to 2 %
FEWEST_POINTS = 30  # that hold a camera; the incremental mapper demands as many, the global one none
# For first pairs of a walk straight ahead: degrees between rays, share of motion that is forward, matches.
_CLOSE_PAIRS = {"init_min_tri_angle": 4.0, "init_max_forward_motion": 1.0, "init_min_num_inliers": 50}
# For long walks: each photograph shares little with those before it, and what it shares lies far ahead.
_FEW_SHARED = _CLOSE_PAIRS | {
    "init_min_tri_angle": 2.0,
    "abs_pose_min_num_inliers": FEWEST_MATCHES,
    "abs_pose_min_inlier_ratio": 0.1,
    "filter_min_tri_angle": 0.5,
}

Model: TypeAlias = pycolmap.Reconstruction


def map_cameras(folder: Path, count: int, progress: Progress) -> None:
    """Locate the `count` photographs of a workspace that was matched.

    Ways are tried until one locates `ENOUGH`; the best model (see `best_model`) becomes ``sparse``. Where no
    two could be located there is none.
    """
    best: Model | None = None
    astray: Model | None = None
    for number, way in enumerate(WAYS):
        attempts = folder / "attempts" / str(number)
        attempts.mkdir(parents=True, exist_ok=True)
        models = list(way(folder, attempts, _counted(count, progress)))
        lost = [model for model in models if is_astray(model, folder)]
        best = best_model(best, (model for model in models if model not in lost))
        astray = best_model(astray, lost)
        if best is not None and len(located_names(best)) >= ENOUGH * count:
            break
    if astray and (best is None or 2 * len(located_names(best)) < len(located_names(astray))):
        best = astray
    keep_matches(folder)
    if best is not None:
        store_model(best, folder)
    progress("locating cameras", 1.0)


def is_astray(model: Model, folder: Path) -> bool:
    """True where a focal length ended far from what EXIF data say, or without them from any lens: on a walk
    as on rails another one explains the photographs as well, in a world of another depth."""
    with pycolmap.Database.open(folder / "database.db") as database:
        before = {camera.camera_id: camera for camera in database.read_all_cameras()}
    return any(
        abs(math.log(camera.mean_focal_length() / before[number].mean_focal_length()))
        > math.log(ASTRAY if before[number].has_prior_focal_length else ASTRAY_GUESS)
        for number, camera in model.cameras.items()
    )


def _counted(count: int, progress: Progress) -> Callable[[], None]:
    """To be called for every photograph that is placed; the first call says that the work begins."""
    placed = -1

    def advance() -> None:
        nonlocal placed
        placed += 1
        progress("locating cameras", min(placed / count, 0.99))

    advance()
    return advance


def best_model(best: Model | None, models: Iterable[Model]) -> Model | None:
    """The best of `best` and `models`: one that locates more than those before it, or as many with a
    reprojection error that is less by more than `TIE`. Badly held photographs are taken out."""
    most, least = (0, 0.0) if best is None else _worth(best)
    for model in models:
        _take_out_the_badly_held(model)
        count, error = _worth(model)
        if count > most or (count == most and error < (1 - TIE) * least):
            best, most, least = model, count, error
    return best


def _worth(model: Model) -> tuple[int, float]:
    """Number of located photographs, and the mean reprojection error, px."""
    return len(located_names(model)), float(model.compute_mean_reprojection_error())


def located_names(model: Model) -> set[str]:
    """Photographs that have a camera, by their names in the workspace."""
    return {image.name for image in model.images.values() if image.has_pose}


def _take_out_the_badly_held(model: Model) -> None:
    """Cameras that see fewer than `FEWEST_POINTS`: where they stand is a guess."""
    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < FEWEST_POINTS:
            model.deregister_frame(image.frame_id)


def _incremental(
    folder: Path,
    attempts: Path,
    advance: Callable[[], None],
    limits: dict[str, float],
    focal: Literal["refined", "of EXIF", "guessed"] = "refined",
) -> Collection[Model]:
    """One photograph after the other, onto a first pair. `limits`: of COLMAP's mapper. `focal`: lengths that
    EXIF data say of all photographs stay as they are, or those which no EXIF data say stay a normal lens's:
    what lies far ahead looks much the same from any distance through another lens."""
    known = focal != "refined" and _all_focal_lengths_known(folder)
    if focal == "guessed" and known:  # as before
        return []
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.max_num_models = 5
    options.random_seed = 0
    options.triangulation.random_seed = 0
    options.num_threads = 1  # sums of several threads differ from run to run
    options.mapper.mergedict(limits)
    if known or focal == "guessed":
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    models: dict[int, Model] = pycolmap.incremental_mapping(
        database_path=folder / "database.db",
        image_path=folder / "images",
        output_path=attempts,
        options=options,
        next_image_callback=advance,
    )
    return models.values()


def _all_focal_lengths_known(folder: Path) -> bool:
    with pycolmap.Database.open(folder / "database.db") as database:
        return all(camera.has_prior_focal_length for camera in database.read_all_cameras())


def _all_at_once(folder: Path, attempts: Path, advance: Callable[[], None]) -> Collection[Model]:
    """Rotations of all photographs first, then their places (GLOMAP)."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.num_threads = 1
    mapper = options.mapper
    mapper.random_seed = 0
    mapper.num_threads = 1
    mapper.rotation_averaging.random_seed = 0
    mapper.global_positioning.random_seed = 0
    mapper.retriangulation.random_seed = 0
    mapper.global_positioning.use_gpu = False
    mapper.bundle_adjustment.ceres.use_gpu = False
    models: dict[int, Model] = pycolmap.global_mapping(
        database_path=folder / "database.db",
        image_path=folder / "images",
        output_path=attempts,
        options=options,
    )
    return models.values()


WAYS: tuple[Callable[[Path, Path, Callable[[], None]], Collection[Model]], ...] = (
    partial(_incremental, limits={}),
    partial(_incremental, limits=_CLOSE_PAIRS),
    _all_at_once,
    partial(_incremental, limits=_FEW_SHARED, focal="of EXIF"),
    partial(_incremental, limits=_FEW_SHARED, focal="guessed"),
)


def keep_matches(folder: Path) -> None:
    """Write what `read_matches` reads: the database does not outlive the model."""
    with pycolmap.Database.open(folder / "database.db") as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        features = {name: database.num_keypoints_for_image(number) for number, name in names.items()}
        pairs, inliers = database.read_two_view_geometry_num_inliers()
    ends = [[names[number] for number in pycolmap.pair_id_to_image_pair(pair)] for pair in pairs]
    kept = [[*end, int(count)] for end, count in zip(ends, inliers, strict=True) if count]
    with atomic_path(folder / MATCHES) as temporary:
        temporary.write_text(json.dumps({"features": features, "pairs": sorted(kept)}))


# A plain folder of photographs: cameras by structure from motion.

log = logging.getLogger("langsplat")

SFM_SIDE = 1600  # px, longer side of the copies that features are sought in
MIN_PHOTOS = 3
FEWEST = 0.5  # share of the photographs: a scene of fewer is not of what was photographed


@dataclass(frozen=True)
class _Copy:
    """A small upright copy of a photograph in the workspace."""

    name: str
    size: tuple[int, int]
    optics: str  # maker, camera and focal length: photographs with the same share a camera


def photo_folder(folder: Path) -> Path | None:
    """Folder of the photographs of a dataset without cameras: `folder` itself or one level down."""
    candidates = (folder, folder / "images", folder / "photos")
    return next((candidate for candidate in candidates if find_photos(candidate)), None)


def load_photos(
    folder: Path, max_side: int, allow_few_cameras: bool, work: Path, progress: Progress
) -> Capture:
    """Locate the photographs in `folder` (kept in ``work/sfm-*``) and load them; see `load_capture`."""
    paths = find_photos(folder)
    if len(paths) < MIN_PHOTOS:
        raise InputError(
            f"{folder} has {len(paths)} photographs; at least {MIN_PHOTOS} are needed, each sharing "
            "at least two thirds of its view with the next"
        )
    contents = [(path.name, _content(path)) for path in paths]
    masked = [(path.name, _content(mask)) for path in paths if (mask := mask_beside(path))]
    workspace = open_workspace(work, ["photographs", 4, SFM_SIDE, contents, *([masked] if masked else [])])
    files = numbered(paths)
    if not has_model(workspace / "sparse"):
        _reconstruct(workspace, files, progress)
    model = read_model(workspace / "sparse") if has_model(workspace / "sparse") else None
    matches = read_matches(workspace, files, {image.name for image in model.images} if model else ())
    lost = _left_out(matches, contents)
    found = len(matches.located)
    if model is None or (found < max(MIN_PHOTOS, FEWEST * len(files)) and not allow_few_cameras):
        anyway = "" if model is None else ", or go on without these with --dataset.allow-few-cameras"
        raise NotLocatedError(
            f"only {found} of {len(files)} photographs could be located together "
            f"({_listed(lost, 10)}); {matches.joined()}{matches.advice()}{anyway}",
            matches,
        )
    if lost:
        log.warning(
            "%d of %d photographs could not be located and are left out (%s); %s",
            len(files) - found,
            len(files),
            _listed(lost),
            matches.advice(),
        )
    located = located_photos(model, workspace / "images", workspace / "sparse")
    photos = [
        Photo(path, path.name, p.intrinsics, p.world_to_camera, upright=True, mask=mask_beside(path))
        for p, path in ((p, files[p.label]) for p in located)
    ]
    cameras, images, kept, masks = develop(photos, max_side, progress)
    return Capture(cameras, images, *good_points(model), photos=kept, masks=masks, matches=matches)


def numbered(paths: Sequence[Path]) -> dict[str, Path]:
    """Photographs by their names in the workspace."""
    return {f"{index:05d}.jpg": path for index, path in enumerate(paths)}


def _content(path: Path) -> str:
    """A digest of a file: photographs that were copied, moved or touched are the same. Empty for one that may
    not be read, which is reported where it is opened."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _left_out(matches: Matches, contents: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    """Photographs without a camera by the reason: ``{"no features": ["a.jpg", "b.jpg"]}``; `contents`: names
    and digests of all."""
    first: dict[str, str] = {}
    groups: dict[str, list[str]] = {}
    for row, (name, content) in enumerate(contents):
        twin = first.setdefault(content, name)
        if row not in matches.located:
            why = matches.why(row) if twin == name else f"the same picture as {twin}"
            groups.setdefault(why, []).append(name)
    return groups


def _listed(lost: dict[str, list[str]], limit: int = 5, width: int = 200) -> str:
    """``no features: a.jpg, b.jpg; no matches with any other: c.jpg``; see `shortened`."""
    return "; ".join(f"{reason}: {shortened(names, limit, width)}" for reason, names in lost.items())


def _reconstruct(workspace: Path, numbered: dict[str, Path], progress: Progress) -> None:
    try:
        run_apart(_locate, workspace, numbered, workspace=workspace, progress=progress)
    except FAILURES as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"structure from motion failed ({reason}); remove {workspace} and try again"
        ) from None


def _locate(workspace: Path, numbered: dict[str, Path], progress: Progress) -> None:
    map_cameras(workspace, match_photos(workspace, numbered, progress), progress)


def match_photos(workspace: Path, numbered: dict[str, Path], progress: Progress) -> int:
    """Features and matches of photographs into the workspace's database; how many could be read."""
    copies = _small_copies(workspace / "images", numbered, progress)
    extract_features(workspace, _groups(copies), progress)
    match_features(workspace, pairs_by_name([copy.name for copy in copies]), progress)
    return len(copies)


def _small_copies(folder: Path, numbered: dict[str, Path], progress: Progress) -> list[_Copy]:
    """Copies that COLMAP can read and finds the same way up as we do; unreadable files are left out."""
    copies, broken = [], []
    any_masks = any(map(mask_beside, numbered.values()))
    for index, (name, path) in enumerate(numbered.items()):
        progress("preparing photographs", index / len(numbered))
        try:
            if not (folder / name).is_file():
                _write_copy(path, folder / name)
            if any_masks and not (folder.with_name(MASKS) / f"{name}.png").is_file():
                _write_mask(mask_beside(path), folder / name, folder.with_name(MASKS) / f"{name}.png")
            with opened(folder / name) as copy:
                exif = copy.getexif()
                lens = str(dict(exif) | dict(exif.get_ifd(EXIF_IFD)))
                copies.append(_Copy(name, copy.size, lens))
        except PictureError as error:
            broken.append(f"{path.name} ({error.reason})")
    progress("preparing photographs", 1.0)
    if broken:
        log.warning("%d photographs cannot be read: %s", len(broken), shortened(broken))
    if len(copies) < MIN_PHOTOS:
        raise InputError(f"only {len(copies)} photographs can be read; at least {MIN_PHOTOS} are needed")
    return copies


def _write_copy(path: Path, copy: Path) -> None:
    picture = read_photo(path, upright=True)
    picture.thumbnail((SFM_SIDE, SFM_SIDE), Image.Resampling.LANCZOS)
    with atomic_path(copy) as temporary:
        picture.save(temporary, quality=95, exif=optics(path))


def _write_mask(mask: Path | None, copy: Path, out: Path) -> None:
    """A mask as COLMAP reads it, as large as the copy of its photograph; white for one without: where some
    have a mask, COLMAP finds nothing in those that have none."""
    with opened(copy) as picture:
        white = Image.new("L", picture.size, 255)
    seen = white if mask is None else read_photo(mask, upright=False).convert("L")
    out.parent.mkdir(exist_ok=True)
    with atomic_path(out) as temporary:
        seen.resize(white.size, Image.Resampling.NEAREST).save(temporary)


def _groups(copies: list[_Copy]) -> list[Group]:
    """One camera for all photographs of one size and one set of optics."""
    members: dict[tuple[tuple[int, int], str], list[str]] = {}
    for copy in copies:
        members.setdefault((copy.size, copy.optics), []).append(copy.name)
    return [Group(tuple(names), "SIMPLE_RADIAL", side=max(size)) for (size, _), names in members.items()]

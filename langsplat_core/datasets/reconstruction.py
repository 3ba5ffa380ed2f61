"""Structure from motion by pycolmap: features, matches, cameras and points, in steps that report and resume.

pycolmap may abort the process that it runs in, so this module is imported in a process of its own
(`workspace.run_apart`). The database of a workspace keeps what was computed, so an interrupted run goes on,
and within one machine ends with the same cameras, byte for byte: photographs are numbered in the order of
their names, every random choice has its seed, and what adds up over photographs runs on one thread. Others do
whole photographs or pairs, on all cores. Another processor may find other matches.
"""

import itertools
import json
import math
import shutil
import signal
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pycolmap

from langsplat_core.datasets import workspace
from langsplat_core.datasets.colmap import read_model
from langsplat_core.errors import FormatError
from langsplat_core.io.files import write_whole
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

pycolmap.logging.minloglevel = 3  # where it aborts, its reason is the last thing it says
if threading.current_thread() is threading.main_thread():  # Python sets handlers there alone
    for _number in (signal.SIGTERM, signal.SIGABRT):  # its logging library's own print a stack trace
        signal.signal(_number, signal.getsignal(_number) or signal.SIG_DFL)

FEATURES = 8192  # per photograph
EXTRACT_BATCH = 8  # photographs per step: a step is the unit of progress and of resuming
MATCH_BATCH = 64  # pairs per step

Model: TypeAlias = pycolmap.Reconstruction


def opened(folder: Path) -> Any:
    """Return the database of a workspace, opened, as a context manager."""
    return pycolmap.Database.open(folder / "database.db")


def extract_features(folder: Path, groups: Sequence[workspace.CameraGroup], progress: Progress) -> None:
    """Put SIFT features of every photograph of `groups` into the database; those it has are kept."""
    paths = {"database_path": folder / "database.db", "image_path": folder / "images"}
    readers = []
    # Rows first, in the order of the names: extraction on several threads would number photographs as it
    # happens, and what follows depends on the numbers.
    for group in groups:
        with opened(folder) as database:
            known = {image.name: image.camera_id for image in database.read_all_images()}
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model, reader.camera_params = group.model, group.params
        reader.existing_camera_id = known.get(group.names[0], -1)  # -1: a new camera
        if (folder / workspace.MASKS).is_dir():
            reader.mask_path = folder / workspace.MASKS
        readers.append(reader)
        if lacking := [name for name in group.names if name not in known]:
            mode = pycolmap.CameraMode.SINGLE
            pycolmap.import_images(**paths, camera_mode=mode, image_names=lacking, options=reader)
    with opened(folder) as database:
        rows = {image.name: image for image in database.read_all_images()}
        lacking = [name for name, row in rows.items() if not database.exists_keypoints(row.image_id)]
    total, done = sum(len(group.names) for group in groups), 0
    for group, reader in zip(groups, readers, strict=True):
        reader.existing_camera_id = rows[group.names[0]].camera_id
        options = pycolmap.FeatureExtractionOptions()
        options.sift.max_num_features = FEATURES
        options.sift.first_octave = -1 if group.doubled else 0
        for start in range(0, len(group.names), EXTRACT_BATCH):
            progress("finding features", done / total)
            names = group.names[start : start + EXTRACT_BATCH]
            done += len(names)
            if missing := [name for name in names if name in lacking]:
                pycolmap.extract_features(
                    **paths,
                    image_names=missing,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                )
    progress("finding features", 1.0)


def match_features(folder: Path, pairs: Sequence[workspace.Pair], progress: Progress) -> None:
    """Match and verify `pairs` into the database; pairs it has are kept."""
    with opened(folder) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        lacking = [(a, b) for a, b in pairs if not database.exists_two_view_geometry(ids[a], ids[b])]
    done = len(pairs) - len(lacking)
    for start in range(0, len(lacking), MATCH_BATCH):
        progress("matching photographs", (done + start) / len(pairs))
        batch = lacking[start : start + MATCH_BATCH]
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = folder / "pairs.txt"
        lines = "".join(f"{first} {second}\n" for first, second in batch)
        pairing.match_list_path.write_text(lines, encoding="utf-8")
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = 0
        pycolmap.match_image_pairs(
            database_path=folder / "database.db",
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    progress("matching photographs", 1.0)


def triangulate(folder: Path, names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """Write points from matched features and known pinhole cameras, which stay fixed, to ``sparse``."""
    model = Model()
    with opened(folder) as database:
        for name, camera in zip(names, cameras, strict=True):
            row = database.read_image_with_name(name)
            if row.camera_id not in model.cameras:
                model.add_camera_with_trivial_rig(database.read_camera(row.camera_id))
            image = pycolmap.Image(name=name, camera_id=row.camera_id, image_id=row.image_id)
            pose = pycolmap.Rigid3d(np.ascontiguousarray(camera.world_to_camera[:3]))
            model.add_image_with_trivial_frame(image, pose)
    attempts = folder / "attempts"
    attempts.mkdir(exist_ok=True)
    paths = _paths(folder, attempts)
    result = pycolmap.triangulate_points(reconstruction=model, **paths, options=_repeatable())
    store_model(result, folder)


def _paths(folder: Path, attempts: Path) -> dict[str, Path]:
    return {"database_path": folder / "database.db", "image_path": folder / "images", "output_path": attempts}


def _repeatable() -> "pycolmap.IncrementalPipelineOptions":
    """Return options with seeds, and one thread: sums of several threads differ from run to run."""
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.triangulation.random_seed = 0
    options.num_threads = 1
    return options


def store_model(model: Model, folder: Path) -> None:
    """Write the model as ``sparse``, which exists only when it is whole, and drop what led to it.

    pycolmap does not report a full disk, so the written model is read back; OSError if it is incomplete.
    """
    unfinished = folder / "sparse.part"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    model.write_binary(unfinished)
    try:
        written = read_model(unfinished)
    except FormatError:
        raise workspace.disk_full(folder) from None
    if len(written.points) != model.num_points3D():
        raise workspace.disk_full(folder)
    (unfinished / workspace.DIGEST).write_text(workspace.digest_of_model(unfinished), encoding="utf-8")
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    unfinished.rename(folder / "sparse")
    for name in ("database.db", "pairs.txt"):
        (folder / name).unlink(missing_ok=True)
    for name in ("images", workspace.MASKS, "attempts"):
        shutil.rmtree(folder / name, ignore_errors=True)


# Cameras from matched photographs: COLMAP's mapper with several settings, of which the best result is kept.
#
# The usual one begins with two photographs that see the same things from well apart, which a walk straight
# ahead does not have; the others begin with less, or place all photographs at once.

ENOUGH = 0.9  # share of the photographs; with fewer located the next method is tried
ASTRAY, ASTRAY_GUESS = 2.0, 4.0  # largest factor off the focal length of EXIF data, or of a normal lens
TIE = 0.05  # of the reprojection error: methods that end at the same cameras differ by 1 to 2 %
FEWEST_POINTS = 30  # that a located camera sees; the incremental mapper demands as many, the global one none
FIRM_POINTS = 100  # that a firmly located camera sees
# For first pairs of a walk straight ahead: degrees between rays, share of motion that is forward, matches.
_CLOSE_PAIRS = {"init_min_tri_angle": 4.0, "init_max_forward_motion": 1.0, "init_min_num_inliers": 50}
# For long walks: each photograph shares little with those before it, and what it shares lies far ahead.
_FEW_SHARED = _CLOSE_PAIRS | {
    "init_min_tri_angle": 2.0,
    "abs_pose_min_num_inliers": workspace.FEWEST_MATCHES,
    "abs_pose_min_inlier_ratio": 0.1,
    "filter_min_tri_angle": 0.5,
}


def map_cameras(folder: Path, count: int, progress: Progress, firmly: bool = False) -> bool:
    """Locate the `count` photographs of a workspace that was matched; return whether there is a model.

    `MAPPERS` are tried until one locates `ENOUGH`; the best model, if two are located, becomes ``sparse``.
    firmly: by the first mapper alone, where `FIRM_POINTS` or more hold each of the photographs.
    """
    best: Model | None = None
    astray: Model | None = None
    for number, mapper in enumerate(MAPPERS[:1] if firmly else MAPPERS):
        attempts = folder / "attempts" / str(number)
        attempts.mkdir(parents=True, exist_ok=True)
        progress("locating cameras", 0.0)
        models = list(mapper(folder, attempts, partial(_placed, itertools.count(1), count, progress)))
        lost = [model for model in models if is_astray(model, folder)]
        best = best_model(best, (model for model in models if model not in lost))
        astray = best_model(astray, lost)
        if best is not None and len(located_names(best)) >= ENOUGH * count:
            break
    firm = 0 if best is None else sum(seen.num_points3D >= FIRM_POINTS for seen in best.images.values())
    if firmly and firm < count:
        return False
    if astray and (best is None or 2 * len(located_names(best)) < len(located_names(astray))):
        best = astray
    keep_matches(folder)
    if best is not None:
        store_model(best, folder)
    progress("locating cameras", 1.0)
    return best is not None


def _placed(places: Iterator[int], count: int, progress: Progress) -> None:
    progress("locating cameras", min(next(places) / count, 0.99))


def is_astray(model: Model, folder: Path) -> bool:
    """Return True if a focal length is far from that of EXIF data or, without them, of a normal lens.

    On a walk as on rails another focal length explains the photographs as well, in a world of another depth.
    """
    with opened(folder) as database:
        before = {camera.camera_id: camera for camera in database.read_all_cameras()}
    return any(
        abs(math.log(camera.mean_focal_length() / before[number].mean_focal_length()))
        > math.log(ASTRAY if before[number].has_prior_focal_length else ASTRAY_GUESS)
        for number, camera in model.cameras.items()
    )


def best_model(best: Model | None, models: Iterable[Model]) -> Model | None:
    """Return the best of `best` and `models`.

    A model is better if it locates more photographs, or as many with a reprojection error that is less by
    more than `TIE`. Cameras that see fewer than `FEWEST_POINTS` are taken out: their position is a guess.
    """
    most, least = (0, 0.0) if best is None else _worth(best)
    for model in models:
        for image in list(model.images.values()):
            if image.has_pose and image.num_points3D < FEWEST_POINTS:
                model.deregister_frame(image.frame_id)
        count, error = _worth(model)
        if count > most or (count == most and error < (1 - TIE) * least):
            best, most, least = model, count, error
    return best


def _worth(model: Model) -> tuple[int, float]:
    return len(located_names(model)), float(model.compute_mean_reprojection_error())


def located_names(model: Model) -> set[str]:
    """Return photographs that have a camera, by their names in the workspace."""
    return {image.name for image in model.images.values() if image.has_pose}


def _incremental(
    folder: Path,
    attempts: Path,
    advance: Callable[[], None],
    limits: dict[str, float],
    focal: Literal["refined", "of EXIF", "guessed"] = "refined",
) -> Collection[Model]:
    """Place one photograph after the other, onto a first pair.

    limits: of COLMAP's mapper; focal: "of EXIF" keeps focal lengths that EXIF data give for all photographs,
    "guessed" a normal lens's where they do not: what lies far ahead tells little of the lens.
    """
    with opened(folder) as database:
        known = all(camera.has_prior_focal_length for camera in database.read_all_cameras())
    if focal == "guessed" and known:  # as with "of EXIF"
        return []
    options = _repeatable()
    options.min_model_size = 3
    options.max_num_models = 5
    options.mapper.mergedict(limits)
    if focal == "guessed" or (focal == "of EXIF" and known):
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    models: dict[int, Model] = pycolmap.incremental_mapping(
        **_paths(folder, attempts), options=options, next_image_callback=advance
    )
    return models.values()


def _all_at_once(folder: Path, attempts: Path, advance: Callable[[], None]) -> Collection[Model]:
    """Find the rotations of all photographs first, then their places (GLOMAP)."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    mapper = options.mapper
    stages = mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation
    for seeded in (options, mapper, *stages):
        seeded.random_seed = 0
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    models: dict[int, Model] = pycolmap.global_mapping(**_paths(folder, attempts), options=options)
    return models.values()


MAPPERS: tuple[Callable[[Path, Path, Callable[[], None]], Collection[Model]], ...] = (
    partial(_incremental, limits={}),
    partial(_incremental, limits=_CLOSE_PAIRS),
    _all_at_once,
    partial(_incremental, limits=_FEW_SHARED, focal="of EXIF"),
    partial(_incremental, limits=_FEW_SHARED, focal="guessed"),
)


def keep_matches(folder: Path) -> None:
    """Write the graph of matches for `read_matches`: the database is deleted once there is a model."""
    with opened(folder) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        features = {name: database.num_keypoints_for_image(number) for number, name in names.items()}
        pairs, inliers = database.read_two_view_geometry_num_inliers()
    ends = [[names[number] for number in pycolmap.pair_id_to_image_pair(pair)] for pair in pairs]
    kept = [[*end, int(count)] for end, count in zip(ends, inliers, strict=True) if count]
    write_whole(folder / workspace.MATCHES, json.dumps({"features": features, "pairs": sorted(kept)}))

"""Cameras from matched photographs: COLMAP's mapper in several ways, of which the best result is kept.

The usual way begins with two photographs that see the same things from well apart, which a walk straight
ahead does not have; the others begin with less, or place all photographs at once.
"""

import json
from collections.abc import Callable, Collection, Iterable
from functools import partial
from pathlib import Path
from typing import TypeAlias

from langsplat_core.datasets.colmap_library import pycolmap
from langsplat_core.datasets.sfm import check_room, store_model
from langsplat_core.files import atomic_path
from langsplat_core.progress import Progress

ENOUGH = 0.9  # share of the photographs; with fewer located the next way is tried
TIE = 0.05  # of the reprojection error: ways that end at the same cameras differ by 1 to 2 %
FEWEST_MATCHES = 15  # that COLMAP's mapper works with
FEWEST_POINTS = 30  # that hold a camera; the incremental mapper demands as many, the global one none
FEWEST_FEATURES = 50  # fewer rarely give `FEWEST_MATCHES`
LEFT_OUT = "left_out.json"  # in the workspace: which photographs have no camera, and why
# For first pairs of a walk straight ahead: degrees between rays, share of motion that is forward, matches.
_CLOSE_PAIRS = {"init_min_tri_angle": 4.0, "init_max_forward_motion": 1.0, "init_min_num_inliers": 50}

Model: TypeAlias = pycolmap.Reconstruction


def map_cameras(folder: Path, count: int, progress: Progress) -> None:
    """Locate the `count` photographs of a workspace that was matched.

    Ways are tried until one locates `ENOUGH`; the best model (see `best_model`) becomes ``sparse``. Where no
    two could be located there is none.
    """
    best: Model | None = None
    for number, way in enumerate(WAYS):
        check_room(folder)
        attempts = folder / "attempts" / str(number)
        attempts.mkdir(parents=True, exist_ok=True)
        best = best_model(best, way(folder, attempts, _counted(count, progress)))
        if best is not None and len(located_names(best)) >= ENOUGH * count:
            break
    write_left_out(folder, set() if best is None else located_names(best))
    if best is not None:
        store_model(best, folder)
    progress("locating cameras", 1.0)


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
    """How many photographs are located, and the mean reprojection error, px."""
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
    folder: Path, attempts: Path, advance: Callable[[], None], first_pairs: dict[str, float]
) -> Collection[Model]:
    """One photograph after the other, onto a first pair."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.max_num_models = 5
    options.random_seed = 0
    options.triangulation.random_seed = 0
    options.num_threads = 1  # sums of several threads differ from run to run
    options.mapper.mergedict(first_pairs)
    models: dict[int, Model] = pycolmap.incremental_mapping(
        database_path=folder / "database.db",
        image_path=folder / "images",
        output_path=attempts,
        options=options,
        next_image_callback=advance,
    )
    return models.values()


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
    partial(_incremental, first_pairs={}),
    partial(_incremental, first_pairs=_CLOSE_PAIRS),
    _all_at_once,
)


def left_out(folder: Path) -> dict[str, str]:
    """Why photographs have no camera, by their names in the workspace, after `map_cameras`."""
    why: dict[str, str] = json.loads((folder / LEFT_OUT).read_text())
    return why


def write_left_out(folder: Path, located: Collection[str]) -> None:
    """Keep why photographs are not among the `located`; see `left_out`."""
    with pycolmap.Database.open(folder / "database.db") as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        features = {number: database.num_keypoints_for_image(number) for number in names}
        pairs, inliers = database.read_two_view_geometry_num_inliers()
    friends: dict[int, int] = dict.fromkeys(names, 0)
    for pair, count in zip(pairs, inliers, strict=True):
        if count >= FEWEST_MATCHES:
            for number in pycolmap.pair_id_to_image_pair(pair):
                friends[number] += 1
    why = {
        name: _reason(features[number], friends[number])
        for number, name in names.items()
        if name not in located
    }
    with atomic_path(folder / LEFT_OUT) as temporary:
        temporary.write_text(json.dumps(why, sort_keys=True))


def _reason(features: int, friends: int) -> str:
    """In words, from the number of features and of photographs that share enough of them."""
    if features == 0:
        return "no features (nothing but plain areas, or blurred)"
    if features < FEWEST_FEATURES:
        return "too few features (plain, dark, blurred or tiny)"
    if friends == 0:
        return "no matches with any other"
    return "matched, but from one and the same place, or without enough overlap"

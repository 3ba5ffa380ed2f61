"""pycolmap, wrapped: features, matches, mapping and triangulation, in steps that report and resume.

A *workspace* is a folder with small copies of the photographs (``images``), COLMAP's ``database.db`` and,
in the end, the model (``sparse``). The database keeps what was computed, so an interrupted run goes on.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from langsplat_core.datasets.colmap_library import pycolmap
from langsplat_core.files import atomic_path
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

EXHAUSTIVE_LIMIT = 80  # photographs; beyond, matching every pair costs too much
SEQUENTIAL_OVERLAP = 10  # neighbours in name order that each photograph is matched with
FEATURES = 8192  # per photograph
SMALL_SIDE = 1000  # px; smaller photographs are doubled before features are sought, as SIFT proposes
EXTRACT_BATCH = 8  # photographs per step: a step is the unit of progress and of resuming
MATCH_BATCH = 64  # pairs per step
FAILURES = (RuntimeError, ValueError, IndexError, OSError)  # what pycolmap raises

Pair = tuple[str, str]


@dataclass(frozen=True)
class Group:
    """Photographs of one size that share one camera."""

    names: tuple[str, ...]  # file names in the workspace's images folder
    model: str  # COLMAP's camera model
    params: str = ""  # its parameters, comma-separated; empty: guessed from EXIF data or the size
    side: int = 0  # longer side, pixels


def open_workspace(work: Path, inputs: object) -> Path:
    """``work/sfm``, emptied first unless it was made for the same `inputs` (anything JSON can hold)."""
    folder = work / "sfm"
    stamp, text = folder / "inputs.json", json.dumps(inputs, sort_keys=True)
    if not (stamp.is_file() and stamp.read_text() == text):
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "images").mkdir(parents=True)
        with atomic_path(stamp) as temporary:
            temporary.write_text(text)
    pycolmap.logging.minloglevel = 3  # its log lines would tear the progress bars apart
    return folder


def extract_features(folder: Path, groups: Sequence[Group], progress: Progress) -> None:
    """SIFT features of every photograph of `groups` into the database; those it has are kept."""
    database = folder / "database.db"
    total, done = sum(len(group.names) for group in groups), 0
    for group in groups:
        for start in range(0, len(group.names), EXTRACT_BATCH):
            progress("finding features", done / total)
            names = group.names[start : start + EXTRACT_BATCH]
            _extract(database, folder / "images", group, names)
            done += len(names)
    progress("finding features", 1.0)


def _extract(database: Path, images: Path, group: Group, names: Sequence[str]) -> None:
    camera_id = -1  # COLMAP makes a new camera for the first photographs of a group
    with pycolmap.Database.open(database) as opened:
        known = {image.name: image for image in opened.read_all_images()}
        lacking = [n for n in names if n not in known or not opened.exists_keypoints(known[n].image_id)]
        if group.names[0] in known:
            camera_id = known[group.names[0]].camera_id
    if not lacking:
        return
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = FEATURES
    options.sift.first_octave = -1 if group.side <= SMALL_SIDE else 0
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = group.model
    reader.camera_params = group.params
    reader.existing_camera_id = camera_id
    pycolmap.extract_features(
        database_path=database,
        image_path=images,
        image_names=lacking,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
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


def map_cameras(folder: Path, count: int, progress: Progress) -> int:
    """Incremental structure from motion of `count` photographs; the model with most of them becomes
    ``sparse``. Returns how many it holds; with 0 there is no ``sparse``."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.max_num_models = 5
    options.random_seed = 0
    options.triangulation.random_seed = 0
    registered = 0

    def advance() -> None:
        nonlocal registered
        registered += 1
        progress("locating cameras", min(registered / count, 0.99))

    progress("locating cameras", 0.0)
    attempts = folder / "attempts"
    attempts.mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(
        database_path=folder / "database.db",
        image_path=folder / "images",
        output_path=attempts,
        options=options,
        next_image_callback=advance,
    )
    best = max(
        models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None
    )
    if best is not None:
        _store(best, folder)
    progress("locating cameras", 1.0)
    return 0 if best is None else int(best.num_reg_images())


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
    attempts = folder / "attempts"
    attempts.mkdir(exist_ok=True)
    result = pycolmap.triangulate_points(
        reconstruction=model,
        database_path=folder / "database.db",
        image_path=folder / "images",
        output_path=attempts,
        options=options,
    )
    _store(result, folder)


def _store(model: "pycolmap.Reconstruction", folder: Path) -> None:
    """Write the model as ``sparse``, which exists only when it is whole, and drop what led to it."""
    unfinished = folder / "sparse.part"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    model.write_binary(unfinished)
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    unfinished.rename(folder / "sparse")
    for name in ("database.db", "pairs.txt"):
        (folder / name).unlink(missing_ok=True)
    for name in ("images", "attempts"):
        shutil.rmtree(folder / name, ignore_errors=True)

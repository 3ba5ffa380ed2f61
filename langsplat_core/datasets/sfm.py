"""pycolmap, wrapped: features, matches and triangulation, in steps that report and resume; mapping is in
`mapping.py`.

A *workspace* is a folder with small copies of the photographs (``images``), COLMAP's ``database.db`` and,
in the end, the model (``sparse``). It is named by a digest of all that it is made from; the database keeps
what was computed, so an interrupted run goes on, and within one machine ends with the same cameras, byte for
byte: photographs are numbered in the order of their names, every random choice has its seed, and what adds up
over photographs runs on one thread. Extraction and matching use all cores: one thread does a whole photograph
or pair, and the database is the same. Another processor may round otherwise, and find other matches.
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from langsplat_core.datasets.colmap_library import pycolmap
from langsplat_core.datasets.colmap_model import read_model
from langsplat_core.errors import FormatError
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

EXHAUSTIVE_LIMIT = 80  # photographs; beyond, matching every pair costs too much
SEQUENTIAL_OVERLAP = 10  # neighbours in name order that each photograph is matched with
FEATURES = 8192  # per photograph
SMALL_SIDE = 1000  # px; smaller photographs are doubled before features are sought, as SIFT proposes
EXTRACT_BATCH = 8  # photographs per step: a step is the unit of progress and of resuming
MATCH_BATCH = 64  # pairs per step
FAILURES = (RuntimeError, ValueError, IndexError)  # what pycolmap raises
ROOM = 64_000_000  # bytes that a step may write: 8 photographs of 8192 features take 20 MB, with the journal

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
    pycolmap.logging.minloglevel = 3  # its log lines would tear the progress bars apart
    return folder


def check_room(folder: Path) -> None:
    """OSError where the disk is about full: pycolmap would end the whole process there."""
    if shutil.disk_usage(folder).free < ROOM:
        raise _disk_full(folder)


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
            check_room(folder)
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
            options=_reader(group, known.get(group.names[0], -1)),
        )


def _reader(group: Group, camera_id: int) -> "pycolmap.ImageReaderOptions":
    """How photographs of a group are taken in; with -1 COLMAP makes a new camera for them."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = group.model
    reader.camera_params = group.params
    reader.existing_camera_id = camera_id
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
        reader_options=_reader(group, known[group.names[0]].camera_id),
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
        check_room(folder)
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
    for name in ("images", "attempts"):
        shutil.rmtree(folder / name, ignore_errors=True)

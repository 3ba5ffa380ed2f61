"""A plain folder of photographs: cameras by structure from motion."""

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from langsplat_core.datasets import mapping, sfm
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.colmap import good_points, located_photos
from langsplat_core.datasets.colmap_model import SparseModel, has_model, read_model
from langsplat_core.datasets.images import Photo, develop, find_photos, read_photo, shortened
from langsplat_core.datasets.optics import optics, tags
from langsplat_core.errors import InputError
from langsplat_core.files import atomic_path
from langsplat_core.parsing.pictures import PictureError, opened
from langsplat_core.progress import Progress

log = logging.getLogger("langsplat")

SFM_SIDE = 1600  # px, longer side of the copies that features are sought in
MIN_PHOTOS = 3
FEWEST = 0.5  # share of the photographs: a scene of fewer is not of what was photographed
UNREAD = "cannot be read"
_ADVICE = "take more photographs, each sharing at least two thirds of its view with the next"


@dataclass(frozen=True)
class _Copy:
    """A small upright copy of a photograph in the workspace."""

    name: str
    size: tuple[int, int]
    optics: str  # maker, camera and focal length: photographs with the same share a camera


def photo_folder(folder: Path) -> Path | None:
    """Where the photographs of a dataset without cameras lie: in `folder` itself or one level down."""
    candidates = (folder, folder / "images", folder / "photos")
    return next((candidate for candidate in candidates if find_photos(candidate)), None)


def load_photos(
    folder: Path, max_side: int, allow_few_cameras: bool, work: Path, progress: Progress
) -> Capture:
    """Locate the photographs in `folder` (kept in ``work/sfm-*``) and load them; see `load_capture`."""
    paths = find_photos(folder)
    if len(paths) < MIN_PHOTOS:
        raise InputError(
            f"{folder} has {len(paths)} photographs; at least {MIN_PHOTOS} are needed: {_ADVICE}"
        )
    contents = [(path.name, _content(path)) for path in paths]
    workspace = sfm.open_workspace(work, ["photographs", 3, SFM_SIDE, contents])
    numbered = {f"{index:05d}.jpg": path for index, path in enumerate(paths)}
    if not has_model(workspace / "sparse"):
        _reconstruct(workspace, numbered, progress)
    model = read_model(workspace / "sparse") if has_model(workspace / "sparse") else None
    lost = _left_out(workspace, model, numbered, _twins(numbered, dict(contents)))
    found = len(numbered) - sum(map(len, lost.values()))
    if model is None or (found < max(MIN_PHOTOS, FEWEST * len(numbered)) and not allow_few_cameras):
        anyway = "" if model is None else ", or go on without these with --dataset.allow-few-cameras"
        raise InputError(
            f"only {found} of {len(numbered)} photographs could be located together "
            f"({_listed(lost, 50, 500)}); {_ADVICE}{anyway}"
        )
    if lost:
        log.warning(
            "%d of %d photographs could not be located and are left out (%s)",
            len(numbered) - found,
            len(numbered),
            _listed(lost),
        )
    located = located_photos(model, workspace / "images", workspace / "sparse")
    photos = [
        Photo(numbered[p.label], numbered[p.label].name, p.intrinsics, p.world_to_camera, upright=True)
        for p in located
    ]
    cameras, images, files = develop(photos, max_side, progress)
    return Capture(cameras, images, *good_points(model), photos=files)


def _content(path: Path) -> str:
    """A digest of a file: photographs that were copied, moved or touched are the same. Empty for one that may
    not be read, which is reported where it is opened."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _twins(numbered: dict[str, Path], contents: dict[str, str]) -> dict[str, str]:
    """For photographs that are the same as an earlier one, which: names in the workspace -> file names."""
    first: dict[str, str] = {}
    return {
        name: earlier
        for name, path in numbered.items()
        if (earlier := first.setdefault(contents[path.name], path.name)) != path.name
    }


def _left_out(
    workspace: Path, model: SparseModel | None, numbered: dict[str, Path], twins: dict[str, str]
) -> dict[str, list[str]]:
    """Photographs without a camera by the reason: ``{"no features": ["a.jpg", "b.jpg"]}``."""
    located = {image.name for image in model.images} if model else set()
    reasons = mapping.left_out(workspace)
    reasons |= {name: f"the same picture as {twin}" for name, twin in twins.items()}
    groups: dict[str, list[str]] = {}
    for name, path in numbered.items():
        if name not in located:
            groups.setdefault(reasons.get(name, UNREAD), []).append(path.name)
    return groups


def _listed(lost: dict[str, list[str]], limit: int = 5, width: int = 200) -> str:
    """``no features: a.jpg, b.jpg; no matches with any other: c.jpg``; see `shortened`."""
    return "; ".join(f"{reason}: {shortened(names, limit, width)}" for reason, names in lost.items())


def _reconstruct(workspace: Path, numbered: dict[str, Path], progress: Progress) -> None:
    copies = _small_copies(workspace / "images", numbered, progress)
    try:
        sfm.extract_features(workspace, _groups(copies), progress)
        sfm.match_features(workspace, sfm.pairs_by_name([copy.name for copy in copies]), progress)
        mapping.map_cameras(workspace, len(copies), progress)
    except sfm.FAILURES as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"structure from motion failed ({reason}); remove {workspace} and try again"
        ) from None


def _small_copies(folder: Path, numbered: dict[str, Path], progress: Progress) -> list[_Copy]:
    """Copies that COLMAP can read and finds the same way up as we do; unreadable files are left out."""
    copies, broken = [], []
    for index, (name, path) in enumerate(numbered.items()):
        progress("preparing photographs", index / len(numbered))
        try:
            if not (folder / name).is_file():
                _write_copy(path, folder / name)
            with opened(folder / name) as copy:
                copies.append(_Copy(name, copy.size, str(tags(copy.getexif()))))
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


def _groups(copies: list[_Copy]) -> list[sfm.Group]:
    """One camera for all photographs of one size and one set of optics."""
    members: dict[tuple[tuple[int, int], str], list[str]] = {}
    for copy in copies:
        members.setdefault((copy.size, copy.optics), []).append(copy.name)
    return [sfm.Group(tuple(names), "SIMPLE_RADIAL", side=max(size)) for (size, _), names in members.items()]

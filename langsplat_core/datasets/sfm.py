"""Cameras of a plain folder of photographs, by structure from motion in a process of its own."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.colmap import good_points, has_model, located_photos, read_model
from langsplat_core.datasets.exif import EXIF_IFD, optics
from langsplat_core.datasets.matches import Matches, NotLocatedError, read_matches
from langsplat_core.datasets.photos import Photo, develop, find_photos, mask_beside, read_photo
from langsplat_core.datasets.workspace import FAILURES, MASKS, CameraGroup, Pair, open_workspace, run_apart
from langsplat_core.errors import InputError, shortened
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import PictureError, opened
from langsplat_core.progress import Progress

SFM_SIDE = 1600  # px, longer side of the copies that features are sought in
MIN_PHOTOS = 3
FEWEST = 0.5  # share of the photographs: a scene of fewer is not of what was photographed
EXHAUSTIVE_LIMIT = 80  # photographs; beyond, matching every pair costs too much
SEQUENTIAL_OVERLAP = 10  # neighbours in name order that each photograph is matched with

log = logging.getLogger("langsplat")


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
        try:
            run_apart(_locate, workspace, files, workspace=workspace, progress=progress)
        except FAILURES as error:
            reason = str(error).partition("\n")[0]
            raise InputError(
                f"structure from motion failed ({reason}); remove {workspace} and try again"
            ) from None
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
    photos = [
        Photo(path, path.name, copy.intrinsics, copy.world_to_camera, upright=True, mask=mask_beside(path))
        for copy in located_photos(model, workspace / "images", workspace / "sparse")
        for path in (files[copy.label],)
    ]
    cameras, images, kept, masks = develop(photos, max_side, progress)
    return Capture(cameras, images, *good_points(model), photos=kept, masks=masks, matches=matches)


def numbered(paths: Sequence[Path]) -> dict[str, Path]:
    """Return photographs by their names in the workspace."""
    return {f"{index:05d}.jpg": path for index, path in enumerate(paths)}


def _content(path: Path) -> str:
    """Return a digest of a file: photographs that were copied, moved or touched are the same.

    It is empty for a file that may not be read, which is reported where it is opened.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _left_out(matches: Matches, contents: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    """Return photographs without a camera by the reason: ``{"no features": ["a.jpg", "b.jpg"]}``.

    contents: names and digests of all photographs
    """
    first: dict[str, str] = {}
    groups: dict[str, list[str]] = {}
    for row, (name, content) in enumerate(contents):
        twin = first.setdefault(content, name)
        if row not in matches.located:
            why = matches.why(row) if twin == name else f"the same picture as {twin}"
            groups.setdefault(why, []).append(name)
    return groups


def _listed(lost: dict[str, list[str]], limit: int = 5) -> str:
    """Return ``no features: a.jpg, b.jpg; no matches with any other: c.jpg``."""
    return "; ".join(f"{reason}: {shortened(names, limit)}" for reason, names in lost.items())


def _locate(workspace: Path, files: dict[str, Path], progress: Progress) -> None:
    """Write the model of the photographs `files`; in the process of its own."""
    from langsplat_core.datasets.reconstruction import map_cameras

    map_cameras(workspace, match_photos(workspace, files, progress), progress)


def match_photos(workspace: Path, files: dict[str, Path], progress: Progress) -> int:
    """Put features and matches of photographs into the workspace's database; return how many can be read."""
    from langsplat_core.datasets.reconstruction import extract_features, match_features

    groups = _small_copies(workspace / "images", files, progress)
    names = sorted(name for group in groups for name in group.names)
    extract_features(workspace, groups, progress)
    match_features(workspace, pairs_by_name(names), progress)
    return len(names)


def _small_copies(folder: Path, files: dict[str, Path], progress: Progress) -> list[CameraGroup]:
    """Write copies that COLMAP can read and finds the same way up as we do; unreadable files are left out.

    Photographs of one size and one set of optics (maker, camera, focal length) share a camera.
    """
    members: dict[tuple[tuple[int, int], str], list[str]] = {}
    broken = []
    any_masks = any(map(mask_beside, files.values()))
    for index, (name, path) in enumerate(files.items()):
        progress("preparing photographs", index / len(files))
        try:
            if not (folder / name).is_file():
                image = read_photo(path, upright=True)
                image.thumbnail((SFM_SIDE, SFM_SIDE), Image.Resampling.LANCZOS)
                with atomic_path(folder / name) as temporary:
                    image.save(temporary, quality=95, exif=optics(path))
            if any_masks:
                _write_mask(mask_beside(path), folder / name, folder.with_name(MASKS) / f"{name}.png")
            with opened(folder / name) as copy:
                exif = copy.getexif()
                lens = str(dict(exif) | dict(exif.get_ifd(EXIF_IFD)))
                members.setdefault((copy.size, lens), []).append(name)
        except PictureError as error:
            broken.append(f"{path.name} ({error.reason})")
    progress("preparing photographs", 1.0)
    if broken:
        log.warning("%d photographs cannot be read: %s", len(broken), shortened(broken))
    count = len(files) - len(broken)
    if count < MIN_PHOTOS:
        raise InputError(f"only {count} photographs can be read; at least {MIN_PHOTOS} are needed")
    return [
        CameraGroup(tuple(names), "SIMPLE_RADIAL", side=max(size)) for (size, _), names in members.items()
    ]


def _write_mask(mask: Path | None, copy: Path, out: Path) -> None:
    """Write a mask as COLMAP reads it, as large as the copy of its photograph, unless it is there.

    It is white for a photograph without one: where some have a mask, COLMAP finds nothing in those that have
    none.
    """
    if out.is_file():
        return
    with opened(copy) as image:
        white = Image.new("L", image.size, 255)
    counted = white if mask is None else read_photo(mask, upright=False).convert("L")
    out.parent.mkdir(exist_ok=True)
    with atomic_path(out) as temporary:
        counted.resize(white.size, Image.Resampling.NEAREST).save(temporary)


def pairs_by_name(names: Sequence[str]) -> list[Pair]:
    """Return every pair of up to `EXHAUSTIVE_LIMIT` photographs.

    Of more, each is paired with its next neighbours in name order and with those at distances 16, 32, 64 ...,
    which closes loops.
    """
    count = len(names)
    if count <= EXHAUSTIVE_LIMIT:
        return [(names[i], names[j]) for i in range(count) for j in range(i + 1, count)]
    steps = [*range(1, SEQUENTIAL_OVERLAP + 1), *(1 << k for k in range(4, count.bit_length()))]
    return [(names[i], names[i + step]) for i in range(count) for step in steps if i + step < count]

"""Captures: photographs with known cameras, as every loader returns them.

The module also chooses the views that are held out, the length of a unit, and random points in view.
"""

import hashlib
import logging
import math
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from PIL import Image

from langsplat_core.arrays import Array, check_array, near_power
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.photos import (
    SOLID,
    WORKERS,
    Developed,
    Developer,
    Photo,
    View,
    content,
    exif_facts,
    stray_masks,
    unique_names,
)
from langsplat_core.datasets.workspace import Matches
from langsplat_core.errors import InputError, report_loss, shortened
from langsplat_core.io.hostile import PictureError
from langsplat_core.progress import Progress
from langsplat_core.scene import NO_ORIGIN, Camera, moved_pose, origin_of

DECIMALS = 9  # to which digests round, in camera extents: far above float rounding, far below a pixel

log = logging.getLogger("langsplat")


@dataclass(frozen=True, eq=False)
class Capture:
    """Undistorted photographs, in name order, with pinhole cameras of the same size."""

    cameras: tuple[Camera, ...]  # camera.name is the photograph's file stem
    images: tuple[Array, ...]  # (H, W, 3) uint8 each, display (sRGB) values
    points: Array  # (M, 3) float64 structure-from-motion points; M may be 0
    colours: Array  # (M, 3) uint8
    metres_per_unit: float | None = None  # > 0, length of a world unit; None: unknown
    photos: tuple[Photo, ...] = ()  # the files, in the same order; none for images made otherwise
    drawn: bool = False  # images drawn by `assets.making`, on which encoders are calibrated
    masks: tuple[Array | None, ...] = ()  # (H, W) bool each, pixels that count; None: all; (): no masks
    cut_out: bool = False  # pixels that do not count show empty background, not something unknown
    matches: Matches | None = None  # of all photographs, where cameras came from structure from motion
    origin: Array = field(default_factory=lambda: NO_ORIGIN)  # (3,) what cameras and points are relative to
    taken: str = ""  # the span of the photographs' dates and places by EXIF data, in words

    def __post_init__(self) -> None:
        lists = {"photographs": self.images, "files": self.photos, "masks": self.masks}
        for name, items in lists.items():
            if len(items) != len(self.cameras) and (items or name == "photographs"):
                raise ValueError(f"{len(items)} {name} for {len(self.cameras)} cameras")
        for index, camera in enumerate(self.cameras):
            shape, mask = (camera.height, camera.width), self.mask(index)
            check_array(f"photograph {camera.name}", self.images[index], (*shape, 3), dtype=np.uint8)
            if mask is not None:
                check_array(f"mask of {camera.name}", mask, shape, dtype=np.bool_)
        dims = check_array("points", self.points, ("M", 3))
        check_array("colours", self.colours, ("M", 3), dims)

    def __len__(self) -> int:
        return len(self.cameras)

    def mask(self, index: int) -> Array | None:
        """Return (H, W) bool, pixels of photograph `index` that count; None: all of them."""
        return self.masks[index] if self.masks else None

    def split(self, test_every: int) -> tuple[list[int], list[int]]:
        """Return indices of (training, held-out) views; every `test_every`-th is held out, 0: none."""
        test = [i for i in range(len(self)) if test_every > 1 and i % test_every == 0 and len(self) > 1]
        return [i for i in range(len(self)) if i not in test], test

    def digest(self, indices: Sequence[int]) -> str:
        """Return a digest of all that a training on the photographs at `indices` sees.

        That is these in their order, their cameras, and the points, which structure from motion may place
        elsewhere. Poses and points count to `DECIMALS`, as processors differ in their last digits.
        """
        digest = hashlib.blake2b(digest_size=16)
        length = near_power(self.extent())
        for index in indices:
            camera = self.cameras[index]
            digest.update(repr((camera.name, camera.intrinsics)).encode())
            digest.update(_rounded(camera.world_to_camera / (1, 1, 1, length)).tobytes())
            digest.update(np.ascontiguousarray(self.images[index]).data)
        for index in indices:
            mask = self.mask(index)
            digest.update(b"" if mask is None else np.packbits(mask).tobytes())
        digest.update(b"cut out" * self.cut_out)
        digest.update(_rounded(self.points / length).tobytes())
        digest.update(self.colours.tobytes())
        return digest.hexdigest()

    def contents(self) -> dict[str, str]:
        """Return a digest of each photograph's file by the name of its camera."""
        rows = zip(self.cameras, self.photos, strict=False)  # there are no files of images made otherwise
        return {camera.name: content(photo.path)[:16] for camera, photo in rows}

    def take(self, indices: Sequence[int]) -> "Capture":
        """Return the photographs at `indices`, detached from the files, with the points of all."""
        return self._of([(self.cameras[i], self.images[i], self.mask(i)) for i in indices])

    def shrunk(self, indices: Sequence[int], longer_side: int) -> "Capture":
        """Return the photographs at `indices`, at most `longer_side` pixels long, with the points of all."""
        views: list[View] = []
        for index in indices:
            camera = self.cameras[index]
            small, view = camera.within(longer_side), (camera, self.images[index], self.mask(index))
            whole = small.width == camera.width and small.height == camera.height
            views.append(view if whole else shrunk_view(*view, (small.width, small.height)))
        return self._of(views)

    def read_at(self, indices: Sequence[int], longer_side: int) -> "Capture":
        """Return photographs, bit for bit as a dataset has them that is read at this size.

        The points stay those of all. Without files, images are `shrunk`. InputError for an unreadable file.
        """
        if not self.photos or longer_side >= max(max(self.images[index].shape) for index in indices):
            return self.shrunk(indices, longer_side)
        developed = Developer(longer_side)

        def view(index: int) -> View:
            try:
                lens, image, mask = developed(self.photos[index]).view(self.cut_out)
            except PictureError as error:
                raise InputError(f"{error}; it was there when this run began") from None
            camera = self.cameras[index]
            return replace(lens, world_to_camera=camera.world_to_camera, name=camera.name), image, mask

        with ThreadPoolExecutor(WORKERS) as pool:
            return self._of(list(pool.map(view, indices)))

    def _of(self, views: Sequence[View]) -> "Capture":
        """Return the capture with other `views` of the same scene, detached from the files."""
        cameras, images, masks = zip(*views, strict=True) if views else ((), (), ())
        masks = masks if self.masks else ()
        return replace(self, cameras=cameras, images=images, masks=masks, photos=(), matches=None)

    def extent(self) -> float:
        """Return INRIA's scene scale: 1.1 times the largest distance of a camera from their mean, > 0."""
        centres = np.array([camera.position for camera in self.cameras])
        return max(1.1 * float(np.linalg.norm(centres - centres.mean(0), axis=1).max()), 1e-30)


def centred(capture: Capture) -> Capture:
    """Return the capture relative to the origin that `origin_of` finds for its cameras and points."""
    eyes = np.array([camera.position for camera in capture.cameras])
    origin = origin_of(np.concatenate([eyes, capture.points]))
    if not origin.any():
        return capture
    return replace(
        capture,
        cameras=tuple(camera.moved(-origin) for camera in capture.cameras),
        points=capture.points - origin,
        photos=tuple(
            replace(photo, world_to_camera=moved_pose(photo.world_to_camera, -origin))
            for photo in capture.photos
        ),
        origin=origin,
    )


def shrunk_view(camera: Camera, image: Array, mask: Array | None, size: tuple[int, int]) -> View:
    """Return a view at a smaller (width, height), shrunk as photographs are when they are read.

    Area averages would differ (PSNR 31 to 42 dB) and change scores. A pixel counts if all within it do.
    """
    shrunk = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))
    if mask is not None:
        grey = Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0)))
        mask = np.asarray(grey.resize(size, Image.Resampling.BOX)) == 255
    return camera.resized(*size), shrunk, mask


def _rounded(values: Array) -> Array:
    """Return float64 values rounded to `DECIMALS`, without a negative zero."""
    return np.asarray(np.round(values.astype(np.float64), DECIMALS) + 0.0)


def report_lost_points(good: Array, source: str) -> None:
    """Report how many points of `source` are left out; good: (M,) bool, the points that are kept."""
    if lost := len(good) - good.sum():
        share = f"{lost} of {len(good)} points of {source}"
        report_loss("%s are damaged or badly located: left out; was it written whole?", share)


# Photographs developed into a capture.


def _is_cut_out(alpha: Array) -> bool:
    empty = alpha < SOLID
    edge = np.concatenate([empty[0], empty[-1], empty[:, 0], empty[:, -1]])
    return bool(empty.mean() > 0.5 or edge.mean() > 0.5)


IN_MEMORY = 512_000_000  # bytes of images that are held in memory; further images are held in files


def in_file(image: Array) -> Array:
    """Return the image mapped from an unnamed file in `TMPDIR`, which ends with the process."""
    try:
        with tempfile.TemporaryFile(prefix="langsplat-") as file:
            # Written, not mapped and filled: on a full disk that would kill the process without a word.
            file.write(np.ascontiguousarray(image).data)
            file.flush()
            return np.memmap(file, np.uint8, "c", shape=image.shape)
    except OSError as error:
        raise OSError(error.errno, error.strerror, tempfile.gettempdir()) from error


def develop(
    photos: Sequence[Photo], config: DatasetConfig, progress: Progress, points: Array, colours: Array
) -> Capture:
    """Return the capture of `photos` by `config`, with (M, 3) points and (M, 3) uint8 colours, by name.

    Unreadable photographs are reported; InputError if none can be read.
    """
    if not photos:
        raise InputError("the dataset lists no photographs")
    names = unique_names([photo.label for photo in photos])
    order = sorted(range(len(photos)), key=names.__getitem__)
    told: list[tuple[str, str]] = []  # what was guessed, and of which photograph

    developer = Developer(config.max_side)

    def developed(photo: Photo) -> Developed | str:
        try:
            made = developer(photo, lambda what: told.append((what, photo.label)))
        except PictureError as error:
            return f"{photo.label} ({error.reason})"
        _, _, counted = made.view(cut_out=True)
        return made if counted is None or counted.any() else f"{photo.label} (its mask leaves nothing of it)"

    room = IN_MEMORY
    done: dict[int, Developed] = {}  # by the number of the photograph
    broken: list[str] = []
    with ThreadPoolExecutor(WORKERS) as pool:
        each = pool.map(developed, (photos[index] for index in order))
        for count, (index, found) in enumerate(zip(order, each, strict=True), 1):
            if isinstance(found, str):
                broken.append(found)
            else:
                room -= found.image.nbytes
                image = found.image if room >= 0 else in_file(found.image)
                done[index] = found._replace(camera=replace(found.camera, name=names[index]), image=image)
            progress("reading photographs", count / len(order))
    if not done:
        raise InputError(f"no photograph can be read: {shortened(broken)}")
    if broken:
        report_loss("%d photographs cannot be used and are left out: %s", len(broken), shortened(broken))
    _, _, masks, alphas = zip(*done.values(), strict=True)
    _report(told, masks)
    if stray := stray_masks(photos):
        remedy = "a mask is called masks/NAME.jpg.png or masks/NAME.png after its photograph"
        report_loss("%d masks are of no photograph: %s; %s", len(stray), shortened(stray), remedy)
    cut_out = _cut_out(masks, alphas, config)
    cameras, images, masks = zip(*(made.view(cut_out) for made in done.values()), strict=True)
    masks = masks if any(mask is not None for mask in masks) else ()
    files = tuple(photos[index] for index in done)
    return Capture(cameras, images, points, colours, photos=files, masks=masks, cut_out=cut_out)


def _report(told: Sequence[tuple[str, str]], masks: Sequence[Array | None]) -> None:
    for what in dict(told):
        labels = [label for said, label in told if said == what]
        report_loss("%d photographs: %s (%s)", len(labels), what, shortened(labels))
    if 0 < (masked := sum(mask is not None for mask in masks)) < len(masks):
        report_loss("%d of %d photographs have a mask; of the others all pixels count", masked, len(masks))


def _cut_out(masks: Sequence[Array | None], alphas: Sequence[Array | None], config: DatasetConfig) -> bool:
    """Return True if transparent pixels are empty background, and report how transparency is taken."""
    given = [alpha for alpha in alphas if alpha is not None]
    if not given:
        return False
    cut_out = config.alpha == "background"
    if config.alpha == "auto":
        cut_out = 2 * sum(map(_is_cut_out, given)) > len(alphas)
    cut_out = cut_out and all(mask is None for mask in masks)  # masks say what does not count
    said = "an empty background" if cut_out else "no part of the subject, and does not count"
    say = report_loss if config.alpha == "auto" else log.info
    message = "what is transparent in %d of %d photographs is %s; else: --alpha %s"
    say(message, len(given), len(alphas), said, "mask" if cut_out else "background")
    return cut_out


# Views that are held out from training, to measure it on.

FEWEST_VIEWS = 6  # below, every photograph is needed for training, and nothing is measured
NEIGHBOURS = 4  # a view is surrounded where it lies in the middle of so many nearest training views
RADIAN = 2.0  # typical steps between cameras that a turn by a radian counts for


def split_views(capture: Capture, config: DatasetConfig) -> tuple[list[int], list[int]]:
    """Return indices of (training, held-out) views, about one in ``config.test_every``."""
    held_out = [i for i, photo in enumerate(capture.photos) if photo.held_out and config.test_every > 1]
    if not held_out and config.hold_out == "every":
        return capture.split(config.test_every)
    held_out = held_out or surrounded_views(capture.cameras, config.test_every)
    return [index for index in range(len(capture)) if index not in held_out], held_out


def surrounded_views(cameras: Sequence[Camera], every: int) -> list[int]:
    """Return ascending indices of one view in `every`, each surrounded by training views.

    Views at the ends of a walk show what no other photograph does, and do not measure the training. Each time
    the view closest to the middle of its nearest training views, relative to their distance, is taken, and
    its own nearest views are left to training. Fewer than `FEWEST_VIEWS` cameras give none.
    """
    count = len(cameras)
    if every < 2 or count < FEWEST_VIEWS:
        return []
    stands = _stands(cameras)
    apart = np.linalg.norm(stands[:, None] - stands[None], axis=2)
    found: list[int] = []
    free = np.ones(count, bool)  # that may be held out
    for _ in range(max(1, round(count / every))):
        training = np.setdiff1d(np.arange(count), found)
        lean = {int(index): _lean(stands, apart, training, index) for index in training if free[index]}
        if not lean:
            break
        best = min(lean, key=lambda index: lean[index])
        found.append(best)
        free[np.argsort(apart[best], kind="stable")[: 1 + every // 2]] = False
    return sorted(found)


def _stands(cameras: Sequence[Camera]) -> Array:
    """Return (M, 6) positions and directions of cameras in typical steps, rounded: processors differ."""
    places = np.array([camera.position for camera in cameras])
    directions = np.array([camera.rotation[2] for camera in cameras])
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    step = float(np.median(gaps.min(1))) or 1.0  # cameras in one place have none
    return np.round(np.concatenate([places / step, RADIAN * directions], axis=1), DECIMALS)


def _lean(stands: Array, apart: Array, training: Array, index: int) -> float:
    """Return how far a view is from the middle of its nearest training views, over how far those are."""
    others = training[training != index]
    nearest = others[np.argsort(apart[index, others], kind="stable")[:NEIGHBOURS]]
    offset = np.linalg.norm(stands[nearest].mean(0) - stands[index])
    return round(float(offset / max(apart[index, nearest].mean(), 1e-9)), 6)


# The length of a unit of a capture's world, by the places (GPS) that its photographs name.
#
# A phone's places are metres off, so they do not move the cameras. But distances between far photographs tell
# the length of a unit, if they exceed the error of the places, which the spread of the ratios shows.

FEWEST_PLACES = 5  # photographs with a place
EQUATOR, FLATTENED = 6_378_137.0, 6.694_379_990_14e-3  # of WGS 84: radius in metres, squared eccentricity


def with_taken(capture: Capture) -> Capture:
    """Return the capture with the dates and places of its photographs, and a scale from the places.

    A scale of the dataset itself is kept; there is none where the places are too uncertain.
    """
    facts = [exif_facts(photo.path) for photo in capture.photos]
    dates = sorted(each.taken for each in facts if each.taken)
    places = np.array([each.place for each in facts]).reshape(-1, 2)
    named = np.isfinite(places).all(1)
    said = []
    if dates:
        said.append(f"{dates[0]:%Y-%m-%d %H:%M} to {dates[-1]:%Y-%m-%d %H:%M}")
    if named.any():
        span = scipy.spatial.distance.pdist(on_ground(places[named])).max(initial=0)
        said.append(f"places (GPS) within {span:.0f} m")
    if said:
        log.info("taken: %s", ", ".join(said))
    capture = replace(capture, taken=", ".join(said))
    if capture.metres_per_unit or named.sum() < FEWEST_PLACES:
        return capture
    eyes = np.array([camera.position for camera in capture.cameras])[named]
    metres = metres_per_unit(eyes, places[named])
    length = "of no length that they agree on" if metres is None else f"about {metres:.3g} m long"
    log.info("a unit is %s, by the places (GPS) of %d photographs", length, named.sum())
    return replace(capture, metres_per_unit=metres)


def metres_per_unit(eyes: Array, places: Array) -> float | None:
    """Return the median ratio of distances between places to those between cameras.

    It is taken over pairs that are at least half as far apart as the farthest ones. eyes: (K, 3) camera
    positions; places: (K, 2) latitudes and longitudes, degrees. None where the middle half of the ratios
    spans more than a fifth of the median. Heights, which most cameras know badly, are left out.
    """
    apart = scipy.spatial.distance.pdist(eyes)
    if not apart.any():
        return None
    far = apart >= apart.max() / 2
    ratios = scipy.spatial.distance.pdist(on_ground(places))[far] / apart[far]
    low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    return float(middle) if middle > 0 and high - low <= middle / 5 else None


def on_ground(places: Array) -> Array:
    """Return (K, 2) metres east and north of the first of (K, 2) latitudes and longitudes, degrees."""
    latitude, longitude = np.radians(places).T
    east = (longitude - longitude[0] + math.pi) % (2 * math.pi) - math.pi  # also over the date line
    bend = 1 - FLATTENED * math.sin(latitude[0]) ** 2
    along = EQUATOR / math.sqrt(bend) * math.cos(latitude[0]) * east
    return np.stack([along, EQUATOR * (1 - FLATTENED) / bend**1.5 * (latitude - latitude[0])], 1)


# Random points in view of the cameras, where there are no better ones.

TELLING_POINTS = 50  # known points from which on random depths follow theirs


def look_distance(cameras: Sequence[Camera]) -> float:
    """Return the typical distance from the cameras to the place they look at, world units, > 0.

    It is nearest to all optical axes by least squares, with a small pull to the cameras, for parallel axes.
    """
    positions = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    spread = max(float(np.linalg.norm(positions - positions.mean(0), axis=1).max()), 1e-30)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    pull = 1e-3 * np.eye(3)
    centre = np.linalg.solve(
        across.mean(0) + pull,
        np.einsum("nij,nj->i", across, positions) / len(axes) + pull @ positions.mean(0),
    )
    distance = float(np.median(((centre - positions) * axes).sum(1)))
    return distance if distance > 0.1 * spread else 2 * spread


def random_points(
    count: int, known: Array, capture: Capture, indices: Sequence[int], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw (count, 3) points in view of the cameras at `indices`, with (count, 3) uint8 colours of pixels.

    known: (M, 3) points whose depths tell where the scene is, M may be 0. Depths are uniform in 1/z, so that
    near and far are equally dense in the images. Of twice as many, those seen by half the cameras go first.
    """
    cameras = [capture.cameras[index] for index in indices]
    near, far = 0.3 * look_distance(cameras), 3 * look_distance(cameras)
    if len(known) >= TELLING_POINTS:
        seen = [camera.project(known) for camera in cameras]
        depths = [z[camera.in_image(pixels, z)] for camera, (pixels, z) in zip(cameras, seen, strict=True)]
        near, far = (float(z) for z in np.quantile(np.concatenate(depths), (0.02, 0.98)))
    drawn = np.zeros((2 * count, 3))
    colours = np.zeros((2 * count, 3), np.uint8)
    owner = rng.integers(len(cameras), size=2 * count)
    for number, (index, camera) in enumerate(zip(indices, cameras, strict=True)):
        rows, mask = np.flatnonzero(owner == number), capture.mask(index)
        x = rng.uniform(0, camera.width, len(rows))
        y = rng.uniform(0, camera.height, len(rows))
        if mask is not None and mask.any():
            at = np.divmod(rng.choice(np.flatnonzero(mask), len(rows)), camera.width)
            y, x = (whole + part % 1 for whole, part in zip(at, (y, x), strict=True))
        z = 1 / rng.uniform(1 / far, 1 / near, len(rows))
        drawn[rows] = camera.unproject(np.stack([x, y], -1), z)
        colours[rows] = capture.images[index][y.astype(int), x.astype(int)]
    shared = np.sum([camera.in_image(*camera.project(drawn)) for camera in cameras], axis=0)
    best = np.argsort(shared < len(cameras) / 2, kind="stable")[:count]
    return drawn[best], colours[best]

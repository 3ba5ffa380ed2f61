"""Where a scene is looked at when it is made compact: views that rank its Gaussians, views that measure."""

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import CompactConfig, DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress
from langsplat_core.ranges import check_settings
from langsplat_core.scene import Camera, Scene, look_at

log = logging.getLogger("langsplat")

T = TypeVar("T")

RING_SIZE = (640, 480)
RING_FOV = 50.0  # degrees, vertical
RING_DISTANCES = (2.6, 1.6)  # radii of the scene: the whole of it, and nearer, where small Gaussians show
RING_ELEVATIONS = (-20.0, 60.0)  # degrees above the horizon
HOLD_OUT = 6  # every n-th view measures
FEW = 12  # fewer views than this are halved instead, so that the loss is not that of one or two
SAME_PLACE = 0.01  # of the cameras' spread: farther apart, scene and photographs have different worlds


@dataclass(frozen=True, eq=False)
class Views:
    """Two groups of views with no camera in common."""

    ranking: tuple[Camera, ...]
    measuring: tuple[Camera, ...]
    photographs: tuple[Array | None, ...]  # of the measuring views, (H, W, 3) uint8
    origin: str  # where they come from, for the report


def choose_views(scene: Scene, photos: Path | None, config: CompactConfig, progress: Progress) -> Views:
    """The cameras of the photographs, else of the scene, else a ring around it; at most ``config.views``.

    Photographs that the scene was not trained on, if there are any, all measure; otherwise every
    `HOLD_OUT`-th view does. Raises InputError where fewer than two views are left or the photographs belong
    to another world than the scene.
    """
    check_settings(config)
    if photos is not None:
        return _photographed(scene, photos, config, progress)
    if len(scene.cameras) >= 2:
        cameras = [_limited(camera, config.max_side) for camera in _thinned(scene.cameras, config.views)]
        origin = "the scene's cameras"
    else:
        cameras = [_limited(camera, config.max_side) for camera in ring_cameras(scene, min(config.views, 48))]
        origin = "a ring around the scene (it has no cameras): what lies inside may be judged invisible"
    held = _every(len(cameras))
    return Views(
        tuple(camera for i, camera in enumerate(cameras) if i not in held),
        tuple(cameras[i] for i in sorted(held)),
        (None,) * len(held),
        origin,
    )


def ring_cameras(scene: Scene, count: int) -> list[Camera]:
    """`count` cameras on a spiral around the scene's bounds that look at its centre, upright."""
    centre, radius = scene.bounds()
    up = scene.up()
    east = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    golden = np.pi * (3 - np.sqrt(5))
    cameras = []
    for index in range(count):
        low, high = np.sin(np.radians(RING_ELEVATIONS))
        height = low + (high - low) * (index + 0.5) / count  # equal steps of the sine: even on the sphere
        flat = np.sqrt(1 - height**2)
        direction = flat * (np.cos(golden * index) * east + np.sin(golden * index) * north) + height * up
        eye = centre + RING_DISTANCES[index % len(RING_DISTANCES)] * radius * direction
        camera = look_at(eye, centre, up, RING_SIZE, RING_FOV)
        cameras.append(replace(camera, name=f"ring_{index:03d}"))
    return cameras


def _photographed(scene: Scene, photos: Path, config: CompactConfig, progress: Progress) -> Views:
    with tempfile.TemporaryDirectory() as work:  # for points that may have to be found, and that are not used
        settings = DatasetConfig(max_side=config.max_side, allow_few_cameras=True)  # only looked through
        capture = load_capture(photos, settings, Path(work), progress)
    check_same_world(scene.cameras, capture.cameras, photos)
    trained = {camera.name for camera in scene.cameras}
    seen = [i for i, camera in enumerate(capture.cameras) if camera.name in trained]
    unseen = [i for i, camera in enumerate(capture.cameras) if camera.name not in trained]
    if not seen or not unseen:
        chosen = _thinned(range(len(capture)), config.views)
        held = _every(len(chosen))
        unseen = [chosen[i] for i in sorted(held)]
        seen = [index for i, index in enumerate(chosen) if i not in held]
        origin = "photographs, of which the scene may know all"
    else:
        measuring = max(config.views // HOLD_OUT, 1)
        unseen, seen = _thinned(unseen, measuring), _thinned(seen, max(config.views - measuring, 1))
        origin = "photographs; the loss is measured on ones held out from training"
    if not seen or not unseen:
        raise InputError(f"{photos}: {len(capture)} photographs; at least 2 are needed")
    return Views(
        tuple(capture.cameras[i] for i in seen),
        tuple(capture.cameras[i] for i in unseen),
        tuple(capture.images[i] for i in unseen),
        origin,
    )


def check_same_world(own: Sequence[Camera], photographed: Sequence[Camera], photos: Path) -> None:
    places = {camera.name: camera.position for camera in own}
    pairs = [(places[c.name], c.position) for c in photographed if c.name in places]
    if not pairs:
        log.warning(
            "%s: no photograph is named like a camera of the scene; the worlds are taken as equal", photos
        )
        return
    ours, theirs = np.array(pairs).transpose(1, 0, 2)
    spread = max(float(np.linalg.norm(ours - ours.mean(0), axis=1).max()), 1e-6)
    if np.median(np.linalg.norm(ours - theirs, axis=1)) > SAME_PLACE * spread:
        raise InputError(
            f"{photos}: its cameras lie elsewhere than the scene's of the same name; "
            "give the dataset that the scene was trained on, or leave --photos out"
        )


def _thinned(items: Sequence[T], most: int) -> list[T]:
    """At most `most` of `items`, evenly spaced, in order."""
    count = min(len(items), most)
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]


def _every(count: int) -> set[int]:
    """Indices of the measuring ones among `count` views."""
    step = HOLD_OUT if count >= FEW else 2
    return set(range(step // 2, count, step))


def _limited(camera: Camera, max_side: int) -> Camera:
    factor = max_side / max(camera.width, camera.height)
    if factor >= 1:
        return camera
    return camera.resized(max(round(camera.width * factor), 1), max(round(camera.height * factor), 1))

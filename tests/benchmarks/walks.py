"""Photographs of a walk straight ahead: how many of them each way of structure from motion locates."""

import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from assets.making.dataset import LIGHT
from assets.making.kit import COLOURS, Kit
from assets.making.objects import FURNITURE, TABLE_TOP, furniture
from assets.making.render import Renderer
from assets.making.shapes import rotation_about
from assets.making.world import ENLARGED, Placed, assemble, bounds
from langsplat_core.datasets import sfm
from langsplat_core.datasets.capture import find_photos
from langsplat_core.extensions.benchmarks.measure import markdown
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.scene import Camera, look_at

FIELD = 50.0  # degrees, vertical
FILM = 36.0  # mm, width of film
AHEAD = 8.0  # metres, what the walker looks at
WAYS = ("usual", "close pairs", "all at once", "few shared", "focal length guessed")  # as in `sfm.WAYS`


@dataclass(frozen=True)
class Walks:
    """Photographs located per way: of the walks in folders, or of one drawn along a furnished street."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Folders of photographs; none: draw a walk, with focal lengths in the EXIF data and without."""
    views: int = 29
    """Photographs of the drawn walk."""
    step: float = 1.0
    """Metres from one photograph to the next."""
    sway: float = 1.0
    """Times 5 cm and 2 degrees, how the walker sways; 0: as on rails."""
    width: int = 800
    """Pixels; the height is three quarters."""
    seed: int = 0
    keep: Path | None = None
    """Folder to draw into; a walk that lies there is taken as it is."""

    def run(self) -> None:
        rows: list[tuple[str, ...]] = []
        with tempfile.TemporaryDirectory() as scratch, TerminalProgress() as progress:
            truth = () if self.folders else walk_cameras(self)
            folders = self.folders or draw(self.keep or Path(scratch), self, progress)
            for number, folder in enumerate(folders):
                rows += located(folder, Path(scratch) / str(number), truth, progress)
        print(markdown(("photographs", "way", "located", "places off", "CPU-s"), rows))


def draw(folder: Path, walk: Walks, progress: Progress = silent) -> Sequence[Path]:
    """Write the photographs of a walk, with the focal length in their EXIF data and without; both folders."""
    folders = [folder / "exif", folder / "plain"]
    if all(map(find_photos, folders)):
        return folders
    for each in folders:
        each.mkdir(parents=True, exist_ok=True)
    cameras = walk_cameras(walk)
    world = assemble(street(walk.seed, walk.views * walk.step + 2 * AHEAD))
    renderer = Renderer(world, replace(LIGHT, key=0.0, sky=2.0), samples=8)
    for number, camera in enumerate(cameras):
        progress("drawing photographs", number / len(cameras))
        picture = Image.fromarray(renderer.picture(camera).image)
        exif = Image.Exif()
        exif[0x0110] = "drawn"
        exif.get_ifd(0x8769)[0xA405] = round(FILM_DIAGONAL / np.hypot(*picture.size) * camera.fx)
        picture.save(folders[0] / f"IMG_{number:04d}.jpg", quality=92, exif=exif)
        picture.save(folders[1] / f"IMG_{number:04d}.jpg", quality=92)
    return folders


FILM_DIAGONAL = float(np.hypot(36, 24))  # mm


def street(seed: int, length: float) -> list[Placed]:
    """Floor and walls along x from 0 to `length` metres, furniture and pictures along these, and things on
    the floor beside the way."""
    kit = Kit(np.random.default_rng((seed, 29)))
    placed: list[Placed] = []
    for at in np.arange(furniture.ROOM / 2, length + furniture.ROOM / 2, furniture.ROOM):
        shell = furniture.shell(kit)
        ends = [shell[0], shell[2], shell[4]]  # the floor and the walls at both sides
        placed += [Placed(thing, np.eye(3), np.array([at, 0, 0])) for thing in ends]
    for at in np.arange(0.6, length, 1.2):
        for side in (0.0, 180.0):
            turn = rotation_about("z", side)
            builder, words = FURNITURE[kit.pick("sofa", "shelf", "cabinet")]
            thing = builder(kit, kit.pick(*[word for word in words if word in COLOURS]))
            back = furniture.ROOM / 2 - 0.03
            placed.append(Placed(thing, turn, turn @ (0, back - bounds(thing)[1][1], 0) + (at, 0, 0)))
            picture = furniture.picture(kit, kit.pick("brown", "black", "white"))
            placed.append(Placed(picture, turn, turn @ (0, back, kit.size(1.4, 1.9)) + (at, 0, 0)))
            builder, words = TABLE_TOP[kit.pick(*TABLE_TOP)]
            own = rotation_about("z", kit.size(0, 360))
            beside = turn @ (kit.size(-0.5, 0.5), kit.size(0.5, 1.4), 0) + (at, 0, 0)
            placed.append(Placed(builder(kit, kit.pick(*words)), own, beside, 2 * ENLARGED))
    return placed


def walk_cameras(walk: Walks) -> list[Camera]:
    """Cameras of somebody who walks along x and sways by some centimetres and degrees."""
    rng = np.random.default_rng(walk.seed)
    size = (walk.width, walk.width * 3 // 4)
    found = []
    for number in range(walk.views):
        eye = np.array([number * walk.step, 0.0, 1.5]) + walk.sway * rng.normal(0, (0.05, 0.06, 0.03))
        target = eye + np.array([AHEAD, 0, -0.8]) + walk.sway * rng.normal(0, (0, 0.25, 0.15))
        found.append(look_at(eye, target, np.array([0.0, 0, 1]), size, FIELD))
    return found


def located(
    folder: Path, work: Path, truth: Sequence[Camera], progress: Progress = silent
) -> list[tuple[str, ...]]:
    """A row per way, from the same matches; `truth`: the cameras of the photographs, or none."""
    workspace = sfm.open_workspace(work, str(folder))
    count = sfm.match_photos(workspace, sfm.numbered(find_photos(folder)), progress)
    rows: list[tuple[str, ...]] = []
    for name, way in zip(WAYS, sfm.WAYS, strict=True):
        attempts = work / "attempts"
        shutil.rmtree(attempts, ignore_errors=True)
        attempts.mkdir()
        start = time.process_time()
        model = sfm.best_model(None, way(workspace, attempts, lambda: None))
        seconds = time.process_time() - start
        rows.append(_row(folder, name, count, model, truth, seconds))
    sfm.map_cameras(workspace, count, silent)
    kept = sfm.Model(str(workspace / "sparse")) if (workspace / "sparse").is_dir() else None
    return [*rows, _row(folder, "what is kept", count, kept, truth, None)]


def _row(
    folder: Path,
    name: str,
    count: int,
    model: sfm.Model | None,
    truth: Sequence[Camera],
    seconds: float | None,
) -> tuple[str, ...]:
    found = 0 if model is None else len(sfm.located_names(model))
    off = f"{100 * astray(model, truth):.2f} %" if model and truth else ""
    return (folder.name, name, f"{found} of {count}", off, "" if seconds is None else f"{seconds:.1f}")


def astray(model: sfm.Model, truth: Sequence[Camera]) -> float:
    """Median error of the located places, over the length of the way between them. The worlds are laid onto
    each other by what the cameras look at, since places on a line leave a turn about it open."""
    images = [image for image in model.images.values() if image.has_pose]
    cameras = [truth[int(Path(image.name).stem)] for image in images]
    turns = [image.cam_from_world().rotation.matrix() for image in images]
    left, _, right = np.linalg.svd(np.sum([c.rotation.T @ t for c, t in zip(cameras, turns, strict=True)], 0))
    turn = left @ np.diag((1, 1, np.linalg.det(left @ right))) @ right
    found = np.array([image.projection_center() for image in images]) @ turn.T
    there = np.array([camera.position for camera in cameras])
    found, there = found - found.mean(0), there - there.mean(0)
    errors = np.linalg.norm(there - found * (found * there).sum() / (found * found).sum(), axis=1)
    return float(np.median(errors) / np.ptp(there[:, 0]))

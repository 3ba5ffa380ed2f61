"""Few photographs: what depths, free space, exposures and masks of what moves gain, held out.

Captures are given, or drawn: rooms and streets, empty or with people who stand elsewhere in every photograph.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from PIL import Image

from assets.making.dataset import FIRST_ROOM, LIGHT, write_transforms
from assets.making.kit import COLOURS, Kit, Piece, Thing, ball, cylinder, pillow, rotation_about
from assets.making.objects import FURNITURE, TABLE_TOP, furniture
from assets.making.render import Light, RenderedView, Renderer
from assets.making.world import ENLARGED, Placed, assemble, bounds, furnished
from langsplat_core.arrays import Array, psnr
from langsplat_core.config import (
    QUICK_SIDE,
    DatasetConfig,
    RadianceConfig,
    Seed,
    TrainConfig,
    TrainPreset,
    with_preset,
)
from langsplat_core.datasets import Capture, load_capture
from langsplat_core.datasets.capture import split_views, surrounded_views
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.raster.render import render
from langsplat_core.scene import Camera, Scene, look_at
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.trainer import supported, train_radiance

Kind = Literal["few", "walk"]  # on an arc around a room's table; straight ahead along a street
VIEWS = 12
WIDTH = 400  # px; the height is three quarters
ARC = 150.0  # degrees
STEP = 0.5  # metres from one photograph of a walk to the next
AHEAD = 8.0  # metres, what the walker looks at
EMPTY = 0.2  # of the photographs of a peopled capture
NEAREST = 0.8  # metres from a camera to a person
SHARES = (0.02, 0.25)  # of a photograph's pixels, that people cover


@dataclass(frozen=True)
class _Place:
    """What is photographed, and from where."""

    cameras: list[Camera]
    things: list[Placed]
    light: Light
    floor: float  # metres, its height
    reach: float  # metres from a camera within which people stand


def draw_capture(
    folder: Path, kind: Kind, seed: int, people: bool, test_every: int, progress: Progress
) -> None:
    """Write photographs with known cameras and no points, unless they lie in `folder`. people: one to three
    in most of those that `surrounded_views` leaves to training."""
    if (folder / "transforms.json").exists():
        return
    place = _street(seed) if kind == "walk" else _room(seed)
    renderer = Renderer(assemble(place.things), place.light, samples=16, cell=0.01)
    kit, held_out = Kit(np.random.default_rng((seed, 41))), surrounded_views(place.cameras, test_every)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for number, camera in enumerate(place.cameras):
        progress("drawing photographs", number / VIEWS)
        fine = camera.resized(2 * camera.width, 2 * camera.height)
        rendered, image = renderer.render(fine, oversample=1), None
        while people and image is None and number not in held_out and kit.rng.random() > EMPTY:
            image = _with_people(rendered, fine, place, kit)
        drawn = Image.fromarray(rendered.image if image is None else image)
        size = (camera.width, camera.height)
        drawn.resize(size, Image.Resampling.BOX).save(folder / "images" / f"{camera.name}.png")
    write_transforms(place.cameras, ".png", folder / "transforms.json", points="")


def _room(seed: int) -> _Place:
    rng = np.random.default_rng((seed, 43))
    start, cameras = rng.uniform(0, 360), []
    for k in range(VIEWS):
        angle = np.radians(start + ARC * (k + rng.uniform(-0.2, 0.2)) / (VIEWS - 1))
        reach = rng.uniform(1.6, 1.9)
        eye = np.array([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(0.5, 0.9)])
        target = np.array([*rng.uniform(-0.15, 0.15, 2), 0.0])
        cameras.append(look_at(eye, target, np.array([0.0, 0, 1]), (WIDTH, WIDTH * 3 // 4), 50.0))
    things = furnished(FIRST_ROOM + seed, "clutter")
    return _Place(_named(cameras), things, LIGHT, -furniture.TABLE_HEIGHT, 4.0)


def _street(seed: int) -> _Place:
    """Somebody walks along x through a furnished street, and sways by some centimetres and degrees."""
    rng, cameras = np.random.default_rng(seed), []
    for number in range(VIEWS):
        eye = np.array([number * STEP, 0.0, 1.5]) + rng.normal(0, (0.05, 0.06, 0.03))
        target = eye + np.array([AHEAD, 0, -0.8]) + rng.normal(0, (0, 0.25, 0.15))
        cameras.append(look_at(eye, target, np.array([0.0, 0, 1]), (WIDTH, WIDTH * 3 // 4), 50.0))
    things = furnished_street(seed, VIEWS * STEP + 2 * AHEAD)
    return _Place(_named(cameras), things, replace(LIGHT, key=0.0, sky=2.0), 0.0, 7.0)


def furnished_street(seed: int, length: float) -> list[Placed]:
    """Return floor and walls along x from 0 to `length` metres, with furniture, pictures and
    things on the floor along the way."""
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


def _named(cameras: list[Camera]) -> list[Camera]:
    return [replace(camera, name=f"view_{number:03d}") for number, camera in enumerate(cameras)]


def _with_people(rendered: RenderedView, camera: Camera, place: _Place, kit: Kit) -> Array | None:
    """The (H, W, 3) image with people in it; None where they cover too much or too little of it."""
    standing = []
    for _ in range(int(kit.rng.integers(1, 4))):
        column = kit.size(0, camera.width)
        ray = camera.rotation.T @ np.array([(column - camera.cx) / camera.fx, 0, 1])
        at = camera.position + kit.size(NEAREST, place.reach) * ray / np.linalg.norm(ray)
        turn = rotation_about("z", kit.size(0, 360))
        standing.append(Placed(person(kit), turn, np.array([at[0], at[1], place.floor])))
    drawn = Renderer(assemble(standing), place.light, samples=8).render(camera, oversample=1)
    before = drawn.depth < rendered.depth
    fits = SHARES[0] < before.mean() < SHARES[1]
    return np.where(before[..., None], drawn.image, rendered.image) if fits else None


def person(kit: Kit) -> Thing:
    """Somebody of 1.5 to 1.9 metres, in clothes of two colours, some of them striped or dotted."""
    height, colour = kit.size(1.5, 1.9), kit.pick(*COLOURS)
    coat = kit.pattern(colour, kit.other(colour, *COLOURS), kit.pick("cloth", "striped", "dotted"), 0.05)
    leg = cylinder(0.075, 0.5 * height)
    trousers, skin = kit.cloth(kit.pick(*COLOURS)), kit.paint("beige", substance="skin")
    body = pillow(0.46, 0.28, 0.42 * height, 4.0).moved((0, 0, 0.45 * height))
    head = ball(0.075 * height).moved((0, 0, 0.92 * height))
    legs = [Piece("leg", "", leg.moved((x, 0, 0)), trousers, k) for k, x in enumerate((-0.1, 0.1))]
    return Thing("person", colour, (*legs, Piece("body", "", body, coat), Piece("head", "", head, skin)))


# The report.

LARGER = (480, 800)  # px, of windows beside them: with dilation as at the photographs' size, and growing
HEAD = (
    "capture", "training / held out", "preset", "with", "seed", "held out, dB", "exposure fitted, dB",
    f"at {QUICK_SIDE} px, dB", f"at each of {LARGER} px: dilation constant, growing",
    "SSIM", "training, dB", "budget", "Gaussians", "CPU-s",
)  # fmt: skip
# What a training has, beside its preset.
VARIANTS: dict[str, dict[str, object]] = {
    "before": {"few_views": 0, "capped_views": 0, "exposure": "off", "transients": "off"},
    "depths": {"capped_views": 0, "exposure": "off", "transients": "off"},
    "depths, exposures": {"capped_views": 0, "transients": "off"},
    "one training": {"ensemble": 1},
    "all": {},
}


@dataclass(frozen=True)
class Few:
    """Held-out PSNR of captures: without what few photographs get, with depths, with exposures too, and
    without what moves and steps that do not pay."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Captures, as of `langsplat train`."""
    rooms: tuple[Seed, ...] = ()
    """Seeds of drawn captures, beside the folders."""
    kind: Kind = "few"
    """Of drawn captures: on an arc around a table, or straight ahead along a street."""
    people: bool = False
    """Into the training photographs of drawn captures go people, each time elsewhere."""
    presets: tuple[TrainPreset, ...] = ("quick",)
    variants: tuple[str, ...] = tuple(VARIANTS)
    views: int = 0
    """Photographs, evenly spread over the capture; 0: all."""
    test_every: int = 4
    hold_out: Literal["chosen", "every"] = "chosen"
    uneven: float = 0.0
    """Deviation of the logarithm of the exposure that each training photograph is given; of that of each
    channel's gain, a third."""
    seeds: tuple[int, ...] = (0,)
    work: Path | None = None
    """Folder where drawn captures and cameras are kept from run to run."""

    def run(self) -> None:
        rows: list[tuple[str, ...]] = []
        with tempfile.TemporaryDirectory() as scratch, TerminalProgress() as progress:
            work = self.work or Path(scratch)
            drawn = [
                work / f"{self.kind}-{seed}{'-people' if self.people else ''}" / "photographs"
                for seed in self.rooms
            ]
            for seed, folder in zip(self.rooms, drawn, strict=True):
                draw_capture(folder, self.kind, seed, self.people, self.test_every, progress)
            for folder in (*self.folders, *drawn):
                name = folder.parent.name if folder in drawn else folder.name
                rows += self._rows(folder, name, work / name, progress)
        print(markdown(HEAD, rows))

    def _rows(self, folder: Path, name: str, work: Path, progress: Progress) -> Iterator[tuple[str, ...]]:
        larger = [self._capture(folder, work, side, progress)[0] for side in LARGER]
        for preset in self.presets:
            config = with_preset(TrainConfig(), preset)
            capture, train, held_out = self._capture(folder, work, config.dataset.max_side, progress)
            for variant in self.variants:
                for seed in self.seeds:
                    settings = replace(config.radiance, seed=seed, **VARIANTS[variant])  # type: ignore[arg-type]
                    found = _measured(capture, larger, settings, train, held_out, progress)
                    counts = f"{len(train)} / {len(held_out)}"
                    yield (name, counts, preset, variant, str(seed), *found)

    def _capture(
        self, folder: Path, work: Path, side: int, progress: Progress
    ) -> tuple[Capture, list[int], list[int]]:
        config = DatasetConfig(side, self.test_every, self.hold_out, allow_few_cameras=True)
        capture = load_capture(folder, config, work, progress)
        if self.views:
            rows = np.unique(np.linspace(0, len(capture) - 1, self.views).round().astype(int))
            capture = _subset(capture, [int(row) for row in rows])
        train, held_out = split_views(capture, config)
        if not held_out:
            held_out = [len(capture) // 2]
            train = [row for row in train if row not in held_out]
        if self.uneven:
            rng = np.random.default_rng(0)
            gains = np.exp(rng.normal(0, self.uneven, (len(capture), 1)))
            gains = gains * np.exp(rng.normal(0, self.uneven / 3, (len(capture), 3)))
            gains[held_out] = 1.0
            images = [
                (image * gain).clip(0, 255).astype(np.uint8)
                for image, gain in zip(capture.images, gains, strict=True)
            ]
            capture = replace(capture, images=tuple(images), photos=())  # not as the files are
        return capture, train, held_out


def _subset(capture: Capture, rows: Sequence[int]) -> Capture:
    kept = {
        name: tuple(getattr(capture, name)[row] for row in rows) if getattr(capture, name) else ()
        for name in ("cameras", "images", "photos", "masks")
    }
    return replace(capture, **kept)  # type: ignore[arg-type]


def _measured(
    capture: Capture,
    larger: Sequence[Capture],
    config: RadianceConfig,
    train: Sequence[int],
    held_out: Sequence[int],
    progress: Progress,
) -> tuple[str, ...]:
    began = time.process_time()
    settings = supported(config, len(train))
    gaussians = train_radiance(capture, settings, train, progress=progress)
    seconds = time.process_time() - began
    small = capture.read_at(held_out, QUICK_SIDE)
    scores = evaluate_views(gaussians, capture, held_out, small=small)
    learnt = evaluate_views(gaussians, capture, train)
    scene = Scene(gaussians, cameras=tuple(capture.cameras[i] for i in train))
    means = [
        np.mean([one for score in scores if (one := getattr(score, name)) is not None] or [np.nan])
        for name in ("psnr", "psnr_exposed", "psnr_small")
    ]
    windows = [
        np.mean([psnr(_image(drawn, at.cameras[i]) / 255, at.images[i] / 255) for i in held_out])
        for at in larger
        for drawn in (Scene(gaussians), scene)
    ]
    ssim = np.mean([score.ssim for score in scores])
    return (
        *(f"{mean:.2f}" for mean in means),
        ", ".join(f"{mean:.2f}" for mean in windows),
        *(f"{ssim:.3f}", f"{np.mean([score.psnr for score in learnt]):.2f}"),
        f"{settings.steps} steps at {max(capture.images[0].shape)} px",
        *(str(len(gaussians)), f"{seconds:.0f}"),
    )


def _image(scene: Scene, camera: Camera) -> Array:
    return (255 * render(scene, camera).colours.clip(0, 1)).round().astype(np.uint8)

"""Captures of drawn rooms and streets, empty or with people who stand elsewhere in every photograph."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from assets.making.dataset import FIRST_ROOM, LIGHT, write_transforms
from assets.making.kit import COLOURS, Kit, Piece, Thing
from assets.making.objects import FURNITURE, TABLE_TOP, furniture
from assets.making.render import Light, RenderedView, Renderer
from assets.making.shapes import ball, cylinder, pillow, rotation_about
from assets.making.world import ENLARGED, Placed, assemble, bounds, furnished
from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import surrounded_views
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera, look_at

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

"""A contact sheet of every class of object, so that one can see what the words of the demo encoder mean."""

import numpy as np
from PIL import Image, ImageDraw

from langsplat_core.arrays import Array
from langsplat_core.lab.world.appearance.colours import COLOURS
from langsplat_core.lab.world.appearance.render import Light, Renderer
from langsplat_core.lab.world.assembly import Placed, assemble
from langsplat_core.lab.world.geometry.shapes import rotation_about, sheet
from langsplat_core.lab.world.objects.catalogue import EVERYTHING
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import look_at

_CAPTION = 14  # px
_COLUMNS = 5  # classes side by side
_SIZE = 0.16  # metres: every object is scaled to fill a ball of this radius


def portrait(thing: Thing, side: int, azimuth: float) -> Array:
    """(side, side, 3) uint8 picture of one thing; `azimuth` turns it, in degrees, 0 shows its front."""
    ground = Piece("floor", "", sheet(4.0, 4.0, 0.05), Kit(np.random.default_rng(0)).paint("gray", gloss=0.0))
    reach = float(np.hypot(thing.radius, thing.height / 2))
    scale = _SIZE / reach
    world = assemble([
        Placed(Thing("floor", "", (ground,)), np.eye(3), np.zeros(3)),
        Placed(thing, rotation_about("z", azimuth), np.zeros(3), scale),
    ])  # fmt: skip
    renderer = Renderer(world, Light(np.array([-0.9, -1.0, 1.7])), samples=8)
    middle = np.array([0, 0, thing.height * scale / 2])
    camera = look_at(middle + np.array([0, -0.62, 0.36]), middle, np.array([0.0, 0, 1]), (side, side), 28)
    return renderer.picture(camera, oversample=2).image


def contact_sheet(instances: int = 3, side: int = 128, seed: int = 0, progress: Progress = silent) -> Array:
    """(H, W, 3) uint8: `instances` random portraits, `side` px each, of every class, with its word above."""
    width, height = instances * side + 6, side + _CAPTION
    rows = -(-len(EVERYTHING) // _COLUMNS)
    canvas = Image.new("RGB", (_COLUMNS * width, rows * height), "white")
    draw = ImageDraw.Draw(canvas)
    for number, (word, (builder, colours)) in enumerate(EVERYTHING.items()):
        x, y = number % _COLUMNS * width, number // _COLUMNS * height
        draw.text((x + 3, y + 1), word, fill="black")
        rng = np.random.default_rng((seed, number))
        words = rng.permutation([hue for hue in COLOURS if hue in colours])
        for k in range(instances):
            thing = builder(Kit(rng), str(words[k % len(words)]))
            azimuth = float(rng.uniform(-65, 65))
            canvas.paste(Image.fromarray(portrait(thing, side, azimuth)), (x + k * side, y + _CAPTION))
        progress("portraits", (number + 1) / len(EVERYTHING))
    return np.asarray(canvas)

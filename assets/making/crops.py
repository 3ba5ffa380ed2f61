"""Training images for the demo encoder: masked crops of random rooms, of plain colours, of clutter."""

import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter
from scipy.ndimage import binary_dilation, binary_erosion

from assets.making.kit import COLOURS, from_lch, random_colour, to_display, to_lch, to_linear
from assets.making.render import Light, RenderedView, Renderer, noise
from assets.making.world import TIERS, RegionLabel, World, build_room
from langsplat_core.arrays import Array
from langsplat_core.config import Count, CountOrZero, Rate, Seed
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import opened
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera, look_at
from langsplat_core.semantics.features import masked_crop

CROP = 64  # side of a training crop, px
_VIEW = (480, 360)  # width, height of the photographs that crops are cut from
_LEAST = (40, 60, 90)  # px: smaller visible regions of a level are not used
_ROOMS_PER_FILE = 10
_HELD_OUT = 1_000_000  # room seeds from here on are never trained with
_TIER_SHARES = (0.35, 0.5, 0.15)  # of the rooms
_CLUTTER = RegionLabel(-1, "", "", "", "", ())  # generic: the canonical phrases are right, no other


@dataclass(frozen=True)
class EncoderConfig:
    """Training of the demo encoder."""

    rooms: Count = 400  # random rooms that crops are rendered from
    views: Count = 3  # photographs of each room
    plain_crops: CountOrZero = 8_000  # crops of nothing but a colour or a texture
    steps: Count = 8_000  # of training
    batch: Count = 128  # crops per step
    phrases: Count = 192  # phrases per step
    lr: Rate = 1e-3  # largest learning rate
    seed: Seed = 0  # of random numbers


@dataclass(frozen=True, eq=False)
class CropSet:
    """Crops and what each one shows."""

    images: Array  # (N, 64, 64, 3) uint8
    labels: tuple[RegionLabel, ...]  # N; level -1: clutter, or nothing but its colour

    def save(self, path: Path) -> None:
        """Write one compressed file."""
        text = json.dumps([asdict(label) for label in self.labels])
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, images=self.images, labels=np.frombuffer(text.encode(), np.uint8))

    @staticmethod
    def load(path: Path) -> "CropSet":
        """Read what `save` wrote."""
        with np.load(path) as data:
            rows = json.loads(data["labels"].tobytes().decode())
            images = data["images"]
        for row in rows:
            row["hues"], row["materials"] = tuple(row["hues"]), tuple(row.get("materials", ()))
        return CropSet(images, tuple(RegionLabel(**row) for row in rows))

    @staticmethod
    def join(sets: list["CropSet"]) -> "CropSet":
        """Return one set of the crops of several."""
        labels = tuple(label for one in sets for label in one.labels)
        return CropSet(np.concatenate([one.images for one in sets]), labels)


def room_crops(seed: int, views: int) -> CropSet:
    """Crops of `views` photographs of the room of one seed: regions of all levels and some clutter."""
    rng = np.random.default_rng((seed, 11))
    world = build_room(seed, TIERS[rng.choice(len(TIERS), p=_TIER_SHARES)])
    angle, height = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 2.0)
    position = np.array([1.4 * np.cos(angle), 1.4 * np.sin(angle), height])
    light = Light(position, rng.uniform(0.3, 0.9), rng.uniform(0.6, 1.15), rng.uniform(0.75, 1.3))
    renderer = Renderer(world, light, samples=10)
    images: list[Array] = []
    labels: list[RegionLabel] = []
    for _ in range(views):
        rendered = renderer.render(_random_camera(rng), oversample=1)
        image = _photograph(rendered.image, rng)
        for mask, label in _regions(world, rendered, rng) + _clutter(world, rendered, rng):
            images.append(masked_crop(image, mask, CROP))
            labels.append(label)
    return CropSet(np.stack(images), tuple(labels))


def plain_crops(count: int, seed: int) -> CropSet:
    """Random blobs filled with one named colour under random light, or with meaningless textures."""
    rng = np.random.default_rng((seed, 13))
    images, labels = [], []
    for _ in range(count):
        mask = _blob(rng)
        if rng.random() < 0.75:
            word = str(rng.choice(COLOURS))
            image = _coloured(word, rng)
            label = RegionLabel(-1, "", "", word, "", (word,))
        else:
            image, label = _meaningless(rng), _CLUTTER
        images.append(masked_crop(_photograph(image, rng), mask, CROP))
        labels.append(label)
    return CropSet(np.stack(images), tuple(labels))


def _random_camera(rng: np.random.Generator) -> Camera:
    """Return a camera around the table that looks at some point on it, or now and then at the furniture."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(12, 62))
    distance = rng.uniform(0.75, 1.7)
    target = np.array([rng.uniform(-0.45, 0.45), rng.uniform(-0.35, 0.35), 0.05])
    if rng.random() < 0.15:
        target = np.array([rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 1.5), rng.uniform(-0.6, 0.6)])
    out = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    eye = np.clip(target * (1, 1, 0) + distance * out + (0, 0, 0.05), -2.1, 2.1)
    return look_at(eye, target, np.array([0.0, 0, 1]), _VIEW, rng.uniform(35, 58))


def _photograph(image: Array, rng: np.random.Generator) -> Array:
    """Return the image with exposure, white balance, blur, noise and compression of a real camera."""
    gain = np.exp(rng.normal(0, 0.14)) * np.exp(rng.normal(0, 0.035, 3))
    pixels = to_display(to_linear(np.arange(256) / 255)[:, None] * gain)  # (256, 3) look-up per channel
    result = Image.fromarray(
        (np.stack([pixels[image[..., c], c] for c in range(3)], -1) * 255 + 0.5).astype(np.uint8)
    )
    if rng.random() < 0.5:
        result = result.filter(ImageFilter.GaussianBlur(float(rng.uniform(0.2, 1.3))))
    if rng.random() < 0.4:
        buffer = io.BytesIO()
        result.save(buffer, "JPEG", quality=int(rng.integers(35, 92)))
        with opened(buffer.getvalue()) as compressed:
            result = compressed.convert("RGB")
    grain = rng.normal(0, rng.uniform(0, 7), image.shape)
    return np.clip(np.asarray(result) + grain, 0, 255).astype(np.uint8)


def _regions(
    world: World, rendered: RenderedView, rng: np.random.Generator
) -> list[tuple[Array, RegionLabel]]:
    """Return an imperfect mask for every region that is large enough; equal regions of two levels once."""
    ids = np.where(rendered.pieces[..., None] >= 0, world.ids[rendered.pieces], -1)
    found: list[tuple[Array, RegionLabel]] = []
    seen: set[tuple[int, int, int]] = set()
    for level in (2, 1, 0):
        for number, count in zip(*np.unique(ids[..., level], return_counts=True), strict=True):
            if number < 0 or count < _LEAST[level]:
                continue
            mask = ids[..., level] == number
            label = world.labels[number]
            ys, xs = np.nonzero(mask)
            key = (int(count), int(ys.sum()), int(xs.sum()))
            if key in seen:
                continue
            seen.add(key)
            found.append((_imperfect(mask, rng), label))
    return found


def _window(mask: Array, margin: int) -> tuple[slice, slice]:
    ys, xs = np.nonzero(mask)
    return (
        slice(max(ys.min() - margin, 0), ys.max() + margin + 1),
        slice(max(xs.min() - margin, 0), xs.max() + margin + 1),
    )


def _imperfect(mask: Array, rng: np.random.Generator) -> Array:
    """Mask that a segmenter might return for a region: grown, shrunk, cut, holed, leaking; never empty."""
    box = _window(mask, 8)
    part = mask[box].copy()
    kind = rng.random()
    if kind < 0.3:
        return mask
    if kind < 0.5:
        part = binary_dilation(part, iterations=int(rng.integers(1, 4)))
    elif kind < 0.62:
        part = binary_erosion(part, iterations=int(rng.integers(1, 3)))
    else:
        y, x = np.mgrid[: part.shape[0], : part.shape[1]]
        size = np.sqrt(part.sum())
        if kind < 0.8:  # a half plane that takes away up to a third
            angle = rng.uniform(0, 2 * np.pi)
            height = np.cos(angle) * x + np.sin(angle) * y
            part &= height < np.quantile(height[part], rng.uniform(0.67, 1))
        else:
            spots = np.zeros_like(part)
            for _ in range(int(rng.integers(1, 4))):
                at = rng.integers(0, part.sum())
                cy, cx = (axis[at] for axis in np.nonzero(part))
                spots |= np.hypot(y - cy, x - cx) < rng.uniform(0.08, 0.22) * size
            part = part & ~spots if kind < 0.9 else part | spots
    if part.sum() < 0.4 * mask.sum():
        return mask
    result = np.zeros_like(mask)
    result[box] = part
    return result


def _clutter(
    world: World, rendered: RenderedView, rng: np.random.Generator
) -> list[tuple[Array, RegionLabel]]:
    """Masks that cover bits of several objects, so that no word is right for them."""
    height, width = rendered.pieces.shape
    wholes = np.where(rendered.pieces >= 0, world.ids[rendered.pieces, 2], -1)
    y, x = np.mgrid[:height, :width]
    found: list[tuple[Array, RegionLabel]] = []
    for _ in range(14):
        cy, cx, r = rng.uniform(0, height), rng.uniform(0, width), rng.uniform(20, 90)
        wave = 1 + 0.3 * np.sin(3 * np.arctan2(y - cy, x - cx) + rng.uniform(0, 6))
        mask = np.hypot(y - cy, x - cx) < r * wave
        if rng.random() < 0.5:  # loose bits of what lies there instead of all of it
            bits = np.unique(rendered.pieces[mask])
            mask &= np.isin(rendered.pieces, rng.permutation(bits)[: max(2, len(bits) // 2)])
        if mask.sum() > 300 and np.unique(wholes[mask], return_counts=True)[1].max() < 0.55 * mask.sum():
            found.append((mask, _CLUTTER))
    return found[:6]


def _lattice(rng: np.random.Generator) -> Array:
    """Return (64 * 64, 3) points of a random plane through noise space."""
    y, x = np.mgrid[:CROP, :CROP] / CROP
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) + rng.uniform(0, 10, 3)


def _blob(rng: np.random.Generator) -> Array:
    """Return (64, 64) random connected-looking mask, now and then the full square."""
    y, x = np.mgrid[:CROP, :CROP] / CROP - 0.5
    angle = rng.uniform(0, np.pi)
    u, v = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    shape = np.hypot(u, v * rng.uniform(1, 3)) + 0.09 * noise(_lattice(rng), rng.uniform(0.8, 3)).reshape(
        x.shape
    )
    mask = shape < rng.uniform(0.2, 0.55)
    return mask if mask.sum() > 60 else np.ones_like(mask)


def _coloured(word: str, rng: np.random.Generator) -> Array:
    """Draw (64, 64, 3) uint8 of mostly one colour word: patches of its shades, shadow, highlights."""
    shades = np.stack([random_colour(word, rng) for _ in range(3)])
    near = random_colour(word, rng)
    shades = near + (shades - near) * rng.uniform(0, 1)
    planes = [noise(_lattice(rng), rng.uniform(0.3, 4)) for _ in range(4)]
    weight = np.exp(1.5 * np.stack(planes[:3], 1))
    colour = (weight / weight.sum(1, keepdims=True)) @ shades
    direction, strength = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.45)
    y, x = np.mgrid[:CROP, :CROP].reshape(2, -1) / CROP - 0.5
    shading = 1 + strength * (np.cos(direction) * x + np.sin(direction) * y) * 2
    shading *= np.exp(rng.uniform(0, 0.25) * planes[3] - rng.uniform(0, 0.2))
    linear = to_linear(np.clip(colour, 0, 1)) * shading[:, None]
    if rng.random() < 0.4 and word != "black":
        spot = np.hypot(x - rng.uniform(-0.3, 0.3), y - rng.uniform(-0.3, 0.3))
        linear += rng.uniform(0, 0.5) * np.exp(-((spot / rng.uniform(0.04, 0.15)) ** 2))[:, None]
    if rng.random() < 0.3:  # marks of another colour on a tenth of it
        marks = noise(_lattice(rng), rng.uniform(0.5, 2)) > 1.35
        linear[marks] = to_linear(random_colour(str(rng.choice(COLOURS)), rng))
    return (to_display(linear) * 255).astype(np.uint8).reshape(CROP, CROP, 3)


def _meaningless(rng: np.random.Generator) -> Array:
    """Return (64, 64, 3) uint8 of many colours: noise, stripes, patches."""
    planes = np.stack([noise(_lattice(rng), rng.uniform(0.2, 2)) for _ in range(3)], 1)
    style = rng.random()
    if style < 0.35:
        colour = 0.5 + rng.uniform(0.1, 0.3) * planes
    elif style < 0.7:
        patch = np.floor(2.2 * planes[:, 0] + 1.3 * planes[:, 1]).astype(int) % 6
        colour = rng.uniform(0, 1, (6, 3))[patch] + 0.05 * planes
    else:
        lch = to_lch(rng.uniform(0.1, 0.9, 3))
        spread = np.stack(
            [lch[0] + 14 * planes[:, 0], lch[1] + 10 * planes[:, 1], lch[2] + 90 * planes[:, 2]], 1
        )
        colour = from_lch(np.clip(spread, 0, None))
    return (np.clip(colour, 0, 1) * 255).astype(np.uint8).reshape(CROP, CROP, 3)


def write_crops(folder: Path, config: EncoderConfig, progress: Progress) -> None:
    """Render all crops of a training run into `folder`, one file per ten rooms; what is there is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(f"held-out-{k}", _HELD_OUT + 10 * k, 10) for k in range(2)]
    jobs += [(f"rooms-{k:04d}", k, _ROOMS_PER_FILE) for k in range(0, config.rooms, _ROOMS_PER_FILE)]
    for done, (name, first, count) in enumerate(jobs):
        progress("rendering crops", done / len(jobs))
        path = folder / f"{name}.npz"
        if not path.exists():
            seeds = [config.seed * 100_000 + first + k for k in range(count)]
            CropSet.join([room_crops(seed, config.views) for seed in seeds]).save(path)
    path = folder / "plain.npz"
    if not path.exists():
        plain_crops(config.plain_crops, config.seed).save(path)
    progress("rendering crops", 1.0)


def read_crops(folder: Path) -> tuple[CropSet, CropSet]:
    """(training crops, held-out crops) of whatever files are in `folder`."""
    train = [*sorted(folder.glob("rooms-*.npz")), *folder.glob("plain.npz")]
    held_out = sorted(folder.glob("held-out-*.npz"))
    return CropSet.join([CropSet.load(p) for p in train]), CropSet.join([CropSet.load(p) for p in held_out])

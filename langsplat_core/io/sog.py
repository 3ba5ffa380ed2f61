"""SOG version 2 (PlayCanvas "spatially ordered Gaussians"): images of quantised columns.

`meta.json` names the images; they lie beside it in a folder, or with it in one `.sog` (zip). Pixel i, row
by row, belongs to Gaussian i:

    means[0], means[1]   low and high bytes of 16-bit fractions between `mins` and `maxs`, of
                         sign(x) log(1 + |x|) per axis
    quats                the three smaller of w x y z as fractions of [-sqrt(1/2), sqrt(1/2)]; alpha - 252
                         says which one is left out (it is positive)
    scales               indices into `codebook` of log scales
    sh0                  rgb: indices into `codebook` of f_dc; alpha: opacity (not a logit)
    shN, optional        files[1]: 16-bit number of a palette entry; files[0]: the palette, 64 entries a
                         row, one pixel per coefficient, rgb: indices into `codebook`

A streamed scene is a folder of such folders with `lod-meta.json`: `filenames` of their meta files, and a
`tree` of boxes whose leaves name, for each level of detail ("0" is the finest), a `file` and the rows from
`offset`, `count` of them, in it. `environment` may name one more, of what lies around.

Opacities of 0 and 1 become logits of -infinity and +infinity. `model: "antialiased"`, in older files
`antialias: true`, says that the Gaussians were trained with Mip-Splatting's compensation. Source:
PlayCanvas' public specification.
"""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.errors import malformed, quoted
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import (
    exists,
    is_plain_name,
    open_for_reading,
    opened,
    opened_archive,
    parse_json,
    read_json_file,
)
from langsplat_core.io.packing import smallest_three, to_bytes, without_largest
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene
from langsplat_core.scene.gaussians import join_gaussians

META_NAME, LOD_NAME = "meta.json", "lod-meta.json"
LOD_LIMIT = 16 << 20  # bytes of lod-meta.json; a leaf, of some thousand Gaussians, has 300
META_LIMIT = 1024 * 1024  # bytes; a real one has three codebooks, 15 kB
PALETTE_ROW, PALETTE_ROWS = 64, 1024  # entries a row, most rows
IMAGE_LIMIT = 1 << 30  # bytes of one image file
# The low bytes of positions are close to noise: lossless compression gains 3 to 1 at best. An image that
# claims to have gained 64 to 1 is made to exhaust memory.
PIXELS_PER_BYTE = 64
SLACK_PIXELS = 65536

Fetch = Callable[[str, int], bytes]  # (file name, most bytes) -> content


def read_sog_scene(path: Path | str) -> Scene:
    """Return the Gaussians of a SOG folder, its `meta.json` or a `.sog` file, and whether they are to be
    drawn antialiased; of a streamed scene (`lod-meta.json`) all of its finest level.

    Raises InputError when a file cannot be opened and FormatError when it breaks a rule of the format.
    """
    path = Path(path)
    if path.name == LOD_NAME or (path.is_dir() and exists(path / LOD_NAME) and not exists(path / META_NAME)):
        return _read_streamed(path / LOD_NAME if path.is_dir() else path)
    if path.is_dir():
        return _decode(_folder_reader(path), path / META_NAME)
    if path.suffix.lower() == ".json":
        return _decode(_folder_reader(path.parent), path)
    with opened_archive(path, "SOG archive") as archive:
        # The images are compressed already, so a member far larger than its archive is a trap.
        most = 16 * archive.size + META_LIMIT
        return _decode(lambda name, limit: archive.read(name, min(limit, most)), path / META_NAME)


def _read_streamed(path: Path) -> Scene:
    content = read_json_file(path, LOD_LIMIT)
    try:
        names, tree = content["filenames"], content["tree"]
        ranges = _finest_ranges(tree)
        environment = content.get("environment")
        files = {number: _inside(path, names[number]) for number in ranges}
        around = [] if environment is None else [_inside(path, environment)]
        if len({*files.values(), *around}) < len(files) + len(around):
            raise ValueError("a file is named twice")
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        raise malformed(path, f"not a sound {LOD_NAME} ({str(error)[:80]})", "export it again") from None
    parts, antialiased = [], False
    for number, file in files.items():
        scene = read_sog_scene(file)
        count, rows = len(scene.gaussians), ranges[number]
        if sum(length for _, length in rows) > count or any(at + length > count for at, length in rows):
            raise malformed(path, f"asks for more than the {count} Gaussians of {file}")
        parts += [scene.gaussians.take(np.arange(at, at + length)) for at, length in rows]
        antialiased |= scene.antialiased
    parts += [read_sog_scene(file).gaussians for file in around]
    return Scene(join_gaussians(parts), antialiased=antialiased)


def _finest_ranges(tree: Any) -> dict[int, list[tuple[int, int]]]:
    """File -> (offset, count) of the rows of the finest level, in the order of the tree."""
    waiting, leaves = [tree], []
    while waiting:
        node = waiting.pop()
        waiting += reversed(node.get("children", []))
        leaves.append({int(level): place for level, place in node.get("lods", {}).items()})
    finest = min((level for leaf in leaves for level in leaf), default=0)
    ranges: dict[int, list[tuple[int, int]]] = {}
    for place in (leaf[finest] for leaf in leaves if finest in leaf):
        numbers = [place[key] for key in ("file", "offset", "count")]
        if any(type(number) is not int or number < 0 for number in numbers):
            raise ValueError(f"{quoted(place)} is no place")
        ranges.setdefault(numbers[0], []).append((numbers[1], numbers[2]))
    return ranges


def _inside(path: Path, name: Any) -> Path:
    """A file beside `path` or in a folder there: a path could lead out of it."""
    parts = name.split("/") if isinstance(name, str) else []
    if not 1 <= len(parts) <= 2 or not all(map(is_plain_name, parts)):
        raise ValueError(f"{quoted(name)} is no file in the scene's folder")
    if parts[-1] != META_NAME and not parts[-1].endswith(".sog"):
        raise ValueError(f"{quoted(name)} is no SOG")
    return path.parent.joinpath(*parts)


def _folder_reader(folder: Path) -> Fetch:
    def fetch(name: str, limit: int) -> bytes:
        file, size = open_for_reading(folder / name)
        with file:
            if size > limit:
                raise malformed(folder / name, f"{size} bytes; expected at most {limit}")
            return file.read(size)

    return fetch


def _decode(fetch: Fetch, meta_path: Path) -> Scene:
    """Decode the scene whose meta file `fetch` finds by the last part of `meta_path`."""
    meta = _Meta(parse_json(fetch(meta_path.name, META_LIMIT), meta_path), meta_path)
    return Scene(_gaussians(fetch, meta), antialiased=meta.antialiased())


def _gaussians(fetch: Fetch, meta: "_Meta") -> Gaussians:
    count = meta.whole_number("count", least=0, most=2**32)
    planes = _Planes(fetch, meta, count)
    low, high = planes.of_gaussians("means", 0), planes.of_gaussians("means", 1)
    fractions = (low[:, :3] + high[:, :3].astype(np.uint32) * 256) / 65535
    mins, maxs = (meta.numbers("means", key, 3) for key in ("mins", "maxs"))
    logs = mins + (maxs - mins) * fractions
    quats = planes.of_gaussians("quats", 0)
    if count and quats[:, 3].min() < 252:
        raise malformed(meta.path, "'quats' holds an alpha below 252", "was the image saved lossily?")
    sh0 = planes.of_gaussians("sh0", 0)
    base = meta.numbers("sh0", "codebook", 256)[sh0[:, :3]]
    with np.errstate(over="ignore"):  # overflow to infinity makes rows that are dropped later
        means = np.sign(logs) * np.expm1(np.abs(logs))
    return Gaussians(
        means=means,
        log_scales=meta.numbers("scales", "codebook", 256)[planes.of_gaussians("scales", 0)[:, :3]],
        quats_wxyz=smallest_three((quats[:, :3] / 255 - 0.5) * np.sqrt(2), quats[:, 3] - 252),
        opacity_logits=logit(sh0[:, 3] / 255),
        sh=np.concatenate([base[:, None], _rest(planes, meta)], axis=1),
    )


def _rest(planes: "_Planes", meta: "_Meta") -> Array:
    """(N, K - 1, 3) higher coefficients, from the palette."""
    if "shN" not in meta.content:
        return np.zeros((planes.count, 0, 3))
    bands = meta.whole_number("shN", "bands", least=1, most=3)
    entries = meta.whole_number("shN", "count", least=1, most=65536)
    coefficients = SH_COUNTS[bands] - 1
    palette = planes.palette(coefficients, entries)
    labels = planes.of_gaussians("shN", 1)
    entry = labels[:, 0] + labels[:, 1].astype(np.uint32) * 256
    if planes.count and entry.max() >= entries:
        raise malformed(meta.path, f"a label of 'shN' is {entry.max()}", f"the palette has {entries} entries")
    return meta.numbers("shN", "codebook", 256)[palette[entry]]


class _Planes:
    """The images, each checked before it is decoded."""

    def __init__(self, fetch: Fetch, meta: "_Meta", count: int) -> None:
        self._fetch, self._meta, self.count = fetch, meta, count

    def of_gaussians(self, key: str, index: int) -> Array:
        """(N, 4) uint8 rgba of image `index` of property `key`."""
        pixels = self._image(key, index, lambda w, h: self.count <= w * h <= 2 * self.count + SLACK_PIXELS)
        return pixels.reshape(-1, 4)[: self.count]

    def palette(self, coefficients: int, entries: int) -> Array:
        """(entries, coefficients, 3) uint8 codes of the image shN.files[0]."""
        rows = -(-entries // PALETTE_ROW)
        width = PALETTE_ROW * coefficients
        pixels = self._image("shN", 0, lambda w, h: w == width and rows <= h <= PALETTE_ROWS)
        return pixels[:rows].reshape(rows * PALETTE_ROW, coefficients, 4)[:entries, :, :3]

    def _image(self, key: str, index: int, suits: Callable[[int, int], bool]) -> Array:
        """(H, W, 4) uint8; `suits` judges (width, height) before anything is decoded."""
        name = self._meta.file_name(key, index)
        what = f"{self._meta.path}: image {quoted(name)} of {key!r}"
        data = self._fetch(name, IMAGE_LIMIT)
        if key == "means" and self.count > PIXELS_PER_BYTE * len(data) + SLACK_PIXELS:
            raise malformed(self._meta.path, f"image {quoted(name)} is too small for {self.count} Gaussians")
        with opened(data, what, ("WEBP", "PNG")) as image:
            if not suits(*image.size):
                size = f"{image.width}x{image.height}"
                raise malformed(what, f"{size} pixels do not suit {self.count} Gaussians")
            # A lossless image of full opacity is stored without alpha: convert makes it 255 again.
            return np.asarray(image.convert("RGBA"))


class _Meta:
    """`meta.json`, whose every entry is checked when it is asked for."""

    def __init__(self, content: Any, path: Path) -> None:
        if not isinstance(content, dict):
            raise malformed(path, "expected a JSON object")
        version = content.get("version", 1)
        if version != 2:
            raise malformed(path, f"SOG version {quoted(version)}; only 2 is read, export the scene again")
        self.content, self.path = content, path

    def antialiased(self) -> bool:
        return self.content.get("model") == "antialiased" or self.content.get("antialias") is True

    def whole_number(self, *keys: str, least: int, most: int) -> int:
        value = self._at(keys)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise malformed(self.path, f"{'.'.join(keys)} is not a whole number from {least} to {most}")
        return value

    def numbers(self, group: str, key: str, count: int) -> Array:
        """Return the list under `group` and `key` as a (count,) array of finite float64."""
        value = self._at((group, key))
        if not isinstance(value, list) or len(value) != count or not all(map(_is_finite_number, value)):
            raise malformed(self.path, f"{group}.{key} is not a list of {count} numbers")
        return np.array(value, dtype=np.float64)

    def file_name(self, group: str, index: int) -> str:
        """A plain file name: a path could lead out of the scene's folder."""
        files = self._at((group, "files"))
        name = files[index] if isinstance(files, list) and len(files) > index else None
        if not is_plain_name(name):
            raise malformed(self.path, f"{group}.files has no plain file name at place {index}")
        return str(name)

    def _at(self, keys: tuple[str, ...]) -> Any:
        value: Any = self.content
        for key in keys:
            if not isinstance(value, dict) or key not in value:
                raise malformed(self.path, f"{'.'.join(keys)} is missing")
            value = value[key]
        return value


def _is_finite_number(value: Any) -> bool:
    # Python's integers have no limit: one beyond float64 must not reach NumPy
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


# Writing: one `.sog` file, rows in their order.

CODES = 256  # entries of a codebook
ROUNDS = 30  # of Lloyd's algorithm for one
MOST_ENTRIES = 65536  # of the palette of higher coefficients


def write_sog(path: Path | str, gaussians: Gaussians, antialiased: bool = False) -> None:
    """Write a bundled .sog, atomically; rows keep their order.

    Positions are rounded to 1/65535 of the scene's extent in sign(x) log(1 + |x|), quaternions and opacities
    to 1/255; scales, colours and higher coefficients to the nearest of 256 values each, chosen for the
    scene; with more than 65536 Gaussians the higher coefficients of several are one entry of a palette. A row
    that cannot be drawn is written with opacity 0.
    """
    valid = gaussians.valid()
    count = len(gaussians)
    side = max(int(np.ceil(np.sqrt(count))), 1)
    images: dict[str, Array] = {}

    def plane(name: str, codes: Array) -> str:
        pixels = np.zeros((-(-max(count, 1) // side) * side, 4), np.uint8)
        pixels[:, 3] = 255
        pixels[:count, : codes.shape[1]] = codes
        images[name] = pixels.reshape(-1, side, 4)
        return name

    means = np.where(valid[:, None], gaussians.means, 0).astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (reduced(logs[valid], axis=0) if valid.any() else np.zeros(3) for reduced in (np.min, np.max))
    spans = np.where(high > low, high - low, 1)
    whole = np.rint(((logs - low) / spans).clip(0, 1) * 65535).astype(np.uint32)
    scales = np.where(valid[:, None], gaussians.log_scales, 0).astype(np.float64).clip(LEAST_SCALE)
    scale_codes, scale_book = _coded(scales, valid)
    colours = np.where(valid[:, None, None], gaussians.sh, 0).astype(np.float64)
    base_codes, base_book = _coded(colours[:, 0], valid)
    opacities = np.where(valid, sigmoid(gaussians.opacity_logits.astype(np.float64)), 0)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "langsplat-viewer"},
        "count": count,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [plane("means_l.webp", whole & 255), plane("means_u.webp", whole >> 8)],
        },
        "scales": {"codebook": scale_book.tolist(), "files": [plane("scales.webp", scale_codes)]},
        "quats": {"files": [plane("quats.webp", _quaternion_codes(gaussians.quats_wxyz, valid))]},
        "sh0": {
            "codebook": base_book.tolist(),
            "files": [
                plane("sh0.webp", np.concatenate([base_codes, np.rint(255 * opacities)[:, None]], axis=1))
            ],
        },
    }
    if antialiased:
        meta["antialias"] = True
    if gaussians.sh_degree and valid.any():
        entry, palette = _palette(colours[:, 1:].reshape(count, -1), valid)
        codes, book = _coded(palette, np.ones(len(palette), bool))
        coefficients = colours.shape[1] - 1
        rows = -(-len(palette) // PALETTE_ROW)
        table = np.full((rows * PALETTE_ROW, coefficients, 4), 255, np.uint8)
        table[: len(palette), :, :3] = codes.reshape(len(palette), coefficients, 3)
        images["shN_centroids.webp"] = table.reshape(rows, PALETTE_ROW * coefficients, 4)
        labels = np.stack([entry & 255, entry >> 8], axis=1)
        meta["shN"] = {
            "count": len(palette),
            "bands": gaussians.sh_degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", plane("shN_labels.webp", labels)],
        }
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, pixels in images.items():
            encoded = io.BytesIO()
            Image.fromarray(pixels).save(encoded, "WEBP", lossless=True, exact=True, quality=100)
            archive.writestr(zipfile.ZipInfo(name), encoded.getvalue())
        archive.writestr(zipfile.ZipInfo(META_NAME), json.dumps(meta))


LEAST_SCALE = -30.0  # logarithm: a flat axis


def _quaternion_codes(quats: Array, valid: Array) -> Array:
    """(N, 4) uint8: the three smaller components, and 252 plus the number of the largest."""
    three, largest = without_largest(np.where(valid[:, None], quats, [1, 0, 0, 0]))
    codes = to_bytes((three / np.sqrt(2) + 0.5) * 255)
    return np.concatenate([codes, 252 + largest[:, None].astype(np.uint8)], axis=1)


def _coded(values: Array, counts: Array) -> tuple[Array, Array]:
    """(N, C) uint8 codes, and the (256,) rising values that they stand for: those with the least squared
    error over the rows that count, by Lloyd's algorithm in one dimension."""
    known = np.sort(values[counts].ravel())
    if len(known) == 0:
        return np.zeros(values.shape, np.uint8), np.zeros(CODES)
    sums = np.concatenate([[0.0], np.cumsum(known)])
    # Half of the first values by how many there are, half evenly over their range: tails count too.
    even = np.linspace(known[0], known[-1], CODES // 2)
    book = np.sort(np.concatenate([np.quantile(known, np.linspace(0, 1, CODES - len(even))), even]))
    for _ in range(ROUNDS):
        edges = np.concatenate([[0], np.searchsorted(known, (book[1:] + book[:-1]) / 2), [len(known)]])
        sizes = np.diff(edges)
        book = np.sort(np.where(sizes > 0, np.diff(sums[edges]) / np.maximum(sizes, 1), book))
    codes = np.searchsorted((book[1:] + book[:-1]) / 2, values)
    return codes.astype(np.uint8), book


def _palette(values: Array, counts: Array) -> tuple[Array, Array]:
    """(N,) number of a palette entry, and (P, D) entries: every row that counts its own while there is room,
    else the means of groups that are halved where they vary most (median cut)."""
    rows = np.flatnonzero(counts)
    group = np.zeros(len(values), np.int64)
    if len(rows) <= MOST_ENTRIES:
        group[rows] = np.arange(len(rows))
        return group, values[rows]
    own = np.zeros(len(rows), np.int64)
    for _ in range(int(np.log2(MOST_ENTRIES))):
        sizes = np.bincount(own)
        centres, squares = (
            np.stack([np.bincount(own, column) for column in powers.T], 1) / sizes[:, None]
            for powers in (values[rows], values[rows] ** 2)
        )
        axis = (squares - centres**2).argmax(1)[own]
        above = values[rows, axis] > centres[own, axis]
        own = np.unique(2 * own + above, return_inverse=True)[1]
    sizes = np.bincount(own)
    entries = np.stack([np.bincount(own, column) for column in values[rows].T], 1) / sizes[:, None]
    group[rows] = own
    return group, entries

"""SOG version 2 (PlayCanvas "spatially ordered Gaussians"): images of quantised columns.

`meta.json` names the images, beside it in a folder or one `.sog` (zip). Pixel i, row by row, is Gaussian i's:

    means[0], means[1]   low and high bytes of 16-bit fractions between `mins` and `maxs`, of
                         sign(x) log(1 + |x|) per axis
    quats                the three smaller of w x y z as fractions of [-sqrt(1/2), sqrt(1/2)]; alpha - 252
                         is the index of the omitted one, the largest (it is positive)
    scales               indices into `codebook` of log scales
    sh0                  rgb: indices into `codebook` of f_dc; alpha: opacity (not a logit)
    shN, optional        files[1]: 16-bit number of a palette entry; files[0]: the palette, 64 entries a
                         row, one pixel per coefficient, rgb: indices into `codebook`

Opacities of 0 and 1 become logits of -infinity and +infinity. `model: "antialiased"`, in older files
`antialias: true`, says that the Gaussians were trained with Mip-Splatting's compensation. Pixels after the
last Gaussian are black. Other pixels there, and all other content of the file, are ignored and reported.
Source: PlayCanvas' public specification.
"""

import io
import json
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy
from msgspec import Meta, Struct
from PIL import Image

from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.errors import malformed, quoted, report_losses, unread
from langsplat_core.io import hostile
from langsplat_core.io.files import atomic_path
from langsplat_core.io.quantised import check_steps, smallest_three, to_bytes, without_largest
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene, about_origin

META_NAME = "meta.json"
META_LIMIT = 1024 * 1024  # bytes; a real file has three codebooks, 15 kB
PALETTE_ROW, PALETTE_ROWS = 64, 1024  # entries per row, and most rows
IMAGE_LIMIT = 1 << 30  # bytes of one image file
SLACK_PIXELS = 65536

Fetch = Callable[[str, int], bytes]  # (file name, most bytes) -> content


# Entries of `meta.json` that are read.

Number = Annotated[float, Meta(ge=-1e30, le=1e30)]
Whole = Annotated[int, Meta(ge=0, le=2**32)]
Codebook = Annotated[list[Number], Meta(min_length=256, max_length=256)]
One = Annotated[list[str], Meta(min_length=1)]  # names of images
Two = Annotated[list[str], Meta(min_length=2)]


class _Versioned(Struct):
    version: Any = 1


class _Images(Struct):
    files: One


class _Means(Struct):
    mins: tuple[Number, Number, Number]
    maxs: tuple[Number, Number, Number]
    files: Two


class _Coded(_Images, kw_only=True):
    codebook: Codebook


class _Higher(Struct):
    codebook: Codebook
    files: Two
    count: Annotated[int, Meta(ge=1, le=65536)]
    bands: Annotated[int, Meta(ge=1, le=3)]


class _Meta(Struct, rename={"higher": "shN"}):
    count: Whole
    means: _Means
    scales: _Coded
    quats: _Images
    sh0: _Coded
    higher: _Higher | None = None
    model: Any = None
    antialias: Any = None


ENTRIES = {*_Meta.__struct_encode_fields__, "version", "asset"}


def read_sog_scene(path: Path | str) -> Scene:
    """Return the Gaussians of a SOG folder, its `meta.json` or a `.sog` file.

    `antialiased` is set as in the file. FormatError for a file that breaks a rule of the format.
    """
    path = Path(path)
    if path.is_dir():
        path = path / META_NAME
    if path.suffix.lower() == ".json":
        size = sum(file.stat().st_size for file in path.parent.glob("*") if file.is_file())
        images = [file.name for file in path.parent.glob("*.webp")]
        return _decode(lambda name, limit: hostile.read_file(path.parent / name, limit), path, size, images)
    with hostile.opened_archive(path, "SOG archive") as archive:
        # The images are compressed already, so a member far larger than its archive is hostile.
        most, about = 16 * archive.size + META_LIMIT, (path / META_NAME, archive.size, archive.names)
        return _decode(lambda name, limit: archive.read(name, min(limit, most)), *about)


def _decode(fetch: Fetch, meta_path: Path, size: int, files: Iterable[str]) -> Scene:
    """Return the scene in `files` of `size` bytes together, of which `fetch` returns the content by name."""
    text = fetch(meta_path.name, META_LIMIT)
    version = hostile.decode_json(text, _Versioned, meta_path).version
    if version != 2:
        what = f"SOG version {quoted(version)}; only 2 is read"
        raise malformed(meta_path, what, "export the scene again")
    meta = hostile.decode_json(text, _Meta, meta_path)
    degree = meta.higher.bands if meta.higher is not None else 0
    hostile.Allowance(meta_path, size, hostile.SMALL_RATIO).take_gaussians(meta.count, degree)
    antialiased = meta.model == "antialiased" or meta.antialias is True
    planes = _Planes(fetch, meta_path, meta.count)
    scene = replace(_scene(planes, meta), antialiased=antialiased)
    told = [*planes.told, hostile.other_entries(text, ENTRIES, meta_path)]
    if planes.beyond:
        told.append(f"pixels of {planes.beyond} Gaussians behind its {meta.count} not read")
    if meta.model not in (None, "antialiased") or meta.antialias not in (None, True, False):
        told.append("what it says of antialiasing not understood")
    told.append(unread("files", (name for name in files if name not in planes.read and name[-1] != "/")))
    report_losses(meta_path, told)
    return scene


def _scene(planes: "_Planes", meta: _Meta) -> Scene:
    low, high = (planes.of_gaussians(name) for name in meta.means.files[:2])
    fractions = (low[:, :3] + high[:, :3].astype(np.uint32) * 256) / 65535
    mins, maxs = np.array(meta.means.mins), np.array(meta.means.maxs)
    logs = mins + (maxs - mins) * fractions
    quats = planes.of_gaussians(meta.quats.files[0])
    if meta.count and quats[:, 3].min() < 252:
        raise malformed(planes.path, "'quats' holds an alpha below 252", "was the image saved lossily?")
    sh0 = planes.of_gaussians(meta.sh0.files[0])
    base = np.array(meta.sh0.codebook, np.float32)[sh0[:, :3]]
    rest = np.zeros((meta.count, 0, 3), np.float32)
    if meta.higher is not None:
        palette = planes.palette(meta.higher.files[0], SH_COUNTS[meta.higher.bands] - 1, meta.higher.count)
        labels = planes.of_gaussians(meta.higher.files[1])
        entry = labels[:, 0] + labels[:, 1].astype(np.uint32) * 256
        if entry.max(initial=0) >= len(palette):
            raise malformed(planes.path, f"a label of 'shN' is beyond the {len(palette)} of its palette")
        rest = np.array(meta.higher.codebook, np.float32)[palette[entry]]
    with np.errstate(over="ignore"):  # rows that overflow to infinity are dropped later
        means, origin = about_origin(np.sign(logs) * np.expm1(np.abs(logs)))
    gaussians = Gaussians(
        means=means,
        log_scales=np.array(meta.scales.codebook, np.float32)[
            planes.of_gaussians(meta.scales.files[0])[:, :3]
        ],
        quats_wxyz=smallest_three(
            (quats[:, :3] / 255 - 0.5) * np.sqrt(2), quats[:, 3] - 252, planes.told.append
        ),
        opacity_logits=logit(sh0[:, 3] / 255),
        sh=np.concatenate([base[:, None], rest], axis=1),
    )
    return Scene(gaussians, origin=origin)


class _Planes:
    """The images of a scene, each checked before it is decoded."""

    def __init__(self, fetch: Fetch, path: Path, count: int) -> None:
        self.path, self.count, self._fetch = path, count, fetch
        self.read = {path.name}  # names of files
        self.told: list[str] = []  # lines about what was guessed
        self.beyond = 0  # pixels after the last Gaussian that are not black

    def of_gaussians(self, name: str) -> Array:
        """Return the (N, 4) uint8 rgba of an image."""
        most = 2 * self.count + SLACK_PIXELS
        pixels = self._image(name, lambda w, h: self.count <= w * h <= most)
        rgba = pixels.reshape(-1, 4)
        more = rgba[self.count :]
        self.beyond = max(self.beyond, int((more[:, :3].any(1) & (more[:, 3] > 0)).sum()))
        return rgba[: self.count]

    def palette(self, name: str, coefficients: int, entries: int) -> Array:
        """Return the (entries, coefficients, 3) uint8 codes of an image."""
        rows, width = -(-entries // PALETTE_ROW), PALETTE_ROW * coefficients
        pixels = self._image(name, lambda w, h: w == width and rows <= h <= PALETTE_ROWS)
        return pixels[:rows].reshape(rows * PALETTE_ROW, coefficients, 4)[:entries, :, :3]

    def _image(self, name: str, suits: Callable[[int, int], bool]) -> Array:
        """Return (H, W, 4) uint8; suits: whether (width, height) is allowed, checked before decoding."""
        if not hostile.is_plain_name(name):
            raise malformed(self.path, f"{quoted(name)} is no plain file name")
        self.read.add(name)
        what = f"{self.path}: image {quoted(name)}"
        data = self._fetch(name, IMAGE_LIMIT)
        with hostile.opened(data, what, ("WEBP", "PNG")) as image:
            if not suits(*image.size):
                size = f"{image.width}x{image.height}"
                raise malformed(what, f"{size} pixels do not suit {self.count} Gaussians")
            # Lossless images of full opacity are stored without alpha; `convert` restores 255.
            return np.asarray(image.convert("RGBA"))


# Writing: one `.sog` file, rows in their order.

CODES = 256  # entries of a codebook
ROUNDS = 30  # of Lloyd's algorithm
HALVINGS = 16  # of median cut, for a palette of 65536 entries at most


def write_sog(path: Path | str, scene: Scene) -> None:
    """Write a bundled .sog, atomically; rows keep their order.

    Positions are rounded to 1/65535 of the scene's extent in sign(x) log(1 + |x|), quaternions and opacities
    to 1/255; scales, colours and higher coefficients to the nearest of 256 values each, fitted to the scene.
    A row that cannot be drawn gets opacity 0. InputError if steps of positions exceed most Gaussians.
    """
    gaussians = scene.gaussians
    valid, count = gaussians.valid(), len(gaussians)
    images: dict[str, Array] = {}

    def plane(name: str, *codes: Array) -> str:
        side = max(int(np.ceil(np.sqrt(count))), 1)
        pixels = np.zeros((-(-max(count, 1) // side) * side, 4), np.uint8)
        pixels[:, 3] = 255
        whole = np.column_stack(codes)
        pixels[:count, : whole.shape[1]] = whole
        images[name] = pixels.reshape(-1, side, 4)
        return name

    def known(values: Array, other: Any = 0) -> Array:
        there = valid.reshape(-1, *[1] * (values.ndim - 1))
        return np.where(there, values, other).astype(np.float64)

    means = known(gaussians.means)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (reduced(logs[valid], axis=0) if valid.any() else np.zeros(3) for reduced in (np.min, np.max))
    spacing = (np.abs(means[valid]).max(1, initial=0) + 1) * (high - low).max() / 65535
    check_steps(Path(path), gaussians.take(valid), spacing)
    whole = np.rint(((logs - low) / np.where(high > low, high - low, 1)).clip(0, 1) * 65535).astype(np.uint32)
    three, largest = without_largest(known(gaussians.quats_wxyz, [1, 0, 0, 0]))
    scales, scale_book = _coded(known(gaussians.log_scales).clip(-30), valid)  # a flat axis is e^-30 thick
    colours = known(gaussians.sh)
    base, base_book = _coded(colours[:, 0], valid)
    opacities = to_bytes(255 * sigmoid(known(gaussians.opacity_logits, -np.inf)))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "langsplat-viewer"},
        "count": count,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [plane("means_l.webp", whole & 255), plane("means_u.webp", whole >> 8)],
        },
        "scales": {"codebook": scale_book.tolist(), "files": [plane("scales.webp", scales)]},
        "quats": {"files": [plane("quats.webp", to_bytes((three / np.sqrt(2) + 0.5) * 255), 252 + largest)]},
        "sh0": {"codebook": base_book.tolist(), "files": [plane("sh0.webp", base, opacities)]},
    }
    if scene.antialiased:
        meta["antialias"] = True
    if gaussians.sh_degree and valid.any():
        entry, palette = _palette(colours[:, 1:].reshape(count, -1), valid)
        codes, book = _coded(palette, np.ones(len(palette), bool))
        coefficients = colours.shape[1] - 1
        rows = -(-len(palette) // PALETTE_ROW)
        table = np.full((rows * PALETTE_ROW, coefficients, 4), 255, np.uint8)
        table[: len(palette), :, :3] = codes.reshape(len(palette), coefficients, 3)
        images["shN_centroids.webp"] = table.reshape(rows, PALETTE_ROW * coefficients, 4)
        meta["shN"] = {
            "count": len(palette),
            "bands": gaussians.sh_degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", plane("shN_labels.webp", entry & 255, entry >> 8)],
        }
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, pixels in images.items():
            encoded = io.BytesIO()
            Image.fromarray(pixels).save(encoded, "WEBP", lossless=True, exact=True, quality=100, method=2)
            archive.writestr(zipfile.ZipInfo(name), encoded.getvalue())
        archive.writestr(zipfile.ZipInfo(META_NAME), json.dumps(meta))


def _coded(values: Array, counts: Array) -> tuple[Array, Array]:
    """Return (N, C) uint8 codes and their (256,) rising values: Lloyd's algorithm over rows of `counts`."""
    known = np.sort(values[counts].ravel())
    if len(known) == 0:
        return np.zeros(values.shape, np.uint8), np.zeros(CODES)
    sums = np.concatenate([[0.0], np.cumsum(known)])
    # Initial values: half at quantiles, half evenly over the range, for the tails.
    even = np.linspace(known[0], known[-1], CODES // 2)
    book = np.sort(np.concatenate([np.quantile(known, np.linspace(0, 1, CODES - len(even))), even]))
    for _ in range(ROUNDS):
        edges = np.concatenate([[0], np.searchsorted(known, (book[1:] + book[:-1]) / 2), [len(known)]])
        sizes = np.diff(edges)
        book = np.sort(np.where(sizes > 0, np.diff(sums[edges]) / np.maximum(sizes, 1), book))
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8), book


def _palette(values: Array, counts: Array) -> tuple[Array, Array]:
    """Return the (N,) palette entry of each row, and the (P, D) entries.

    Up to 65536 rows of `counts` have an entry each; else groups by median cut of the widest axis do.
    """
    rows = values[counts]
    squares, own = rows**2, np.zeros(len(rows), np.int64)

    def means(of: Array) -> Array:
        groups = scipy.sparse.csr_array((np.ones(len(own)), own, np.arange(len(own) + 1))).T
        return np.asarray(groups @ of) / np.bincount(own)[:, None]

    if len(rows) <= 1 << HALVINGS:
        own = np.arange(len(rows))
    else:
        for _ in range(HALVINGS):
            centres = means(rows)
            axis = (means(squares) - centres**2).argmax(1)[own]
            above = rows[np.arange(len(rows)), axis] > centres[own, axis]
            own = np.unique(2 * own + above, return_inverse=True)[1]
    entry = np.zeros(len(values), np.int64)
    entry[counts] = own
    return entry, means(rows)

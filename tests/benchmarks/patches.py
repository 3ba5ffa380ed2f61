"""LERF's method, without masks: CLIP vectors of square patches at several scales, and a search of
the scale that fits the phrase best (Kerr et al. 2023, sections 3.1 and 3.3).

LERF trains a field of vectors over position and scale; here the same vectors are averaged onto Gaussians that
are already there, `W^T y / W^T 1` at every scale, so that it is compared with masks and not with another
renderer. Scales are shares of the picture's height, as there.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.config import PictureConfig
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingRasterizer, View
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.semantics.relevancy import relevancy
from langsplat_core.semantics.store import ImageEncoder, masked_crop
from tests.benchmarks.scoring import Answer, masks_of_maps

SCALES = tuple(float(scale) for scale in np.linspace(0.05, 0.5, 7))  # LERF's; it interpolates between them
OVERLAP = 0.5  # of neighbouring patches
CHANNELS = 32  # of a picture of vectors that are splatted or gathered at a time


@dataclass(frozen=True, eq=False)
class PatchField:
    """CLIP vectors of Gaussians at every scale."""

    vectors: Array  # (S, N, D) float32 unit; zero where never seen
    canonical: Array  # (C, D) float32 unit
    temperature: float


def patch_vectors(image: Array, encoder: ImageEncoder, scale: float) -> Array:
    """(H, W, D) float32 vectors of an image (H, W, 3) uint8: of square patches `scale` high, interpolated
    between their centres."""
    height, width = image.shape[:2]
    side = min(max(round(scale * height), 2), height, width)
    rows, columns = _starts(height, side), _starts(width, side)
    whole, size = np.ones((side, side), bool), encoder.image_size
    crops = [masked_crop(image[y : y + side, x : x + side], whole, size) for y in rows for x in columns]
    vectors = encoder.encode_images(np.stack(crops)).reshape(len(rows), len(columns), -1)
    down = _between(vectors, rows + (side - 1) / 2, height)
    return np.asarray(_between(down.swapaxes(0, 1), columns + (side - 1) / 2, width).swapaxes(0, 1))


def _between(values: Array, centres: Array, length: int) -> Array:
    """(K, ...) values at K rising `centres` -> (length, ...) at every whole pixel, linear in between and
    constant beyond the ends."""
    at = np.interp(np.arange(length), centres, np.arange(len(centres)))
    low = np.minimum(at.astype(int), len(centres) - 1)
    high = np.minimum(low + 1, len(centres) - 1)
    share = (at - low).astype(np.float32).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[low] + share * (values[high] - values[low]))


def _starts(length: int, side: int) -> Array:
    """Where patches of `side` pixels begin, so that they cover `length` and overlap by `OVERLAP`."""
    count = int(np.ceil((length - side) / (side * (1 - OVERLAP)))) + 1
    return np.linspace(0, length - side, count).round().astype(int)


def lift_patches(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, Array]],
    encoder: ImageEncoder,
    progress: Progress = silent,
) -> Array:
    """(S, N, D) unit vectors of Gaussians from views (camera, image (H, W, 3) uint8)."""
    total: Array | None = None
    for done, (camera, image) in enumerate(views):
        view = rasterizer.view(gaussians, camera)
        for row, scale in enumerate(SCALES):
            vectors = patch_vectors(image, encoder, scale)
            if total is None:
                total = np.zeros((len(SCALES), len(gaussians), vectors.shape[2]), np.float32)
            for part in _parts(vectors.shape[2]):
                total[row, :, part] += view.gather(np.ascontiguousarray(vectors[..., part]))
        progress("patches of the photographs", (done + 1) / len(views))
    if total is None:
        raise ValueError("views: expected at least one")
    return np.stack([unit(sums).astype(np.float32) for sums in total])


def _parts(count: int) -> Iterator[slice]:
    return (slice(start, min(start + CHANNELS, count)) for start in range(0, count, CHANNELS))


def pictures(field: PatchField, view: View, phrases: Array) -> Array:
    """(Q, D) unit phrase vectors -> (Q, H, W) relevancy in a view, each at its best scale: the one with the
    highest relevancy in the picture."""
    best: Array | None = None
    gate = PictureConfig().alpha_gate
    for vectors in field.vectors:
        blended = [view.splat(np.ascontiguousarray(vectors[:, part])) for part in _parts(vectors.shape[1])]
        shown, alpha = np.concatenate([values for values, _ in blended], 2), blended[0][1]
        flat = unit(shown.reshape(-1, shown.shape[2]))
        values = relevancy(flat, phrases, field.canonical, field.temperature).astype(np.float32)
        maps = np.where(alpha > gate, np.moveaxis(values.reshape(*alpha.shape, -1), 2, 0), 0)
        best = maps if best is None else np.where(_peaks(maps) > _peaks(best), maps, best)
    assert best is not None  # there are scales
    return best


def _peaks(maps: Array) -> Array:
    return np.asarray(maps.max(axis=(1, 2), keepdims=True))


def among_gaussians(field: PatchField, phrases: Array) -> Array:
    """(Q, D) unit phrase vectors -> (Q, N) float32 relevancy, each phrase at its best scale."""
    best = np.zeros((len(phrases), field.vectors.shape[1]), np.float32)
    for vectors in field.vectors:
        values = relevancy(vectors, phrases, field.canonical, field.temperature).T
        values[:, ~vectors.any(axis=1)] = 0
        better = values.max(axis=1) > best.max(axis=1)
        best[better] = values[better]
    return best


def reread(answers: Mapping[str, Answer], field: PatchField) -> dict[str, Answer]:
    """The answers to the same phrases by patches."""
    if not answers:
        return {}
    values = among_gaussians(field, np.stack([answer.vector for answer in answers.values()]))
    return {name: _with_values(answers[name], row) for name, row in zip(answers, values, strict=True)}


def _with_values(answer: Answer, values: Array) -> Answer:
    seen = values[values > 0]
    return replace(
        answer,
        values=values,
        even=values,
        peak=float(values.max()),
        median=float(np.median(seen)) if len(seen) else 0.0,
    )


def judged(
    field: PatchField, view: View, answers: Sequence[Answer]
) -> Iterator[tuple[Array, tuple[int, int]]]:
    """The mask (H, W) of each answer in a view, cut half way between the floor and its peak, and the row and
    column of the peak."""
    if answers:
        maps = pictures(field, view, np.stack([answer.vector for answer in answers]))
        yield from masks_of_maps(maps)

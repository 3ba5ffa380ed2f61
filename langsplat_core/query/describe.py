"""Reverse queries: the most probable words for Gaussians, and for the surface under a pixel."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig, RasterSettings
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.word_scores import Word, WordScores, build_attributes, build_words
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.raster.render import pixel_weights
from langsplat_core.scene import LEVELS, Camera
from langsplat_core.scene.surface import surface_areas
from langsplat_core.semantics.vocabulary import Bundled, bundled_vocabulary

CERTAIN = 0.5  # probability from which a colour or material is said
ATTRIBUTES: tuple[Bundled, ...] = ("colours", "materials")


@dataclass(frozen=True)
class LevelWords:
    """The most probable words for a place at one level."""

    level: int  # index into LEVELS
    words: tuple[Word, ...]  # the most probable first; none where nothing is known
    other: float  # probability that no word of the vocabulary fits
    known: float  # share of the place that has a feature at this level, in [0, 1]
    colour: Word | None = None  # where one is `CERTAIN` enough
    material: Word | None = None


Levels = tuple[LevelWords, ...]  # of subpart, part and whole


class Describer:
    """Reverse queries against one scene, for one thread at a time.

    The vocabulary is encoded once, here; a question costs milliseconds.
    """

    def __init__(
        self, engine: QueryEngine, vocabulary: Sequence[str] | None = None, progress: Progress = silent
    ) -> None:
        """Encode a vocabulary.

        vocabulary: phrases for all levels, by default the bundled ones: everyday things, and below the level
        "whole" parts of things too. Those with words that the encoder was never taught are left out. Raises
        InputError for a scene without a language field and where no phrase is left, EncoderError as
        `QueryEngine.known_vectors` does.
        """
        things = tuple(vocabulary) if vocabulary is not None else bundled_vocabulary("things")
        parts = () if vocabulary is not None else bundled_vocabulary("parts")
        phrases = (*things, *parts)
        field = engine.field
        self.engine, self.known = engine, engine.field.known
        known, vectors = engine.known_vectors(phrases, progress)
        self.left_out: tuple[str, ...] = tuple(sorted(set(phrases) - set(known)))
        if not known:
            raise InputError(
                f"the encoder knows none of the vocabulary's {len(phrases)} phrases; name others, or use "
                "a scene made with OpenCLIP weights"
            )
        whole = np.isin(known, things)
        every = build_words(field, known, vectors)
        self.words: tuple[WordScores, WordScores, WordScores] = (every, every, every.take(whole))
        taught = [engine.known_vectors(bundled_vocabulary(name), progress) for name in ATTRIBUTES]
        self._attributes = [build_attributes(field, *pair) if pair[0] else None for pair in taught]

    @cached_property
    def areas(self) -> Array:
        """(N,) float64 surface of every Gaussian, see `surface_areas`."""
        return surface_areas(self.engine.scene.gaussians)

    def at_gaussians(self, rows: Array, weights: Array | None = None, top: int = 5) -> Levels:
        """Return words for the Gaussians at `rows` (M indices, or a boolean mask of length N) taken together.

        weights: (M,) >= 0, how much each counts; by default its surface.
        """
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        counted = self.areas[rows] if weights is None else np.asarray(weights, np.float64)
        if weights is None and not counted.any():  # without any surface they still have features
            counted = np.ones(len(rows))
        return tuple(self.at_level(level, rows, counted, top) for level in range(len(LEVELS)))

    def appearance(self, latents: Array, weights: Array) -> tuple[Word | None, Word | None]:
        """Return colour and material of (M, d) latents, weighted by (M,), where one is certain."""
        colour, material = (self._certain(words, latents, weights) for words in self._attributes)
        return colour, material

    def _certain(self, words: WordScores | None, latents: Array, weights: Array) -> Word | None:
        if words is None:
            return None
        shares = words.mixture(self.engine.field.codec, latents, weights)
        best = int(shares.argmax())
        return Word(words.phrases[best], float(shares[best])) if shares[best] >= CERTAIN else None

    def at_level(self, level: int, rows: Array, weights: Array, top: int) -> LevelWords:
        """Return words for the Gaussians at `rows` (M,) at one level, weighted by (M,)."""
        field = self.engine.field
        known = self.known[level, rows] & (weights > 0)
        total, seen = float(weights.sum()), float(weights[known].sum())
        if not known.any():
            return LevelWords(level, (), 0.0, 0.0)
        latents, weights = field.latents[level, rows[known]], weights[known]
        names = self.words[level]
        shares = names.mixture(field.codec, latents, weights)
        best = np.argsort(-shares[: len(names.phrases)], kind="stable")[: max(top, 0)]
        words = tuple(Word(names.phrases[i], float(shares[i])) for i in best)
        other = float(shares[len(names.phrases) :].sum())
        return LevelWords(level, words, other, seen / total, *self.appearance(latents, weights))


# The surface under one pixel: where it is, what it is called, and how relevant it is to what was asked.


@dataclass(frozen=True, eq=False)
class Pointed:
    """The surface that one pixel shows, in words."""

    position: Array  # (3,) world units
    depth: float  # camera z, world units
    words: Levels  # at each level the most probable
    relevancy: tuple[float, ...]  # in [0, 1], of each answer at its level


def look_at_pixel(
    rasterizer: LiftingRasterizer,
    describer: Describer,
    camera: Camera,
    pixel: tuple[int, int],
    results: Sequence[QueryResult] = (),
    top: int = 3,
    settings: RasterSettings | None = None,
) -> Pointed | None:
    """Return the surface that `camera` sees at a pixel (column, row); None where that is mostly empty.

    Every Gaussian counts by its blending weight there; the surface is at the median of their depths, as the
    rasterizers have it. `settings` of image formation: by default the scene's own.
    """
    scene = describer.engine.scene
    rows, weights = pixel_weights(scene, camera, pixel, rasterizer, settings)
    total = float(weights.sum())
    if total <= PictureConfig().alpha_gate:
        return None
    means = scene.gaussians.means[rows].astype(np.float64)
    depths = means @ camera.rotation[2] + camera.world_to_camera[2, 3]
    order = np.argsort(depths, kind="stable")
    median = order[np.searchsorted(np.cumsum(weights[order], dtype=np.float64), 0.5 * total)]
    depth = float(depths[median])
    centre = (pixel[0] + 0.5, pixel[1] + 0.5)
    relevancy = (float(weights @ result.relevancy[result.level][rows]) / total for result in results)
    return Pointed(
        position=camera.unproject(centre, depth),
        depth=depth,
        words=describer.at_gaussians(rows, weights, top),
        relevancy=tuple(relevancy),
    )

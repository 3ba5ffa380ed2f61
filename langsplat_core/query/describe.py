"""What is here? Words for Gaussians, for a pixel, and for a whole scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.inventory import Entry, take_inventory
from langsplat_core.query.surface import surface_areas
from langsplat_core.query.words import Word, WordScores, build_attributes, build_words, certain
from langsplat_core.raster.one_pixel import pixel_weights
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import LEVELS, Camera
from langsplat_core.semantics.vocabulary import Bundled, bundled_vocabulary


@dataclass(frozen=True)
class Words:
    """What a place is, at one level."""

    level: int  # index into LEVELS
    words: tuple[Word, ...]  # the most probable first; none where nothing is known
    other: float  # probability that no word of the vocabulary fits
    known: float  # share of the place that has a meaning at this level, in [0, 1]
    colour: Word | None = None  # where one is certain enough, see `words.certain`
    material: Word | None = None


Levels = tuple[Words, Words, Words]  # of subpart, part and whole


class Describer:
    """Reverse queries against one scene. The vocabulary is encoded once, here; a question costs milliseconds.
    Not for use by two threads at once."""

    def __init__(
        self, engine: QueryEngine, vocabulary: Sequence[str] | None = None, progress: Progress = silent
    ) -> None:
        """vocabulary: phrases for all levels, by default the bundled ones: everyday things, and below the
        level "whole" parts of things too. Those with words that the encoder was never taught are left out.

        Raises InputError for a scene without a language field and where no phrase is left, EncoderError as
        `QueryEngine.known_vectors` does.
        """
        things = tuple(vocabulary) if vocabulary is not None else bundled_vocabulary("things")
        parts = () if vocabulary is not None else bundled_vocabulary("parts")
        phrases = (*things, *parts)
        field = engine.field
        self.engine = engine
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
        self._colours = self._attributes("colours", progress)
        self._materials = self._attributes("materials", progress)

    def _attributes(self, name: Bundled, progress: Progress) -> WordScores | None:
        known, vectors = self.engine.known_vectors(bundled_vocabulary(name), progress)
        return build_attributes(self.engine.field, known, vectors) if known else None

    @cached_property
    def areas(self) -> Array:
        """(N,) float64 surface of every Gaussian, see `surface_areas`."""
        return surface_areas(self.engine.scene.gaussians)

    @cached_property
    def _known(self) -> Array:
        return self.engine.field.known

    def at_gaussians(self, rows: Array, weights: Array | None = None, top: int = 5) -> Levels:
        """Words for the Gaussians at `rows` (indices, or a boolean mask of length N) taken together.

        weights: (M,) >= 0, how much each counts; by default its surface.
        Raises InputError for a number that no Gaussian has.
        """
        count = len(self.engine.field)
        numbers = np.flatnonzero(rows) if np.asarray(rows).dtype == bool else np.asarray(rows, np.int64)
        outside = numbers[(numbers < 0) | (numbers >= count)]
        if len(outside):
            worst = outside[0]
            raise InputError(f"Gaussian {worst}: the scene has Gaussians 0 to {count - 1}")
        counted = self.areas[numbers] if weights is None else np.asarray(weights, np.float64)
        if weights is None and not counted.any():  # without any surface they still mean something
            counted = np.ones(len(numbers))
        subpart, part, whole = (self._at_level(level, numbers, counted, top) for level in range(len(LEVELS)))
        return subpart, part, whole

    def at_pixel(
        self, rasterizer: LiftingRasterizer, camera: Camera, pixel: tuple[int, int], top: int = 5
    ) -> Levels:
        """Words for what `camera` sees at `pixel` (column, row): every Gaussian's words count by its blending
        weight there. A pixel that is mostly empty has no words.

        Raises InputError for a pixel outside the picture.
        """
        column, row = pixel
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            raise InputError(
                f"pixel {column} {row}: the picture has columns 0 to {camera.width - 1} and rows 0 to "
                f"{camera.height - 1}"
            )
        scene = self.engine.scene
        rows, weights = pixel_weights(rasterizer, scene.gaussians, camera, pixel, scene.raster_settings())
        if weights.sum() <= PictureConfig().alpha_gate:
            rows, weights = rows[:0], weights[:0]
        return self.at_gaussians(rows, weights, top)

    def inventory(self, progress: Progress = silent) -> list[Entry]:
        """What is in the scene, see `query.inventory`."""
        return take_inventory(self.engine, self.words, (self._colours, self._materials), self.areas, progress)

    def _at_level(self, level: int, rows: Array, weights: Array, top: int) -> Words:
        field = self.engine.field
        known = self._known[level, rows] & (weights > 0)
        total, seen = float(weights.sum()), float(weights[known].sum())
        if not known.any():
            return Words(level, (), 0.0, 0.0)
        latents, weights = field.latents[level, rows[known]], weights[known]
        names = self.words[level]
        shares = names.mixture(field.codec, latents, weights)
        best = np.argsort(-shares[: len(names.phrases)], kind="stable")[: max(top, 0)]
        colour, material = (
            None if words is None else certain(words, field.codec, latents, weights)
            for words in (self._colours, self._materials)
        )
        return Words(
            level=level,
            words=tuple(Word(names.phrases[i], float(shares[i])) for i in best),
            other=float(shares[len(names.phrases) :].sum()),
            known=seen / total,
            colour=colour,
            material=material,
        )

"""Answering phrases on a scene: encode, look up, choose a level, find the place."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.cut import cut_level
from langsplat_core.query.lookup import Lookup, build_lookup
from langsplat_core.query.places import Place, locate
from langsplat_core.query.surface import Surface, build_surface
from langsplat_core.scene import CANONICAL_PHRASES, LEVELS, LanguageField, Scene
from langsplat_core.scene.phrases import phrase_key, tidy
from langsplat_core.semantics.relevancy import FLOOR, MIN_HEAT_SPAN

SAME_ENCODER = 0.99  # least cosine of canonical vectors of one encoder, whatever rounds them
NO_FIELD = "this scene has no language field: it can be looked at, not searched; `langsplat train` makes one"


class TextEncoder(Protocol):
    """The text half of a CLIP model."""

    def encode_texts(self, texts: list[str]) -> Array:
        """(M, D) float32 unit vectors."""

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Words of `text` that the encoder was never taught; empty if it cannot tell."""


LoadEncoder = Callable[[str], TextEncoder]  # from a hub id, a folder or "demo"; may raise EncoderError


@dataclass(frozen=True, eq=False)
class QueryResult:
    """The answer to one phrase."""

    phrase: str
    level: int  # index into LEVELS
    scores: tuple[float, float, float]  # smoothed peak relevancy per level
    relevancy: Array  # (3, N) float32 in [0, 1] per level and Gaussian
    peak: float  # score of the chosen level
    place: Array | None  # (3,) world units
    box: Array | None  # (2, 3) corners, world units
    found: bool  # peak >= the scene's `Reading.found`
    members: Array  # (N,) bool: the Gaussians that answer, wherever they are; all of them above the cut

    @property
    def heat_range(self) -> tuple[float, float]:
        """The relevancies at which a heat map of this answer is coldest and hottest."""
        return FLOOR, max(self.peak, FLOOR + MIN_HEAT_SPAN)


class QueryEngine:
    """Queries against one scene. What depends on the scene alone is computed at the first query, and the text
    encoder is loaded when a phrase first needs it. Not for use by two threads at once."""

    def __init__(
        self,
        scene: Scene,
        load_encoder: LoadEncoder | None = None,
        *,
        encoder_id: str = "",
        exact: bool = False,
    ) -> None:
        """load_encoder: usually `semantics.encoders.load_text_encoder`; without one only the scene's own
        phrasebook can be asked. encoder_id: in place of the encoder that the scene names. exact: decode at
        every Gaussian instead of looking up, 2 KB each, to measure the table by."""
        self.scene = scene
        self.exact = exact
        self._load_encoder = load_encoder
        self._encoder_id = encoder_id
        self._encoder: TextEncoder | None = None
        self._encoder_checked = False

    @property
    def field(self) -> LanguageField:
        """The scene's language field; InputError where it has none."""
        if self.scene.language is None:
            raise InputError(NO_FIELD)
        return self.scene.language

    @property
    def encoder(self) -> TextEncoder:
        """The text encoder, see `load_encoder`."""
        return self.load_encoder()

    def load_encoder(self, progress: Progress = silent) -> TextEncoder:
        """The text encoder, loaded at the first call, which imports torch: seconds.

        Raises EncoderError where it cannot be loaded, or where the engine was given no way to.
        """
        if self._encoder is None:
            if self._load_encoder is None:
                raise EncoderError(
                    "without a text encoder only the phrases in the scene's phrasebook can be asked; "
                    f"the scene was made with {self.field.encoder_id}"
                )
            progress("loading the text encoder", 0.1)
            self._encoder = self._load_encoder(self._encoder_id or self.field.encoder_id)
        return self._encoder

    @cached_property
    def surface(self) -> Surface:
        """The surface that the scene's Gaussians lie on."""
        return build_surface(self.scene.gaussians)

    @cached_property
    def _lookup(self) -> Lookup:
        return build_lookup(self.field, self.exact)

    def unknown_words(self, phrase: str) -> tuple[str, ...]:
        """Words for which `phrase` cannot be asked; none where the phrasebook has it. EncoderError as
        `load_encoder` raises it."""
        if phrase_key(phrase) in self.field.phrasebook:
            return ()
        return self.encoder.unknown_words(phrase_key(phrase))

    def text_vector(self, phrase: str, progress: Progress = silent) -> Array:
        """(D,) unit vector of a phrase: from the scene's phrasebook, else from the encoder.

        Raises InputError for an empty phrase, and EncoderError for unknown words, an encoder that is not the
        scene's, or one that cannot be loaded.
        """
        key = phrase_key(phrase)
        if not key:
            raise InputError("the query is empty; type a word such as 'cup'")
        if key in self.field.phrasebook:
            return self.field.phrasebook[key]
        encoder = self.load_encoder(progress)
        unknown = encoder.unknown_words(key)
        if unknown:
            raise EncoderError(
                f"the encoder does not know {', '.join(repr(word) for word in unknown)}; "
                "use other words, or a scene made with OpenCLIP weights"
            )
        vector = np.asarray(encoder.encode_texts([key])[0], np.float32)
        if vector.shape != (self.field.codec.vector_dim,):
            raise EncoderError(
                f"the encoder gives {vector.shape[0]} numbers, the scene was made with "
                f"{self.field.codec.vector_dim} by {self.field.encoder_id}; give that one with --encoder"
            )
        self._check_encoder(encoder)
        return vector

    def _check_encoder(self, encoder: TextEncoder) -> None:
        """EncoderError unless `encoder` turns the canonical phrases into the vectors that the scene has for
        them. Other weights would answer with noise, whatever their name."""
        if self._encoder_checked:
            return
        canonical = np.asarray(encoder.encode_texts(list(CANONICAL_PHRASES)), np.float64)
        if ((canonical * self.field.canonical).sum(1) < SAME_ENCODER).any():
            raise EncoderError(
                f"the scene was made with other weights of {self.field.encoder_id}; give those with "
                "--encoder, or make the scene again"
            )
        self._encoder_checked = True

    def relevancy(self, vector: Array) -> Array:
        """(D,) unit text vector -> (3, N) float32 relevancy per level and Gaussian."""
        return self._lookup.relevancy(vector).reshape(self.field.confidence.shape)

    def run(self, phrase: str, level: LevelChoice = "auto", progress: Progress = silent) -> QueryResult:
        """Answer `phrase`. The level is chosen once for the scene, on raw relevancy, so that the picture
        does not flicker between levels as the camera moves. Raises as `text_vector` does."""
        vector = self.text_vector(phrase, progress)
        progress(f"searching '{tidy(phrase)}'", 0.5)
        relevancy = self.relevancy(vector)
        smoothed = self.surface.smooth(relevancy)
        scores = tuple(float(values.max()) if len(values) else 0.0 for values in smoothed)
        chosen = int(np.argmax(scores)) if level == "auto" else LEVELS.index(level)
        peak = scores[chosen]
        place = self._place(smoothed[chosen], peak)
        members = relevancy[chosen] > cut_level("floor", relevancy[chosen], peak, FLOOR)
        return QueryResult(
            phrase=tidy(phrase),
            level=chosen,
            scores=(scores[0], scores[1], scores[2]),
            relevancy=relevancy,
            peak=peak,
            place=None if place is None else place.position,
            box=None if place is None else place.box,
            found=peak >= self.field.reading.found,
            members=members,
        )

    def _place(self, smoothed: Array, peak: float) -> Place | None:
        # Half way between the floor and the peak, but never below the floor.
        return locate(self.surface, smoothed, max(FLOOR + 0.5 * (peak - FLOOR), FLOOR))

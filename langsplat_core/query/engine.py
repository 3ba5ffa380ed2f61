"""Answering phrases on a scene: encode, look up, choose a level, find the place."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.query.places import Neighbourhood, Place, build_neighbourhood, locate
from langsplat_core.query.relevancy import CHUNK, latent_relevancy, relevancy
from langsplat_core.query.table import SphereTable, build_table
from langsplat_core.scene import CANONICAL_PHRASES, LEVELS, AutoencoderCodec, LanguageField, Scene

FOUND = 0.6  # smoothed peak relevancy from which a phrase counts as present; 0.5 is the floor
SAME_ENCODER = 0.99  # least cosine of canonical vectors of one encoder, whatever rounds them
NO_FIELD = "this scene has no language field: it can be looked at, not searched; `langsplat train` makes one"


class TextEncoder(Protocol):
    """The text half of a CLIP model."""

    def encode_texts(self, texts: list[str]) -> Array:
        """(M, D) float32 unit vectors."""

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Words of `text` that the encoder was never taught; empty if it cannot tell."""


@dataclass(frozen=True, eq=False)
class QueryResult:
    """The answer to one phrase."""

    phrase: str
    level: int  # index into LEVELS
    scores: tuple[float, float, float]  # smoothed peak relevancy per level
    relevancy: Array  # (3, N) float32 in [0, 1] per level and Gaussian
    peak: float  # score of the chosen level, at which the heat map saturates
    place: Array | None  # (3,) world units
    box: Array | None  # (2, 3) corners, world units
    found: bool  # peak >= FOUND


class QueryEngine:
    """Queries against one scene. What depends on the scene alone is computed at the first query."""

    def __init__(self, scene: Scene, encoder: TextEncoder | None = None, exact: bool = False) -> None:
        """`exact` decodes at every Gaussian instead of looking up: 2 KB each, to measure the table by."""
        self.scene = scene
        self.encoder = encoder
        self.exact = exact
        self._checked: TextEncoder | None = None  # the encoder that was found to be the scene's

    @property
    def field(self) -> LanguageField:
        """The scene's language field; InputError where it has none."""
        if self.scene.language is None:
            raise InputError(NO_FIELD)
        return self.scene.language

    @cached_property
    def _neighbourhood(self) -> Neighbourhood:
        return build_neighbourhood(self.scene.gaussians)

    @cached_property
    def _table(self) -> SphereTable | None:
        field = self.field
        if not isinstance(field.codec, AutoencoderCodec) or field.codec.latent_dim != 3:
            return None
        return build_table(field.codec, self._known_latents(), field.canonical)

    @cached_property
    def _decoded(self) -> tuple[Array, Array]:
        """Rows of `_known_latents` with a meaning, and their (M, D) decoded vectors."""
        latents = self._known_latents()
        rows = np.flatnonzero(np.linalg.norm(latents, axis=1) > 1e-6)
        vectors = np.empty((len(rows), self.field.codec.vector_dim), np.float32)
        for start in range(0, len(rows), CHUNK):
            part = slice(start, start + CHUNK)
            vectors[part] = self.field.codec.decode(latents[rows[part]])
        return rows, vectors

    def _known_latents(self) -> Array:
        """(3 N, d) latents, zero where a Gaussian was never observed."""
        field = self.field
        latents = np.where(field.confidence[..., None] > 0, field.latents, 0)
        return latents.reshape(-1, field.latents.shape[-1])

    def text_vector(self, phrase: str) -> Array:
        """(D,) unit vector of a phrase: from the scene's phrasebook, else from the encoder.

        Raises InputError for an empty phrase and EncoderError for unknown words or a missing encoder.
        """
        phrase = " ".join(phrase.split())
        if not phrase:
            raise InputError("the query is empty; type a word such as 'cup'")
        if phrase.lower() in self.field.phrasebook:
            return self.field.phrasebook[phrase.lower()]
        if self.encoder is None:
            raise EncoderError(
                f"'{phrase}' is not in the scene's phrasebook and no text encoder is loaded; "
                f"give one with --encoder (the scene was made with {self.field.encoder_id})"
            )
        unknown = self.encoder.unknown_words(phrase)
        if unknown:
            raise EncoderError(
                f"the encoder does not know {', '.join(repr(word) for word in unknown)}; "
                "use other words, or a scene made with OpenCLIP weights"
            )
        vector = np.asarray(self.encoder.encode_texts([phrase])[0], np.float32)
        if vector.shape != (self.field.codec.vector_dim,):
            raise EncoderError(
                f"the encoder gives {vector.shape[0]} numbers, the scene was made with "
                f"{self.field.codec.vector_dim} by {self.field.encoder_id}; give that one with --encoder"
            )
        self._refuse_a_stranger(self.encoder)
        return vector

    def _refuse_a_stranger(self, encoder: TextEncoder) -> None:
        """An encoder that turns the canonical phrases into other vectors than the scene's is not the one that
        it was made with, whatever its name: answers would be noise."""
        if encoder is self._checked:
            return
        canonical = np.asarray(encoder.encode_texts(list(CANONICAL_PHRASES)), np.float64)
        if ((canonical * self.field.canonical).sum(1) < SAME_ENCODER).any():
            raise EncoderError(
                f"the scene was made with other weights of {self.field.encoder_id}; give those with "
                "--encoder, or make the scene again"
            )
        self._checked = encoder

    def relevancy(self, vector: Array) -> Array:
        """(D,) unit text vector -> (3, N) float32 relevancy per level and Gaussian."""
        field = self.field
        if self.exact:
            rows, vectors = self._decoded
            values = np.zeros(field.confidence.size, np.float32)
            values[rows] = relevancy(vectors, vector[None], field.canonical)[:, 0]
        elif self._table is not None:
            values = self._table.relevancy(vector)
        else:
            values = latent_relevancy(field.codec, self._known_latents(), vector[None], field.canonical)[:, 0]
        return values.reshape(field.confidence.shape)

    def run(self, phrase: str, level: LevelChoice = "auto") -> QueryResult:
        """Answer `phrase`. The level is chosen once for the scene, on raw relevancy, so that the picture
        does not flicker between levels as the camera moves."""
        relevancy = self.relevancy(self.text_vector(phrase))
        smoothed = [self._neighbourhood.smooth(values) for values in relevancy]
        scores = tuple(float(values.max()) if len(values) else 0.0 for values in smoothed)
        chosen = int(np.argmax(scores)) if level == "auto" else LEVELS.index(level)
        peak = scores[chosen]
        place = self._place(smoothed[chosen], peak)
        return QueryResult(
            phrase=" ".join(phrase.split()),
            level=chosen,
            scores=(scores[0], scores[1], scores[2]),
            relevancy=relevancy,
            peak=peak,
            place=None if place is None else place.position,
            box=None if place is None else place.box,
            found=peak >= FOUND,
        )

    def _place(self, smoothed: Array, peak: float) -> Place | None:
        # Half way between the floor and the peak, but never below the floor.
        return locate(self._neighbourhood, smoothed, max(0.5 + 0.5 * (peak - 0.5), 0.5))

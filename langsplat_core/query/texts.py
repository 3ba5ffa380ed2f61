"""Text vectors of phrases, from a scene's phrasebook, else from its text encoder."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cached_property
from threading import RLock
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, UnknownWordError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.grammar import STOP_WORDS, check_names, only
from langsplat_core.scene import CANONICAL_PHRASES, LanguageField
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.encoders import same_vectors
from langsplat_core.semantics.relevancy import FEWEST, TextEncoder, everyday_vectors

BATCH = 512  # phrases that are encoded at a time

LoadEncoder = Callable[[str], TextEncoder]  # from a hub id, a folder or "demo"; may raise EncoderError


class TextVectors:
    """The (D,) unit vectors of phrases in the space of one language field; each is computed once.

    The encoder is loaded when a phrase first needs it; threads that ask at once take turns at it.
    """

    def __init__(
        self, field: LanguageField, load_encoder: LoadEncoder | TextEncoder | None, encoder_id: str = ""
    ) -> None:
        """`load_encoder`, `encoder_id`: see `QueryEngine`. Nothing is loaded yet."""
        given: Any = load_encoder
        self.field = field
        self._load_encoder: Any = (lambda _: given) if hasattr(given, "encode_texts") else given
        self._encoder_id = encoder_id or field.encoder_id
        self._encoder: TextEncoder | None = None
        self._turn = RLock()  # guards the encoder, whose tokenizer is not thread-safe
        self._vectors: dict[str, Array] = dict(field.phrasebook)  # by key, 2 KB each at D = 512

    def encoder(self, progress: Progress = silent) -> TextEncoder:
        """Return the text encoder, which the first call loads, in seconds.

        Raises EncoderError if that fails, or if its canonical vectors are not the scene's: others give noise.
        """
        with self._turn:
            if self._encoder is None:
                made_with, own = self.field.encoder_id, self.field.canonical
                if self._load_encoder is None:
                    raise EncoderError(
                        "without a text encoder only the phrases in the scene's phrasebook can be asked; "
                        f"the scene was made with {made_with}"
                    )
                progress("loading the text encoder", 0.1)
                loaded = self._load_encoder(self._encoder_id)
                canonical = np.asarray(loaded.encode_texts(list(CANONICAL_PHRASES)), np.float64)
                if not same_vectors(canonical, own):
                    raise EncoderError(
                        f"the scene was made with other weights of {made_with}, vectors of {own.shape[1]} "
                        "numbers; give those with --encoder, or make the scene again"
                    )
                self._encoder = loaded
            return self._encoder

    def unknown_words(self, phrase: str) -> tuple[str, ...]:
        """Return the words of `phrase` that the encoder was never taught. Raises as `encoder` does."""
        key = phrase_key(phrase)
        return () if key in self._vectors else self.encoder().unknown_words(key)

    def of(self, phrases: Sequence[str], progress: Progress = silent) -> Array:
        """Return (Q, D) vectors of phrases; those that are not yet known are encoded together.

        InputError for an empty phrase or stop words alone, UnknownWordError for words never taught.
        """
        keys = list(map(phrase_key, phrases))
        fresh = [key for key in dict.fromkeys(keys) if key not in self._vectors]
        for key in fresh:
            check_names(key.split())
        if fresh:
            encoder = self.encoder(progress)
            with self._turn:
                if unknown := dict.fromkeys(word for key in fresh for word in encoder.unknown_words(key)):
                    near = {word: encoder.near_words(word) for word in unknown}
                    raise UnknownWordError(near, "use other words, or a scene made with OpenCLIP weights")
                self._encode(encoder, fresh)
        return self._stacked(keys)

    def of_known(self, phrases: Iterable[str], progress: Progress = silent) -> tuple[tuple[str, ...], Array]:
        """Return the keys of `phrases` whose words the encoder was taught, each once, and (V, D) vectors."""
        keys = tuple(dict.fromkeys(map(phrase_key, phrases)))
        fresh = [key for key in keys if key not in self._vectors and not only(STOP_WORDS, key.split())]
        if fresh:
            encoder = self.encoder(progress)
            progress("loading the text encoder", 1.0)
            self._encode(encoder, [key for key in fresh if not encoder.unknown_words(key)], progress)
        known = tuple(key for key in keys if key in self._vectors)
        return known, self._stacked(known)

    @cached_property
    def everyday(self) -> Array | None:
        """The (V, D) vectors of everyday phrases, the field's own, else the encoder's; None if too few."""
        if self.field.everyday is not None:
            return self.everyday_so_far
        with suppress(EncoderError), self._turn:
            return everyday_vectors(self.encoder())
        return None

    @property
    def everyday_so_far(self) -> Array | None:
        """What is known of `everyday` without loading the encoder."""
        own = self.field.everyday
        return self.__dict__.get("everyday", None if own is None or len(own) < FEWEST else own)

    def _stacked(self, keys: Sequence[str]) -> Array:
        vectors = [self._vectors[key] for key in keys]
        return np.stack(vectors) if vectors else np.zeros((0, self.field.codec.vector_dim), np.float32)

    def _encode(self, encoder: TextEncoder, keys: Sequence[str], progress: Progress = silent) -> None:
        """Encode phrases in batches and keep their vectors."""
        for start in range(0, len(keys), BATCH):
            batch = list(keys[start : start + BATCH])
            with self._turn:
                vectors = np.asarray(encoder.encode_texts(batch), np.float32)
            self._vectors.update(zip(batch, vectors, strict=True))
            progress("reading the vocabulary", (start + len(batch)) / len(keys))

"""Phrases answered on one scene; the text encoder is loaded when a phrase first needs it."""

from collections.abc import Callable

from langsplat_core.config import LevelChoice
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine, QueryResult, TextEncoder
from langsplat_core.scene import Scene

LoadEncoder = Callable[[str], TextEncoder]


class Answers:
    """A scene's query engine. Not for use from two threads at once: the window asks on its worker only."""

    def __init__(self, scene: Scene, load_encoder: LoadEncoder, encoder_id: str = "") -> None:
        """`encoder_id` replaces the encoder that the scene names."""
        self._engine = QueryEngine(scene)
        self._load_encoder = load_encoder
        self._encoder_id = encoder_id

    def load_encoder(self, progress: Progress = silent) -> None:
        """Load the text encoder unless it is there; raises EncoderError. Imports torch: seconds."""
        if self._engine.encoder is None:
            progress("loading the text encoder", 0.1)
            self._engine.encoder = self._load_encoder(self._encoder_id or self._engine.field.encoder_id)

    def ask(self, phrase: str, level: LevelChoice, progress: Progress = silent) -> QueryResult:
        """Answer one phrase; raises InputError without a language field, EncoderError for unknown words."""
        known = " ".join(phrase.split()).lower() in self._engine.field.phrasebook
        if not known:
            self.load_encoder(progress)
        progress(f"searching '{phrase}'", 0.5)
        return self._engine.run(phrase, level)

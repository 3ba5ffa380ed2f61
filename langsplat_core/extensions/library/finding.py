"""A phrase in all scenes of a library: ranked by its index, the best ones asked of the engine."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, LangSplatError
from langsplat_core.extensions.library.index import EncoderGroup, Library, draw, fits_in
from langsplat_core.io.scenes import companion_path, load_scene
from langsplat_core.io.sidecar import SUFFIX, read_stored
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import LoadEncoder, QueryEngine
from langsplat_core.query.grammar import heads, named, parse
from langsplat_core.query.rule import Outcome, Verdict, judge, triple
from langsplat_core.scene import LEVELS, LanguageField, Scene
from langsplat_core.scene.codec import LinearCodec
from langsplat_core.scene.gaussians import join_gaussians
from langsplat_core.scene.language import phrase_key

PICTURE = (320, 240)  # width and height, pixels, of the picture of an answer


@dataclass(frozen=True, eq=False)
class Hit:
    """The answer of one scene to a phrase."""

    path: Path
    judgement: Verdict
    answer: QueryResult | None = None  # None where only the index was asked
    metres_per_unit: float | None = None
    picture: Array | None = None  # (H, W, 3) uint8, the answer as a heat map

    @property
    def verdict(self) -> Outcome:
        """The verdict in words."""
        return self.judgement.outcome

    @property
    def margin(self) -> float:
        """How certain the answer is, 0 where it begins to count as found, see `Verdict`."""
        return self.judgement.margin

    @property
    def probability(self) -> float | None:
        """The probability that it is there at all; None where nothing is calibrated."""
        return self.judgement.probability


@dataclass(frozen=True, eq=False)
class Answered:
    """The answers of all scenes of one encoder to a phrase."""

    phrase: str
    encoder_id: str
    hits: tuple[Hit, ...]  # those asked exactly first, by margin; then the others
    problem: str = ""  # why nothing was asked
    unread: tuple[tuple[str, str], ...] = ()  # scenes that could not be opened, and why

    def count(self, verdict: Outcome) -> int:
        """Return the number of scenes with this verdict."""
        return sum(hit.verdict == verdict for hit in self.hits)


def find(
    library: Library,
    phrase: str,
    load_encoder: LoadEncoder | None,
    at_most: int = 20,
    progress: Progress = silent,
) -> list[Answered]:
    """Return a phrase in every scene, group by group, the most certain answers first.

    The first `at_most` scenes of a group that answer are opened and asked exactly; the verdicts of the others
    are those of the index.
    """
    return [_ask_group(library, group, phrase, load_encoder, at_most, progress) for group in library.groups]


def _ask_group(
    library: Library,
    group: EncoderGroup,
    phrase: str,
    load_encoder: LoadEncoder | None,
    at_most: int,
    progress: Progress,
) -> Answered:
    key, taught = phrase_key(phrase), {name for scene in group.scenes for name in scene.taught}
    tree = parse(phrase, taught)
    try:
        vectors = {text: _vector(library, group, text, load_encoder) for text in heads(tree)}
    except EncoderError as error:
        if key not in taught:
            return Answered(phrase, group.encoder_id, (), str(error))
        vectors = {}
    rough = rank(group, vectors)
    hits = {
        scene.path: Hit(library.folder / scene.path, verdict)
        for scene, verdict in zip(group.scenes, rough, strict=True)
    }
    must = [scene.path for scene in group.scenes if not scene.is_indexed or key in scene.taught]
    order = sorted(hits, key=lambda name: (name not in must, -hits[name].margin))
    asked: list[Hit] = []
    unread: list[tuple[str, str]] = []
    for name in order:
        if name not in must and (hits[name].verdict == "not here" or len(asked) >= at_most):
            break
        progress(f"asking '{phrase}'", len(asked) / max(at_most, 1), name)
        try:
            hit = ask_scene(hits[name].path, phrase, load_encoder)
        except LangSplatError as error:
            unread.append((name, str(error)))
            del hits[name]
            continue
        hits[name] = hit
        if hit.verdict != "not here":
            asked.append(hit)
    asked.sort(key=lambda hit: -hit.margin)
    kept = {id(hit) for hit in asked}
    others = sorted((hit for hit in hits.values() if id(hit) not in kept), key=lambda hit: -hit.margin)
    return Answered(phrase, group.encoder_id, (*asked, *others), unread=tuple(unread))


def rank(group: EncoderGroup, vectors: Mapping[str, Array]) -> list[Verdict]:
    """Return the verdict on every scene by the index alone: on the best of some phrases."""
    best = [Verdict(False, "chance", -math.inf)] * len(group.scenes)
    for text, vector in vectors.items():
        for row, (scene, fits) in enumerate(zip(group.scenes, fits_in(group, vector), strict=True)):
            if scene.is_indexed:
                verdict = judge(triple(fits), named(text), "auto", scene.bars, scene.calibration)
                best[row] = max(best[row], verdict, key=lambda found: found.margin)
    return best


def _vector(library: Library, group: EncoderGroup, text: str, load_encoder: LoadEncoder | None) -> Array:
    """Return the (D,) unit vector of a phrase.

    It is the encoder's, checked against the group's canonical vectors, else that of the first phrasebook that
    has it. Raises EncoderError and, for no phrase, InputError.
    """
    dim = group.canonical.shape[1]
    codec = LinearCodec(np.eye(1, dim, dtype=np.float32))
    none = np.zeros((len(LEVELS), 0, 1), np.float32), np.zeros((len(LEVELS), 0), np.float32)
    field = LanguageField(*none, codec, group.canonical, group.encoder_id)
    try:
        return QueryEngine(Scene(join_gaussians([]), field), load_encoder).text_vector(text)
    except EncoderError:
        for scene in group.scenes:
            if scene.phrases:
                book = read_stored(companion_path(library.folder / scene.path, SUFFIX)).field.phrasebook
                if phrase_key(text) in book:
                    return book[phrase_key(text)]
        raise


def ask_scene(path: Path, phrase: str, load_encoder: LoadEncoder | None) -> Hit:
    """Return the engine's own answer to a phrase in one scene, with a picture of it."""
    scene = load_scene(path)
    engine = QueryEngine(scene, load_encoder)
    answer = run_phrase(engine, phrase).answer
    return Hit(path, answer.judgement, answer, scene.metres_per_unit, draw(scene, PICTURE, answer))

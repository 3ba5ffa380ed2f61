"""Suggestions of what to ask: examples that a scene answers, completions and corrections of what is typed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

from langsplat_core.errors import LangSplatError
from langsplat_core.progress import Progress, silent
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.inventory import scene_inventory
from langsplat_core.scene.language import phrase_key

EXAMPLES = 6
TRIES = 4  # candidates that are asked for each example wanted


@dataclass(frozen=True)
class Suggestions:
    """Examples and phrases for someone who does not know a scene."""

    examples: tuple[str, ...] = ()  # each is found in the scene
    phrases: tuple[str, ...] = ()  # that its encoder or its phrasebook knows, what is in the scene first


def suggest(engine: QueryEngine, at_most: int = EXAMPLES, progress: Progress = silent) -> Suggestions:
    """Return examples for a scene, from its inventory and phrasebook, each asked and found.

    There are none where nothing can be asked. This takes seconds: keep what it returns.
    """
    book = tuple(engine.field.phrasebook)
    here: tuple[str, ...] = ()
    taught: tuple[str, ...] = ()
    try:
        describer = Describer(engine, progress=progress)
        taught = describer.words[0].phrases
        entries = sorted(scene_inventory(describer, progress), key=lambda entry: -entry.probability)
        here = tuple(entry.phrase for entry in entries)
    except LangSplatError:  # no encoder here, or one that knows none of the words: the phrasebook is left
        pass
    candidates = tuple(dict.fromkeys((*here, *book)))
    found = (phrase for phrase in candidates[: TRIES * at_most] if _is_found(engine, phrase))
    return Suggestions(tuple(islice(found, at_most)), tuple(dict.fromkeys((*candidates, *taught))))


def _is_found(engine: QueryEngine, phrase: str) -> bool:
    try:
        return run_phrase(engine, phrase).answer.found
    except LangSplatError:  # "of", in someone's phrasebook
        return False


def completions(text: str, phrases: Sequence[str], at_most: int = 6) -> list[str]:
    """Return phrases that go on from what was typed, in the order of `phrases`.

    First come those that begin with all of it, then what was typed with its last word completed; nothing
    where no text is, or a word has ended.
    """
    typed = phrase_key(text)
    if not typed or text[-1:].isspace():
        return []
    begun, _, last = typed.rpartition(" ")
    whole = [phrase for phrase in phrases if phrase.startswith(typed) and phrase != typed]
    words = dict.fromkeys(word for phrase in phrases for word in phrase.split() if word.startswith(last))
    ended = [f"{begun} {word}" for word in words if word != last] if begun else []
    return list(dict.fromkeys((*whole, *ended)))[:at_most]


def corrected(text: str, near: Mapping[str, Sequence[str]]) -> str | None:
    """Return `text` with every unknown word replaced by the nearest known one; None where one has none.

    near: as of `UnknownWordError`.
    """
    if not all(near.values()):
        return None
    words = phrase_key(text).split(" ")
    return " ".join(near[word][0] if near.get(word) else word for word in words)

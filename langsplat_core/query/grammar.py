"""Phrases with structure: text -> tree, by a small grammar, and a tree's reading for people.

    query       = alternatives { exclusion alternatives }
    exclusion   = ", not" | "but not" | "and not" | "not" | "without" | "except" | "other than"
    alternatives = all { ("or" | ",") all }
    all         = clause { ("and" | "&" | "as well as") clause }
    clause      = [ superlative ] related [ "on the left" | "on the right" ]
    superlative = "biggest" | "smallest" | "nearest" | "farthest" | "highest" | "lowest" | "leftmost" | ...
    related     = thing { preposition related }      the first preposition relates all that follows it
    preposition = "of" | "on" | "in" | "near" | "left of" | "in front of" | "nearest to" | ...
    thing       = owner "'s" thing | words part-word | words

"X of Y", "Y's X" and "Y X" with X a known part word are X inside Y; not "cup of tea" (X holds or measures
Y), not "children's book" (Y owns X), not "red handle" (Y only describes). "Y without X", X a part word,
leaves out the X inside Y. Words that only describe are no thing, so that "red and blue ball" stays whole.
Wherever a side of a construction would name nothing, the grammar finds nothing there, and the words are asked
as one phrase. A line of several queries is separated by `scene.phrases.split_phrases`. Word lists are in
`query.vocabulary`.
"""

import re
from typing import Literal

from langsplat_core.errors import InputError
from langsplat_core.query.phrase_tree import (
    SIDES,
    Atom,
    Both,
    Extreme,
    Inside,
    Relation,
    Side,
    Superlative,
    Tree,
    Union,
    Without,
    atoms,
)
from langsplat_core.query.vocabulary import (
    ADJECTIVES,
    ALSO_NOUNS,
    ARTICLES,
    OWNERS,
    STOP_WORDS,
    check_names,
    is_measure,
    is_part,
    only,
)
from langsplat_core.scene.phrases import tokens as tokens_of

MAX_CHARACTERS = 400
MAX_ATOMS = 12  # each is asked for itself
_SUPERLATIVES: dict[str, Extreme] = {
    "biggest": "biggest", "largest": "biggest", "smallest": "smallest", "tiniest": "smallest",
    "nearest": "nearest", "closest": "nearest", "farthest": "farthest", "furthest": "farthest",
    "highest": "highest", "topmost": "highest", "uppermost": "highest", "lowest": "lowest",
    "bottommost": "lowest", "leftmost": "leftmost", "rightmost": "rightmost",
}  # fmt: skip
_SIDES: dict[str, Side] = {
    "on top of": "on", "on": "on", "upon": "on", "atop": "on", "standing on": "on", "lying on": "on",
    "sitting on": "on", "inside of": "in", "inside": "in", "in": "in", "within": "in", "next to": "near",
    "close to": "near", "near to": "near", "near": "near", "beside": "near", "by": "near",
    "adjacent to": "near", "to the left of": "left of", "on the left of": "left of",
    "on the left side of": "left of", "left of": "left of", "to the right of": "right of",
    "on the right of": "right of", "on the right side of": "right of", "right of": "right of",
    "above": "above", "over": "above", "below": "below", "under": "below", "underneath": "below",
    "beneath": "below", "behind": "behind", "in back of": "behind", "in front of": "in front of",
}  # fmt: skip
_PREPOSITIONS: dict[tuple[str, ...], Side | Extreme | Literal["of"]] = {
    ("of",): "of",
    **{
        (word, to): kind
        for word, kind in _SUPERLATIVES.items()
        if kind in ("nearest", "farthest")
        for to in ("to", "from")
    },
    **{tuple(text.split()): kind for text, kind in _SIDES.items()},
}
_EMPTY = STOP_WORDS | ADJECTIVES
_LONGEST = max(map(len, _PREPOSITIONS))
_EXCLUSIONS = tuple(
    tuple(text.split())
    for text in (
        *(", but not", ", and not", ", not", ", without", ", except"),
        *("but not", "and not", "other than", "not", "without", "except"),
    )
)


def parse(text: str) -> Tree:
    """The tree of one query.

    Raises InputError where nothing is named, where something is only excluded ("not the cup"), and for a text
    beyond `MAX_CHARACTERS` or `MAX_ATOMS`.
    """
    if len(text) > MAX_CHARACTERS:
        raise InputError(f"a query of {len(text)} characters; use at most {MAX_CHARACTERS}")
    tokens = tokens_of(text)
    words = [token for token in tokens if token != ","]
    if words and _exclusion_at(tokens, 0):
        raise InputError(
            f"'{' '.join(words)[:60]}' only says what not to look for; "
            "begin with what to look for: 'mug, not red mug'"
        )
    check_names(words)
    tree = _query(tokens)
    count = len(atoms(tree))
    if count > MAX_ATOMS:
        raise InputError(f"a query of {count} phrases; ask at most {MAX_ATOMS} at a time")
    return tree


def _query(tokens: list[str]) -> Tree:
    sides: list[list[str]] = [[]]
    at = 0
    while at < len(tokens):
        length = _exclusion_at(tokens, at)
        if length and _names(sides[-1]) and _names(tokens[at + length :]):
            sides.append([])
            at += length
        else:
            sides[-1].append(tokens[at])
            at += 1
    wanted, *others = [_alternatives(side) for side in sides]
    if not others:
        return wanted
    unwanted = [_of_it(other, wanted) for other in others]
    return Without(wanted, unwanted[0] if len(unwanted) == 1 else Union(tuple(unwanted)))


def _of_it(unwanted: Tree, wanted: Tree) -> Tree:
    """ "mug without handle": the mug's own handle is meant."""
    part, whole = (atoms(tree)[0].text.split()[-1] for tree in (unwanted, wanted))
    own = isinstance(unwanted, Atom) and is_part(part) and isinstance(wanted, Atom) and not is_part(whole)
    return Inside(unwanted, wanted) if own else unwanted


def _exclusion_at(tokens: list[str], at: int) -> int:
    """Number of tokens of the exclusion that begins there; 0 for none."""
    for words in _EXCLUSIONS:
        if tuple(token.lower() for token in tokens[at : at + len(words)]) == words:
            return len(words)
    return 0


def _alternatives(tokens: list[str]) -> Tree:
    ahead = [*(token.lower() for token in tokens[1:]), ""]
    tokens = [token for token, then in zip(tokens, ahead, strict=True) if (token, then) != (",", "or")]
    sides = _split(tokens, ("or", ","))
    items = [_all([token for token in side if token != ","]) for side in sides]
    return items[0] if len(items) == 1 else Union(tuple(items))


def _all(tokens: list[str]) -> Tree:
    as_one = " ".join(tokens)
    tokens = re.sub(r"\bas well as\b", "&", as_one, flags=re.IGNORECASE).split(" ")
    items = [_clause(part) for part in _split(tokens, ("and", "&"))]
    return items[0] if len(items) == 1 else Both(tuple(items))


def _split(tokens: list[str], marks: tuple[str, ...]) -> list[list[str]]:
    """Between `marks`, unless a side would name nothing."""
    parts: list[list[str]] = [[]]
    for token in tokens:
        if token.lower() in marks:
            parts.append([])
        else:
            parts[-1].append(token)
    return parts if all(map(_names, parts)) else [tokens]


def _names(tokens: list[str]) -> bool:
    """Whether the words name a thing: more than stop words and descriptions."""
    words = [token for token in tokens if token != ","]
    return not only(_EMPTY, words) or (bool(words) and words[-1].lower() in ALSO_NOUNS)


def _clause(tokens: list[str]) -> Tree:
    tokens = _without_articles(tokens)
    low = [token.lower() for token in tokens]
    kind = _SUPERLATIVES.get(low[0])
    if kind and _names(tokens[1:]):
        what = _related(tokens[1:])
        if kind in ("nearest", "farthest") and isinstance(what, Relation) and what.kind == "near":
            return Superlative(kind, what.what, what.anchor)
        at = next((i for i, word in enumerate(low) if word in ("to", "from") and i > 1), 0)
        if kind in ("nearest", "farthest") and at and _names(tokens[1:at]) and _names(tokens[at + 1 :]):
            return Superlative(kind, _related(tokens[1:at]), _related(tokens[at + 1 :]))
        return Superlative(kind, what)
    for side, extreme in (("left", "leftmost"), ("right", "rightmost")):
        if low[-3:] == ["on", "the", side] and _names(tokens[:-3]):
            return Superlative(_SUPERLATIVES[extreme], _related(tokens[:-3]))
    return _related(tokens)


def _related(tokens: list[str]) -> Tree:
    for at in range(1, len(tokens)):
        for length in range(min(_LONGEST, len(tokens) - at - 1), 0, -1):
            kind = _PREPOSITIONS.get(tuple(token.lower() for token in tokens[at : at + length]))
            before, after = tokens[:at], tokens[at + length :]
            named = _names(before) or (kind == "of" and is_part(before[-1]))
            if kind and named and _names(after) and not (kind == "of" and _holds(before)):
                return _relate(kind, _thing(before), _clause(after))
    return _thing(tokens)


def _holds(tokens: list[str]) -> bool:
    return is_measure(tokens[-1]) and only(_EMPTY, tokens[:-1])


def _relate(kind: Side | Extreme | Literal["of"], what: Tree, anchor: Tree) -> Tree:
    if kind == "of":
        return Inside(what, anchor)
    if kind == "nearest" or kind == "farthest":
        return Superlative(kind, what, anchor)
    side = next(side for side in SIDES if side == kind)
    return Relation(side, what, anchor)


def _thing(tokens: list[str]) -> Tree:
    for at, token in enumerate(tokens[:-1]):
        owner, rest = [*tokens[:at], re.sub(r"'s?$", "", token)], tokens[at + 1 :]
        owned = re.search(r"(?:\w's|s')$", token) and owner[-1].lower() not in OWNERS
        if owned and _names(owner) and not only(STOP_WORDS, rest):
            return Inside(_thing(rest), _thing(owner))
    words = _without_articles(tokens)
    if len(words) > 1 and is_part(words[-1]) and not only(_EMPTY, words[:-1]):
        at = len(words) - 1
        return Inside(Atom(words[at]), Atom(" ".join(words[:at])))
    return Atom(" ".join(words))


def _without_articles(tokens: list[str]) -> list[str]:
    """Without the articles at the beginning, unless there is nothing else."""
    first = next((at for at, token in enumerate(tokens) if token.lower() not in ARTICLES), 0)
    return tokens[first:]

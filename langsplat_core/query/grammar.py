"""The grammar of compositional queries, which parses text into a tree, and word lists of parts and things."""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from langsplat_core.errors import InputError
from langsplat_core.scene.language import tokens as tokens_of

Named = Literal["thing", "part", "part of a thing"]


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


ARTICLES = _words("a an the my your his her its our their this that these those some any")
# Words that alone name nothing to search for.
STOP_WORDS = ARTICLES | _words(
    "of in on at to by from with without and or not but no nor is are was be am it as for into onto than "
    "then there here what where which who whose how i you he she we they me us them so do does did except "
    "please"
)
COLOURS = _words(
    "red orange yellow green blue purple pink brown black white grey gray beige turquoise cyan magenta "
    "violet gold golden silver maroon navy teal olive cream tan"
)
# Words that only describe: "red handle" is a handle, "mug handle" is a part of a mug.
ADJECTIVES = COLOURS | _words(
    "light dark bright pale deep colourful colorful plain striped dotted checkered spotted patterned "
    "wooden wood metal metallic steel iron plastic glass leather cloth fabric cotton paper rubber ceramic "
    "porcelain stone marble concrete wax woollen woolen straw big large huge small little tiny tall short "
    "long wide narrow thin thick flat round square curved straight pointed sharp soft hard smooth rough "
    "shiny matte old new broken clean dirty open closed empty full upper lower left right front rear back "
    "middle top bottom outer inner first second third other same very"
)
# Adjectives that are nouns if no noun follows: "a mug and a glass".
ALSO_NOUNS = _words("orange glass stone paper light cloth gold silver metal wood leather straw iron")
# Parts of things, in the singular.
PARTS = _words(
    "handle lid leg ear wheel knob spout rim base stem shade bulb screen keyboard touchpad button dial "
    "display strap buckle zip zipper lace sole heel toe tongue collar sleeve cuff pocket hood flap seam brim "
    "cap cover spine page title seat backrest armrest cushion arm back headboard drawer door hinge latch "
    "lock frame pane window roof chimney gate tower wall wing tail nose fin rudder propeller cockpit nozzle "
    "engine hull mast sail deck funnel bumper headlight light tyre tire rim hub spoke pedal saddle handlebar "
    "windshield mirror hood head eye mouth beak face muzzle neck belly chest body hand finger foot feet paw "
    "claw hoof horn antenna shell whisker mane hair leaf leaves petal branch twig trunk root thorn stalk bud "
    "blade tip edge grip trigger barrel lens flash viewfinder strings string pickguard bridge fret drumhead "
    "hoop headband cord cable plug socket switch speaker antennae crust icing frosting topping filling peel "
    "skin core seed seeds yolk slice scoop cone cherry sprinkles wick flame holder stand pole post bracket "
    "rail step rung shelf board panel side corner top bottom front inside interior rind label logo ribbon "
    "bow bristle tine prong nib eraser tread trim skirting ledge sill arch column shaft joint ring loop hook "
    "chain clasp pendant"
)
# Words X of "X of Y" that hold or measure Y and are no part of it: "cup of tea", "pair of scissors".
MEASURES = _words(
    "cup mug glass bottle bowl plate jar can box bag pot bucket basket pair piece bit slice loaf bunch stack "
    "pile heap set row group kind type sort lot number handful can tin tube roll sheet bar block picture "
    "photo painting drawing statue map model image portrait bouquet carton pack packet pitcher jug barrel "
    "tray tank"
)
# Owners without parts: "children's book" is a book.
OWNERS = _words(
    "children child kid kids men man women woman baby boy girl ladies lady people person player driver "
    "reader writer painter baker fisherman valentine mother father"
)


def forms(word: str) -> tuple[str, ...]:
    """Return a word in lower case and its possible singulars."""
    low = word.lower()
    return (low, singular(low), low.removesuffix("s"), low.removesuffix("es"))


PLURALS = {
    "women": "woman", "men": "man", "people": "person", "feet": "foot", "teeth": "tooth", "mice": "mouse",
    "geese": "goose", "lenses": "lens", "wives": "wife", "knives": "knife", "cacti": "cactus",
}  # fmt: skip
OWN_SINGULARS = _words(
    "scissors glasses sunglasses eyeglasses goggles jeans trousers headphones shorts pants tights leggings "
    "clothes pyjamas overalls dungarees pliers tongs tweezers shears secateurs binoculars lens canvas atlas "
    "gas thermos rhinoceros series species christmas"
)
# Endings of other plurals, and what they are in the singular.
ENDINGS = {
    "(?<=child)ren$": "", "(?<=..[dekmnrstw])men$": "man",
    "(?<=lea|loa|hoo|wol|[hc]al|[hs]el|car|hie)ves$": "f",
    "(?<=ook|ood|oth|elf|omb|own|mov|pix|ean|egg|udg|ckt|owt|agp|otp|ird)ies$": "ie", "(?<=..)ies$": "y",
    "(?<=..)(?<!sh|pt|ob|fl)(?<!let)(?<!^al)(?<!^can)oes$": "o",
    "(?<=..ss|..sh|..tz)es$|(?<=..ch)(?<![tdhc]ach|[un]ich|ioch)es$|(?<=iz)zes$": "",
    "(?<=..[^oa]us)es$|(?<=^bus|^gas)es$|(?<=nvas|tlas|llis|iris)es$|(?<=..x)es$|(?<![sui])s$": "",
}  # fmt: skip


def singular(word: str) -> str:
    """Return the singular of an English noun; a word that is not plural is unchanged."""
    low = word.lower()
    if low in PLURALS or low in OWN_SINGULARS:
        return PLURALS.get(low, word)
    for ending, one in ENDINGS.items():
        word = re.sub(ending, one, word, flags=re.IGNORECASE)
    return word


def is_part(word: str) -> bool:
    """Return True if a noun, singular or plural, names a part of things."""
    return not PARTS.isdisjoint(forms(word))


def named(phrase: str) -> Named:
    """Return the kind of a phrase: "mug" is a thing, "red handle" a part, "mug handle" a part of a thing."""
    *before, last = phrase.split() or [""]
    if not is_part(last):
        return "thing"
    return "part" if only(_EMPTY, before) else "part of a thing"


def thing_and_part(phrase: str) -> tuple[str, str]:
    """Return thing and part of "part of a thing", "red mug" and "handle" of "red mug handle"; else "", ""."""
    *thing, part = phrase.split() if named(phrase) == "part of a thing" else [""]
    return " ".join(thing), part


def only(words: frozenset[str], tokens: Sequence[str]) -> bool:
    """Return True if all `tokens`, in any case, are among `words`; True for no tokens."""
    return all(token.lower() in words for token in tokens)


def check_names(words: Sequence[str]) -> None:
    """Raise InputError for no word, and for stop words alone, whose vectors are near everything."""
    if not words:
        raise InputError("the query is empty; type a word such as 'teapot'")
    if only(STOP_WORDS, words):
        raise InputError(f"'{' '.join(words)[:60]}' names nothing to look for; type a thing, as 'blue gift'")


Side = Literal["on", "in", "near", "left of", "right of", "above", "below", "behind", "in front of"]
Extreme = Literal["biggest", "smallest", "nearest", "farthest", "highest", "lowest", "leftmost", "rightmost"]


@dataclass(frozen=True)
class Atom:
    """A plain query."""

    text: str


@dataclass(frozen=True)
class Inside:
    """A part of a thing, searched within that thing alone."""

    part: "Phrase"
    whole: "Phrase"


@dataclass(frozen=True)
class Relation:
    """The instances of `what` in relation `kind` to an instance of `anchor`."""

    kind: Side
    what: "Phrase"
    anchor: "Phrase"


@dataclass(frozen=True)
class Both:
    """All of several things, each of which must be found."""

    items: tuple["Phrase", ...]


@dataclass(frozen=True)
class Union:
    """Several things, of which those that are found are the answer."""

    items: tuple["Phrase", ...]


@dataclass(frozen=True)
class Without:
    """Everything that is `what` and not `unwanted`."""

    what: "Phrase"
    unwanted: "Phrase"


@dataclass(frozen=True)
class Superlative:
    """The instance of `what` that is most `kind`; distances are to `anchor`, else to the camera."""

    kind: Extreme
    what: "Phrase"
    anchor: "Phrase | None" = None


@dataclass(frozen=True)
class Counted:
    """All of `what`, found if there are `count` instances or more."""

    count: int
    what: "Phrase"


Phrase = Atom | Inside | Relation | Both | Union | Without | Superlative | Counted


def atoms(tree: Phrase) -> tuple[Atom, ...]:
    """Return the plain queries of a tree, in the order of the text."""
    if isinstance(tree, Atom):
        return (tree,)
    return tuple(atom for child in children(tree) for atom in atoms(child))


def heads(tree: Phrase) -> tuple[str, ...]:
    """Return the phrases that are searched for: "mug" and "handle" of "mug or handle of the cup"."""
    if isinstance(tree, Atom):
        return (tree.text,)
    wanted = children(tree) if isinstance(tree, Both | Union) else children(tree)[:1]
    return tuple(text for child in wanted for text in heads(child))


def unparse(tree: Phrase) -> str:
    """Return a tree as text, such as "handle  inside  red mug"; nested trees are in brackets."""
    match tree:
        case Atom(text):
            return text
        case Counted(count, what):
            return f"{count}  {_nested(what)}"
        case Superlative(kind, what, anchor):
            return f"{kind}  {_nested(what)}" + ("" if anchor is None else f"  from  {_nested(anchor)}")
        case Relation(kind):
            between = str(kind)
        case _:
            between = {Both: "and", Union: "or", Without: "without", Inside: "inside"}[type(tree)]
    return f"  {between}  ".join(map(_nested, children(tree)))


def _nested(tree: Phrase) -> str:
    return tree.text if isinstance(tree, Atom) else f"({unparse(tree)})"


def children(tree: Phrase) -> tuple[Phrase, ...]:
    """Return the direct subtrees of a tree."""
    values = (value if isinstance(value, tuple) else (value,) for value in vars(tree).values())
    return tuple(part for several in values for part in several if isinstance(part, Phrase))


# The grammar of queries.
#
#     query       = alternatives { exclusion alternatives }
#     exclusion   = ", not" | "but not" | "and not" | "not" | "without" | "except" | "other than"
#     alternatives = all { ("or" | ",") all }
#     all         = clause { ("and" | "&" | "as well as") clause }
#     clause      = [ superlative ] [ number ] [ superlative ] related [ "on the left" | "on the right" ]
#     superlative = "biggest" | "smallest" | "nearest" | "farthest" | "highest" | "lowest" | "leftmost" | ...
#     number      = "one" | "two" | ... | "twelve" | digits
#     related     = thing { preposition related }      the first preposition relates all that follows it
#     preposition = "of" | "on" | "in" | "near" | "left of" | "in front of" | "nearest to" | ...
#     thing       = owner "'s" thing | words part-word | words
#
# "X of Y", "Y's X" and "Y X" with X a known part word are X inside Y; not "cup of tea" (X holds or measures
# Y), not "children's book" (Y owns X), not "red handle" (Y only describes). "Y without X", X a part word,
# excludes the X inside Y. Words that only describe name no thing, so that "red and blue ball" is not divided.
# A construction with a side that names nothing does not apply, and its words stay one plain query. A line of
# several queries is separated by `split_phrases`.

MAX_CHARACTERS = 400
MAX_ATOMS = 12  # plain queries in one tree
_DISTANCES: dict[str, Literal["nearest", "farthest"]] = {
    "nearest": "nearest", "closest": "nearest", "farthest": "farthest", "furthest": "farthest",
}  # fmt: skip
SUPERLATIVES: dict[str, Extreme] = {
    **_DISTANCES,
    "biggest": "biggest", "largest": "biggest", "smallest": "smallest", "tiniest": "smallest",
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
_COUNTED = ["one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
NUMBERS = {str(number): number for number in range(1, 1000)} | dict(zip(_COUNTED, range(1, 13), strict=True))
PREPOSITIONS: dict[str, Side | Literal["nearest", "farthest", "of"]] = {
    "of": "of",
    **{f"{word} {to}": kind for word, kind in _DISTANCES.items() for to in ("to", "from")},
    **_SIDES,
}
_EMPTY = STOP_WORDS | ADJECTIVES
_LONGEST = max(len(words.split()) for words in PREPOSITIONS)
# Beginnings of questions: "where is the mug".
_QUESTION = r"(?i)^(?:(?:where|which)(?:'s| is| are)|(?:is|are) there|find(?: me)?|show me|look for) (?=.)"
# Separators in a text of words and commas, each followed by a blank.
_EXCLUDED = r"(?i)(?: ,)?(?: (?:but|and))? (?:not|without|except|other than)(?= |$)"
_OR = r"(?i)(?: ,)?(?:^| )or(?= |$)|(?:^| ),(?= )"
_AND = r"(?i)(?:^| )(?:and|&|as well as)(?= |$)"
_LEADING = rf"(?i)^(?:(?:{'|'.join(sorted(ARTICLES))}) )+"


def parse(text: str, names: Collection[str] = ()) -> Phrase:
    """Return the tree of one query; names: keys of phrases that are not divided, such as taught words.

    InputError if nothing is named or only excluded ("not the cup"), or beyond `MAX_CHARACTERS`, `MAX_ATOMS`.
    """
    if not isinstance(text, str):
        raise InputError("a phrase is text, such as 'blue gift'; ask several one after the other")
    if len(text) > MAX_CHARACTERS:
        raise InputError(f"a query of {len(text)} characters; use at most {MAX_CHARACTERS}")
    asked = re.sub(_QUESTION, "", " ".join(_with_names(list(tokens_of(text)), names))).strip(", ")
    words = [word for word in asked.split(" ") if word not in ("", ",")]
    if words and re.match(_EXCLUDED, f" {asked}"):
        raise InputError(
            f"'{' '.join(words)[:60]}' only says what not to look for; "
            "begin with what to look for: 'toy, not teddy bear'"
        )
    check_names(words)
    tree = _query(asked)
    count = len(atoms(tree))
    if count > MAX_ATOMS:
        raise InputError(f"a query of {count} phrases; ask at most {MAX_ATOMS} at a time")
    return tree


def _with_names(tokens: list[str], names: Collection[str]) -> list[str]:
    """Return the tokens with those of each name joined by no-break spaces, the longest name first."""
    at = 0
    longest = max((len(name.split()) for name in names), default=0)
    while at < len(tokens):
        for count in range(longest, 1, -1):
            if " ".join(tokens[at : at + count]).lower() in names:
                tokens = [*tokens[:at], "\xa0".join(tokens[at : at + count]), *tokens[at + count :]]
                break
        at += 1
    return tokens


def _query(text: str) -> Phrase:
    wanted, *others = map(_alternatives, _exclusions(text))
    return Without(wanted, _group(Union, [_own_part(it, wanted) for it in others])) if others else wanted


def _exclusions(text: str) -> list[str]:
    """Split a text into what is wanted and what is excluded, if both sides name something."""
    for mark in re.finditer(_EXCLUDED, text):
        before, after = text[: mark.start()], text[mark.end() :]
        if _names(before) and _names(after):
            return [before, *_exclusions(after.strip(", "))]
    return [text]


def _own_part(unwanted: Phrase, wanted: Phrase) -> Phrase:
    """Return `unwanted` inside `wanted` if it is a part: "mug without handle" means the mug's handle."""
    part, whole = (atoms(tree)[0].text.split()[-1] for tree in (unwanted, wanted))
    own = isinstance(unwanted, Atom) and is_part(part) and isinstance(wanted, Atom) and not is_part(whole)
    return Inside(unwanted, wanted) if own else unwanted


def _alternatives(text: str) -> Phrase:
    each = (_sides(side.replace(" ,", ""), _AND) for side in _sides(text, _OR))
    return _group(Union, [_group(Both, list(map(_clause, items))) for items in each])


def _group(kind: type[Both | Union], items: Sequence[Phrase]) -> Phrase:
    return items[0] if len(items) == 1 else kind(tuple(items))


def _sides(text: str, mark: str) -> list[str]:
    """Split a text at separators, unless a side would name nothing."""
    sides = [side.strip(", ") for side in re.split(mark, text)]
    return sides if all(map(_names, sides)) else [text]


def _names(text: str) -> bool:
    """Return True if words name a thing: not only stop words and adjectives."""
    words = [word for word in text.split(" ") if word not in ("", ",")]
    return not only(_EMPTY, words) or (bool(words) and words[-1].lower() in ALSO_NOUNS)


def _clause(text: str) -> Phrase:
    text = re.sub(_LEADING, "", text)
    first, _, rest = text.partition(" ")
    if first.lower() in SUPERLATIVES and rest.split(" ")[0].lower() in NUMBERS:  # "biggest two mugs"
        number, _, rest = rest.partition(" ")
        return _clause(f"{number} {first} {rest}".strip())
    kind = SUPERLATIVES.get(first.lower())
    if kind and _names(rest):
        return _extreme(kind, rest)
    count = NUMBERS.get(first.lower())
    if count and _names(rest):
        what = _clause(rest)
        return Counted(count, what if count == 1 else _one_of(what))
    aside = re.fullmatch("(?i)(.+) on the (left|right)", text)
    if aside and _names(aside[1]):
        return Superlative(SUPERLATIVES[f"{aside[2].lower()}most"], _related(aside[1]))
    return _related(text)


def _extreme(kind: Extreme, text: str) -> Superlative:
    what, ends = _related(text), re.match(r"(?i)(.+?) (?:to|from) (.+)", text)
    if kind in _DISTANCES and isinstance(what, Relation) and what.kind == "near":
        return Superlative(kind, what.what, what.anchor)
    if kind in _DISTANCES and ends and all(map(_names, ends.groups())):
        return Superlative(kind, *map(_related, ends.groups()))
    return Superlative(kind, what)


def _one_of(tree: Phrase) -> Phrase:
    """Return the tree with the searched noun in the singular, since a mask shows one instance."""
    match tree:
        case Atom(text):
            *before, last = text.split()
            return Atom(" ".join([*before, singular(last)]))
        case Inside(part, whole):
            return Inside(_one_of(part), whole)
        case Relation() | Superlative():
            return replace(tree, what=_one_of(tree.what))
    return tree


def _related(text: str) -> Phrase:
    words = text.split(" ")
    for at in range(1, len(words)):
        for end in range(min(at + _LONGEST, len(words) - 1), at, -1):
            kind = PREPOSITIONS.get(" ".join(words[at:end]).lower())
            (*describing, head), before, after = words[:at], " ".join(words[:at]), " ".join(words[end:])
            named = _names(before) or (kind == "of" and is_part(head))
            holds = not MEASURES.isdisjoint(forms(head)) and only(_EMPTY, describing)  # "cup of tea"
            if kind and named and _names(after) and not (kind == "of" and holds):
                what, anchor = _thing(before), _clause(after)
                if kind == "of":
                    return Inside(what, anchor)
                if kind == "nearest" or kind == "farthest":
                    return Superlative(kind, what, anchor)
                return Relation(kind, what, anchor)
    return _thing(text)


def _thing(text: str) -> Phrase:
    for mark in re.finditer(r"(?:(?<=\w)'s|(?<=s)') ", text):
        owner, rest = text[: mark.start()], text[mark.end() :]
        owns = owner.split(" ")[-1].lower() not in OWNERS and _names(owner)
        if owns and not only(STOP_WORDS, rest.split(" ")):
            return Inside(_thing(rest), _thing(owner))
    text = re.sub(_LEADING, "", text)
    thing, _, part = text.rpartition(" ")
    if thing and is_part(part) and not only(_EMPTY, thing.split(" ")):
        return Inside(Atom(part), Atom(thing))
    return Atom(text)

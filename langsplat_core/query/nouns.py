"""What a phrase without structure names: the word lists by which a part is told from a thing."""

from collections.abc import Sequence
from typing import Literal

from langsplat_core.errors import InputError

Named = Literal["thing", "part", "part of a thing"]


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


ARTICLES = _words("a an the my your his her its our their this that these those some any")
# What alone names nothing to look for.
STOP_WORDS = ARTICLES | _words(
    "of in on at to by from with without and or not but no nor is are was be am it as for into onto than "
    "then there here what where which who whose how i you he she we they me us them so do does did except "
    "please"
)
# Words that describe and name nothing: "red handle" is one thing, "mug handle" is a part of another.
ADJECTIVES = _words(
    "red orange yellow green blue purple pink brown black white grey gray beige turquoise cyan magenta "
    "violet gold golden silver maroon navy teal olive cream tan light dark bright pale deep colourful "
    "colorful plain striped dotted checkered spotted patterned wooden wood metal metallic steel iron plastic "
    "glass leather cloth fabric cotton paper rubber ceramic porcelain stone marble concrete wax woollen "
    "woolen straw big large huge small little tiny tall short long wide narrow thin thick flat round square "
    "curved straight pointed sharp soft hard smooth rough shiny matte old new broken clean dirty open closed "
    "empty full upper lower left right front rear back middle top bottom outer inner first second third "
    "other same very"
)
# Of these, what is a thing where no noun follows: "a mug and a glass".
ALSO_NOUNS = _words("orange glass stone paper light cloth gold silver metal wood leather straw iron")
# Things that are a part of another thing; plurals are found by their singular.
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
# Heads of "X of Y" that hold or measure Y, and are no part of it: "cup of tea", "pair of scissors".
MEASURES = _words(
    "cup mug glass bottle bowl plate jar can box bag pot bucket basket pair piece bit slice loaf bunch stack "
    "pile heap set row group kind type sort lot number handful can tin tube roll sheet bar block picture "
    "photo painting drawing statue map model image portrait bouquet carton pack packet pitcher jug barrel "
    "tray tank"
)
# Owners of which nothing is a part: "children's book" is a book.
OWNERS = _words(
    "children child kid kids men man women woman baby boy girl ladies lady people person player driver "
    "reader writer painter baker fisherman valentine mother father"
)


def forms(word: str) -> tuple[str, ...]:
    """Return a word in lower case and what it may be the plural of."""
    low = word.lower()
    return (low, low.removesuffix("s"), low.removesuffix("es"))


_PLURALS = {
    "men": "man", "women": "woman", "people": "person", "children": "child", "feet": "foot", "teeth": "tooth",
    "mice": "mouse", "geese": "goose", "leaves": "leaf", "loaves": "loaf", "knives": "knife",
    "wolves": "wolf", "shelves": "shelf", "halves": "half", "scarves": "scarf", "shoes": "shoe",
}  # fmt: skip
_ALWAYS_PLURAL = _words("scissors glasses jeans trousers headphones shorts pants pliers tongs binoculars")


def singular(word: str) -> str:
    """Return the singular of an English noun; a word that is none already stays."""
    low = word.lower()
    if low in _PLURALS or low in _ALWAYS_PLURAL:
        return _PLURALS.get(low, word)
    for ending, one in (("ies", "y"), ("sses", "ss"), ("xes", "x"), ("ches", "ch"), ("shes", "sh")):
        if low.endswith(ending) and len(low) > len(ending) + 1:
            return word[: -len(ending)] + one
    return word[:-1] if low.endswith("s") and not low.endswith(("ss", "us", "is")) else word


def is_part(word: str) -> bool:
    """Return whether a noun, in either number, is a part of things."""
    return not PARTS.isdisjoint(forms(word))


def named(phrase: str) -> Named:
    """Return the kind of what a phrase without structure names.

    "red mug" is a thing, "red handle" and "keyboard" are parts, "mug handle" is a part of a thing.
    """
    *before, last = phrase.split() or [""]
    if not is_part(last):
        return "thing"
    return "part" if only(ADJECTIVES | ARTICLES, before) else "part of a thing"


def only(words: frozenset[str], tokens: Sequence[str]) -> bool:
    """Return whether all `tokens` are among `words`, whatever their case; so also of no tokens."""
    return all(token.lower() in words for token in tokens)


def check_names(words: Sequence[str]) -> None:
    """InputError for no word, and for stop words alone, whose vectors are near anything."""
    if not words:
        raise InputError("the query is empty; type a word such as 'cup'")
    if only(STOP_WORDS, words):
        raise InputError(
            f"'{' '.join(words)[:60]}' names nothing to look for; type a thing such as 'red mug'"
        )

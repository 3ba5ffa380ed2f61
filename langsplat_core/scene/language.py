"""The language field of a scene: language features, tree of instances, calibration; and the text of phrases.

Phrases first, without quotes and punctuation, which change text vectors and end the demo encoder's phrases.
"""

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from langsplat_core.arrays import Array, check_array, sigmoid
from langsplat_core.config import Level
from langsplat_core.scene.codec import Codec

_SEPARATE = re.compile(r"(?i)[;\n]|,(?!\s*(?:(?:but|and)\s+)?(?:not|without|except|other\s+than)\b)")
_APOSTROPHES = str.maketrans(dict.fromkeys("’‘ʼ′＇´`", "'"))


def split_phrases(text: str) -> list[str]:
    """Return the tidy phrases of a text, split at ";", "," and line ends; "mug, not red" is one phrase."""
    return [part for part in (tidy(part) for part in _SEPARATE.split(_composed(text))) if part]


def tidy(text: str) -> str:
    """Return a phrase as it is shown: bare words and single spaces, commas behind their words."""
    return " ".join(tokens(text)).replace(" ,", ",").lstrip(", ")


def phrase_key(text: str) -> str:
    """Return the key by which a phrase is looked up and encoded: its words, lower case as CLIP has them."""
    return " ".join(token for token in tokens(text) if token != ",").lower()


@lru_cache(2**14)  # a phrase is looked up a dozen times while it is answered, beside thousands of others
def tokens(text: str) -> tuple[str, ...]:
    """Return the words of a text, without punctuation around them, and its commas, none at the end."""
    text = "".join(" " if unicodedata.category(mark) in ("Cc", "Cs") else mark for mark in _composed(text))
    text = re.sub(r"(?<=\w)\s+'s\b", "'s", text)
    pieces = ("," if piece == "," else _bare(piece) for piece in re.findall(r",|[^\s,;]+", text))
    found = list(filter(None, pieces))
    while found and found[-1] == ",":
        found.pop()
    return tuple(found)


def _composed(text: str) -> str:
    return unicodedata.normalize("NFKC", text.translate(_APOSTROPHES))


def _bare(word: str) -> str:
    """Return `word` without punctuation around it, "" if nothing is left; a possessive's apostrophe stays."""
    if word == "&" or word.isalnum():
        return word
    kinds = [unicodedata.category(mark) for mark in word]
    marks = [kind[0] in "PZ" or kind == "Cf" for kind in kinds]
    if all(marks):
        return ""
    first, last = marks.index(False), len(marks) - marks[::-1].index(False)
    if all(kind in ("Cf", "Po", "Mn") for kind in kinds[first:last]):
        return ""
    owns = word[last : last + 1] == "'" and first == 0 and word[last - 1] == "s"
    return word[first:last] + ("'" if owns else "")


# The tree of a scene: wholes, their parts and the subparts of these. Relevancy varies between the Gaussians
# of an instance: an answer of whole nodes has its borders and no speckles, and its peak is a patch's mean.

# Index 0, 1, 2 wherever a level axis appears.
LEVELS: tuple[Level, Level, Level] = ("subpart", "part", "whole")
NO_NODE = -1


@dataclass(frozen=True, eq=False, repr=False)
class Tree:
    """K nodes, each a set of Gaussians within its parent's. Children come before their parents."""

    leaves: Array  # (N,) int32 smallest node that each Gaussian is in; NO_NODE for those in none
    parents: Array  # (K,) int32 parent of each node, which is a later node; NO_NODE for roots
    levels: Array  # (K,) uint8 level of each node, an index into LEVELS; never above its parent's
    # (K, 2) uint16 counts of photographs: with a mask of just this node, and showing it without one
    votes: Array

    def __post_init__(self) -> None:
        check_array("leaves", self.leaves, ("N",), dtype=np.int32)
        dims = check_array("parents", self.parents, ("K",), dtype=np.int32)
        check_array("levels", self.levels, ("K",), dims, dtype=np.uint8)
        check_array("votes", self.votes, ("K", 2), dims, dtype=np.uint16)
        count, numbers = len(self.parents), np.arange(len(self.parents))
        if ((self.leaves < NO_NODE) | (self.leaves >= count)).any():
            raise ValueError(f"tree: leaves outside the {count} nodes")
        parents, child = self.parents, self.parents != NO_NODE
        if (parents[child] <= numbers[child]).any() or (parents >= count).any() or (parents < NO_NODE).any():
            raise ValueError("tree: every parent must be a later node")
        if (self.levels >= len(LEVELS)).any() or (self.levels[child] > self.levels[parents[child]]).any():
            raise ValueError("tree: levels must be 0, 1 or 2 and not above the parent's")

    @property
    def count(self) -> int:
        """Number K of nodes."""
        return len(self.parents)

    def at(self, level: int) -> Array:
        """Return (N,) int32 largest node up to `level` of each Gaussian, else its smallest, else NO_NODE."""
        owners = [*range(self.count), NO_NODE]
        low = [*(self.levels <= level).tolist(), False]  # the last: of NO_NODE, the parent of roots
        for node, parent in zip(range(self.count - 1, -1, -1), self.parents[::-1].tolist(), strict=True):
            if low[parent]:
                owners[node] = owners[parent]
        return np.array(owners, np.int32)[self.leaves]

    @cached_property
    def voted_wholes(self) -> Array:
        """(N,) int32 whole of each Gaussian, NO_NODE if no mask voted for it; splits answers in instances."""
        at, votes = self.at(len(LEVELS) - 1), np.append(self.votes[:, 0] > 0, False)
        return np.where(votes[at], at, np.int32(NO_NODE))

    def members(self, node: int) -> Array:
        """Return (N,) bool: the Gaussians of a node, those of its descendants included."""
        inside = [False] * (self.count + 1)  # the last: in no node
        inside[node] = True
        for other, parent in zip(range(node - 1, -1, -1), self.parents[:node][::-1].tolist(), strict=True):
            inside[other] = inside[parent]
        return np.array(inside)[self.leaves]

    def totals(self, own: Array) -> Array:
        """Return (K,) int64 sums over each node and its descendants of the nodes' (K,) `own` numbers."""
        totals = own.tolist()
        for node, parent in enumerate(self.parents.tolist()):
            if parent != NO_NODE:
                totals[parent] += totals[node]
        return np.array(totals, np.int64)

    def gaussians(self) -> "NodeGaussians":
        """Return the Gaussians of every node, as ranges of one common order of Gaussians."""
        inside = self.leaves != NO_NODE
        own = np.bincount(self.leaves[inside], minlength=self.count)
        sizes = self.totals(own)
        firsts = sizes.tolist()
        next_child, roots = list(firsts), 0
        for node, parent in zip(range(self.count - 1, -1, -1), self.parents[::-1].tolist(), strict=True):
            first = roots if parent == NO_NODE else next_child[parent]
            if parent == NO_NODE:
                roots += firsts[node]
            else:
                next_child[parent] += firsts[node]
            firsts[node] = next_child[node] = first
        starts = np.array(firsts, np.int64)
        behind = starts + sizes - own  # a node's own Gaussians are behind those of its parts
        rows = np.flatnonzero(inside)
        return NodeGaussians(rows[np.argsort(behind[self.leaves[rows]], kind="stable")], starts, sizes)


@dataclass(frozen=True, eq=False)
class NodeGaussians:
    """The Gaussians of the K nodes of a tree, without a copy for each node."""

    order: Array  # (M,) numbers of Gaussians
    starts: Array  # (K,) index into `order` of a node's first Gaussian
    sizes: Array  # (K,) number of a node's Gaussians

    def __getitem__(self, node: int) -> Array:
        """Return the Gaussians of a node, ascending."""
        start = self.starts[node]
        return np.sort(self.order[start : start + self.sizes[node]])

    def sums(self, values: Array) -> Array:
        """Return the (K, ...) float64 sums of (N, ...) values over each node."""
        running = np.cumsum(values[self.order], axis=0, dtype=np.float64)
        running = np.concatenate([np.zeros_like(running[:1], shape=(1, *values.shape[1:])), running])
        return np.asarray(running[self.starts + self.sizes] - running[self.starts])


# Calibration of one text encoder's cosines: the probability that what a phrase names is present at all.

LARGEST_COEFFICIENT = 1e6  # of a calibration: cosines are rounded to 1e-7
Fits = tuple[float, float, float]  # the best at each level, see `semantics.relevancy.Scale.fit`


@dataclass(frozen=True)
class PlattScaling:
    """Platt scaling (Platt 1999): the probability as a logistic function of the best fits of an answer.

    ``probability = sigmoid(constant + whole * fit of whole things + finer * the better one of the finer
    levels + common * mean fit of all regions)``, with equal priors for present and absent.
    """

    constant: float
    whole: float
    finer: float
    found: float = 0.75  # probability from which a phrase counts as found; 0.5 up to here is a weak match
    common: float = 0.0

    def __post_init__(self) -> None:
        slopes = (self.whole, self.finer)
        bounded = (np.abs([self.constant, *slopes, self.common]) <= LARGEST_COEFFICIENT).all()
        if not (bounded and sum(slopes) > 0 and 0.5 <= self.found <= 1):
            raise ValueError(
                f"{self}: expected up to {LARGEST_COEFFICIENT:g}, rising with fits, and found in [0.5, 1]"
            )

    def probability(self, fits: Fits, common: float = 0.0) -> float:
        """Return the probability, in (0, 1), that what a phrase names is present; common: its mean fit."""
        subpart, part, whole = fits
        logit = self.constant + self.whole * whole + self.finer * max(subpart, part) + self.common * common
        return float(sigmoid(np.array(logit)))


@dataclass(frozen=True)
class Calibration:
    """Platt scaling for each kind of phrase, since the fits of the kinds differ."""

    thing: PlattScaling  # "mug": a thing, searched in the whole scene
    part: PlattScaling  # "handle": a part of any thing
    inside: PlattScaling  # "handle of the mug": a part, searched on a thing that is present
    coloured_thing: PlattScaling | None = None  # "red mug", whose fits are lower than those of "mug"
    coloured_part: PlattScaling | None = None  # "red handle"; None: as without the colour

    def __post_init__(self) -> None:
        object.__setattr__(self, "coloured_thing", self.coloured_thing or self.thing)
        object.__setattr__(self, "coloured_part", self.coloured_part or self.part)


# The language field: the language features of every Gaussian at three levels.

CANONICAL_PHRASES = ("object", "things", "stuff", "texture")  # LERF's negatives, used by LangSplat
MOST_SHOWN = 8  # examples of a taught word; with more of them, more of a scene resembles one by chance
LONGEST_NAME = 80  # characters


@dataclass(frozen=True, eq=False)
class TaughtWord:
    """A word that was taught by showing examples of what it names, see `query.taught`."""

    name: str  # as it is shown, see `tidy`
    level: int  # index into LEVELS of what was shown
    vectors: Array  # (T, D) float32 unit: mean language feature of each example, less that of its scene
    rivals: Array  # (T,) float32 in [0, 1]: cosine of different things in the scene of each example

    def __post_init__(self) -> None:
        dims = check_array("vectors", self.vectors, ("T", "D"), dtype=np.float32)
        check_array("rivals", self.rivals, ("T",), dims, dtype=np.float32)
        named = 0 < len(self.name) <= LONGEST_NAME and self.name == tidy(self.name) and "," not in self.name
        if not (named and self.level in range(len(LEVELS)) and 0 < len(self.vectors) <= MOST_SHOWN):
            raise ValueError(
                f"taught word {self.name[:40]!r}: expected a name of 1 to {LONGEST_NAME} characters without "
                f"quotes and commas, a level and 1 to {MOST_SHOWN} examples"
            )
        near_unit = abs(np.linalg.norm(self.vectors, axis=1) - 1) <= 1e-3
        if not (near_unit.all() and ((self.rivals >= 0) & (self.rivals <= 1)).all()):
            raise ValueError(f"taught word {self.name[:40]!r}: expected unit vectors and rivals in [0, 1]")

    @property
    def key(self) -> str:
        """Key by which the word is looked up."""
        return phrase_key(self.name)


@dataclass(frozen=True, eq=False)
class LanguageField:
    """Latents of N Gaussians at the three levels, with everything a query needs beside them."""

    latents: Array  # (3, N, d) of the codec's type; zero where a Gaussian was never observed
    confidence: Array  # (3, N) float32 >= 0: total blending weight with which it was observed
    codec: Codec
    canonical: Array  # (C, D) float32 unit text vectors, of CANONICAL_PHRASES unless a query chose others
    encoder_id: str  # hub id or folder of the text encoder, e.g. "demo"
    phrasebook: Mapping[str, Array] = field(default_factory=dict)  # `phrase_key` -> (D,) unit vector
    temperature: float = 10.0  # of the softmax over cosines; 10 in the code of LERF and LangSplat, for CLIP
    found: float = 0.6  # peak relevancy, as published, from which a phrase counts as present
    calibration: Calibration | None = None  # None: no probability is known to hold here
    tree: Tree | None = None  # of the N Gaussians; None: one is built when needed
    everyday: Array | None = None  # (V, D) float32 unit vectors of common phrases, most absent from the scene
    taught: tuple[TaughtWord, ...] = ()  # their keys are distinct

    def __post_init__(self) -> None:
        d, big = self.codec.latent_dim, self.codec.vector_dim
        dims = check_array("latents", self.latents, (len(LEVELS), "N", d), dtype=self.codec.dtype)
        self.codec.check(self.latents.reshape(-1, d))
        check_array("confidence", self.confidence, (len(LEVELS), "N"), dims, dtype=np.float32)
        check_array("canonical", self.canonical, ("C", big), dtype=np.float32)
        if len(self.canonical) == 0:
            raise ValueError("canonical: a phrase is compared with one other at least")
        if not (0 < self.temperature <= LARGEST_COEFFICIENT and 0 <= self.found <= 1):
            raise ValueError(
                f"temperature {self.temperature} and found {self.found}; expected a positive number up to "
                f"{LARGEST_COEFFICIENT:g} and one in [0, 1]"
            )
        if self.tree is not None:
            check_array("leaves", self.tree.leaves, ("N",), dims)
        if self.everyday is not None:
            check_array("everyday", self.everyday, ("V", big), dtype=np.float32)
        for word in self.taught:
            check_array(f"taught[{word.name!r}]", word.vectors, ("T", big))
        if len({word.key for word in self.taught}) != len(self.taught):
            raise ValueError("taught: two words have one name")
        known = {phrase_key(phrase): vector for phrase, vector in self.phrasebook.items()}
        object.__setattr__(self, "phrasebook", known)
        for phrase, vector in known.items():
            check_array(f"phrasebook[{phrase!r}]", vector, (big,), dtype=np.float32)

    def __repr__(self) -> str:
        return f"<language field of {len(self):,} Gaussians, {self.codec.kind}, by {self.encoder_id}>"

    def __len__(self) -> int:
        return int(self.latents.shape[1])

    @property
    def known(self) -> Array:
        """(3, N) bool, whether a Gaussian has a language feature at a level."""
        flat = self.codec.known(self.latents.reshape(-1, self.latents.shape[2]))
        return np.asarray((self.confidence > 0) & flat.reshape(self.confidence.shape))

    @cached_property
    def colours(self) -> Array:
        """(3, N, 3) float32 colours in [0, 1] of the latents at each level, grey where nothing was seen.

        One basis for all levels, see `codec.principal_colours`: colours agree between views and levels.
        """
        seen, flat = self.known, self.latents.reshape(-1, self.latents.shape[2])
        colours = self.codec.colours(flat, seen.reshape(-1).astype(np.float64)).reshape(*seen.shape, 3)
        return np.where(seen[..., None], colours, np.float32(0.5)).astype(np.float32)

    def take(self, rows: Array) -> "LanguageField":
        """Return the field of the Gaussians at `rows` (indices or a boolean mask)."""
        return replace(
            self,
            latents=self.latents[:, rows],
            confidence=self.confidence[:, rows],
            tree=None if self.tree is None else replace(self.tree, leaves=self.tree.leaves[rows]),
        )

    def matched(self, rows: Array) -> "LanguageField":
        """Return the field of the Gaussians at (M,) `rows`; where a row is -1, without features."""
        if (tree := self.tree) is not None:
            tree = replace(tree, leaves=np.pad(tree.leaves, (0, 1), constant_values=NO_NODE))
        latents = np.pad(self.latents, ((0, 0), (0, 1), (0, 0)))
        confidence = np.pad(self.confidence, ((0, 0), (0, 1)))
        return replace(self, latents=latents, confidence=confidence, tree=tree).take(rows)

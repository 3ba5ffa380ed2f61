"""Stages that make no mistake, or known ones, from a procedural room's ground truth; and encoders with the
geometry of real CLIP, whose images are described from it.

The bundled encoder tells what is there from what is not by margins of 0.2; CLIP's are 0.01 to 0.07, its texts
lie close together, and its images lie on the other side of a gap. Two test beds stand for it.

`ClipGeometry`, "clip-geometry:OWN", is **simulated**. A text vector is the common direction of all prompts
and what is the word's own, of real CLIP vectors where a file has them. An image's vector is

    v  =  a g  +  c m  +  s r  +  noise of the region, in all views  +  noise of the mask, in this view

with g the direction of images, orthogonal to where texts differ (Liang et al. 2022, "Mind the gap"), m the
common direction of texts and r the own direction of the words that are true. a, c, s follow from three
cosines: of an image with its own words (`own`: in real scenes 0.25 to 0.28), with other words (`OTHER`), and
of two images of different things (`alike`: 0.57 to 0.70). Everything else is held to statistics of 500 real
photographs against 1 203 real words (`test_simulated_images_have_the_statistics_of_photographs`): noise has
their spectrum and is no nearer to words than to anything, hubs and means over words are as wide.

`RealSpace`, "real:PATH", draws from **real** vectors: PATH is a decoder of LangSplat that was trained on real
CLIP vectors of a scene, or a folder of some (a room takes one of them), with real text vectors beside it.

* Real: the text vectors of single names, phrases as published among them; the set of the decoder, on which a
  scene's image vectors lie, blurred by three numbers a vector; the spectrum of what that blur loses.
* Drawn: which name a word of the room stands for (`in_room`); where on the set a region lies (`RULES`, which
  favour different readings, one drawn for each region); noise along the set (`JITTER`) and off it (`LOST`),
  half of it lasting; vectors of phrases of several names, such as "mug handle", from those of the names.

In both, one mask in seven shows another region, and a part's image is mixed with its thing's. Guesses are the
shares of noise that last, the mixing (`MODIFIER`, `OWNER`), `JITTER` and `LOST`.
"""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from pathlib import Path

import numpy as np

from assets.making.dataset import Region, Truth
from assets.making.objects import EVERYTHING
from assets.making.world import object_words
from langsplat_core.arrays import Array, unit
from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.langsplat_files import autoencoder_from
from langsplat_core.extensions.checkpoints.unpickling import load_torch
from langsplat_core.io.hostile import read_npy
from langsplat_core.query.engine import TextEncoder
from langsplat_core.query.grammar import PARTS
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    LEVELS,
    AutoencoderCodec,
    Calibration,
    Camera,
    Gaussians,
    LanguageField,
)
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.semantics.relevancy import bundled_vocabulary
from langsplat_core.training.language.lift import MaskGroups
from tests.support.scenes import find_mask_weights

WRONG = 0.15  # share of masks with another region's vector


def oracle_vectors(features: ImageFeatures, ids: Array, vectors: Mapping[int, Array]) -> ImageFeatures:
    """`features` as if the encoder had read what most of every region's pixels truly are.

    ids: (3, H, W) truth; vectors: id -> (D,) unit text vector. A region that mostly shows nothing, or
    something without a name, keeps its own vector.
    """
    told = features.vectors.copy()
    for labels, truth in zip(features.labels, ids, strict=True):
        for row, number, _ in sorted(overlaps(labels, truth), key=itemgetter(2)):  # the largest comes last
            told[row] = vectors.get(number, features.vectors[row])
    return replace(features, vectors=told)


def overlaps(labels: Array, truth: Array) -> list[tuple[int, int, int]]:
    """(mask, truth id, pixels) of every mask of a level and everything that it shows."""
    inside = labels >= 0
    pairs, counts = np.unique(np.stack([labels[inside], truth[inside]]), axis=1, return_counts=True)
    return list(zip(*pairs.tolist(), counts.tolist(), strict=True))


def with_wrong_vectors(features: ImageFeatures, seed: int) -> ImageFeatures:
    """`features` as if the encoder had taken `WRONG` of the regions for another of the same photograph."""
    generator = np.random.default_rng(seed)
    count = len(features.vectors)
    wrong = np.flatnonzero(generator.uniform(size=count) < WRONG)
    vectors = features.vectors.copy()
    vectors[wrong] = features.vectors[generator.integers(max(count, 1), size=len(wrong))]
    return replace(features, vectors=vectors)


def moved_to_images(told: Sequence[ImageFeatures], seen: Sequence[ImageFeatures]) -> list[ImageFeatures]:
    """Text vectors moved by one vector, the same for all, to where the encoder puts images.

    CLIP's images and phrases lie in two separate clouds ("Mind the gap", Liang et al. 2022). Against the
    canonical phrases, which are text, every text vector is right or wrong by more than any image can be:
    relevancy saturates. What is shifted is the mean of `told`, onto the mean of `seen`; the differences
    between phrases, which are what a perfect embedding has, stay.
    """
    shift = np.concatenate([item.vectors for item in seen]).mean(0)
    shift = shift - np.concatenate([item.vectors for item in told]).mean(0)
    return [replace(item, vectors=unit(item.vectors + shift).astype(np.float32)) for item in told]


def surface_points(
    vertices: Array, triangles: Array, rng: np.random.Generator, *, count: int = 0, density: float = 0.0
) -> Array:
    """Return (P, 3) points spread evenly over triangles: `count` of them, or `density` on a square unit."""
    a, b, c = (vertices[triangles[:, corner]].astype(np.float64) for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    which = rng.choice(len(areas), count or int(density * areas.sum()), p=areas / areas.sum())
    u, v = rng.random((2, len(which), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a[which] + u * (b - a)[which] + v * (c - a)[which])


def phrase_vectors(truth: Truth, encoder: TextEncoder) -> dict[int, Array]:
    """The text vector of every id's own phrase, such as "handle of the red mug"; ids without one,
    or with words that the encoder was never taught, are left out."""
    names = {number: region.phrase for number, region in truth.regions.items()}
    texts = sorted({text for text in names.values() if text and not encoder.unknown_words(text)})
    known = dict(zip(texts, encoder.encode_texts(texts), strict=True))
    return {number: known[text] for number, text in names.items() if text in known}


def true_labels(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, Array]],
) -> Array:
    """(3, N) int64: the truth id that each Gaussian shows most of, ``argmax W^T onehot(ids)`` over all views.

    views: cameras with their (3, H, W) ids; -1 for Gaussians that none of them shows.
    """
    columns: list[Array] = []
    described = []
    for camera, ids in views:
        rows, numbers = _as_rows(ids)
        described.append((camera, ImageFeatures(rows, np.zeros((len(numbers), 1), np.float32))))
        columns.append(numbers)
    members = find_mask_weights(rasterizer, gaussians, described)
    known, group = np.unique(np.concatenate(columns), return_inverse=True)
    groups = MaskGroups(group, np.zeros((len(known), 1), np.float32))
    result = np.full((len(LEVELS), len(gaussians)), -1, np.int64)
    for number, (first, last) in enumerate(members.blocks):
        weights = members.block(number, groups)
        for level in range(len(LEVELS)):
            at_level = weights[:, level * len(known) : (level + 1) * len(known)].tocsr()
            if at_level.nnz:
                best = np.asarray(at_level.argmax(axis=1)).ravel()
                result[level, first:last] = np.where(np.diff(at_level.indptr) > 0, known[best], -1)
    return result


def _as_rows(ids: Array) -> tuple[Array, Array]:
    """Map (3, H, W) ids to the same as rows that count through the levels, and (M,) the id of each row."""
    rows = np.full(ids.shape, -1, np.int32)
    numbers: list[int] = []
    for level, truth in enumerate(ids):
        for number in np.unique(truth[truth >= 0]):
            rows[level][truth == number] = len(numbers)
            numbers.append(int(number))
    return rows, np.array(numbers, np.int64)


# Encoders that look at the truth in place of photographs.

VERSION = 3  # of both
DIM = 512
LASTING = 0.5  # share of the noise's variance that a region has in all views
MODIFIER = 0.8  # of "red" in "red mug", beside 1 for the head
OWNER = 0.5  # of its thing in the image of a part
LITTLE = frozenset({"of", "the", "a", "an", "on", "in", "with"})
# Of the variance of images: shares, and the principal axes that hold them. Of 500 photographs, ViT-B/32.
SPECTRUM = ((0.5, 21), (0.8, 86), (0.95, 193))


@dataclass(frozen=True, eq=False, kw_only=True)
class TruthEncoder(ABC):
    """What both have in common: an image-text encoder that looks at the truth in place of photographs."""

    found: float = LanguageField.found
    calibration: Calibration | None = None
    image_size: int = 8  # of images that nobody looks at
    temperature: float = LanguageField.temperature
    dim: int = DIM
    _kept: dict[str, Array] = field(default_factory=dict, init=False, repr=False)  # of regions, in all views

    @property
    @abstractmethod
    def id(self) -> str: ...  # by which it is asked for

    @property
    @abstractmethod
    def stated(self) -> tuple[str, Sequence[Path]]: ...  # settings and files that its vectors depend on

    @cached_property
    def digest(self) -> str:
        """Digest of everything that its vectors depend on."""
        settings, paths = self.stated
        contents = " ".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in paths)
        return hashlib.sha256(f"{VERSION} {settings} {contents}".encode()).hexdigest()[:12]

    @property
    @abstractmethod
    def names(self) -> Mapping[str, int]: ...  # row of every word that has a vector of its own

    @abstractmethod
    def word(self, word: str) -> Array: ...  # (D,) unit own direction

    @abstractmethod
    def text(self, key: str) -> Array: ...  # (D,) unit vector of a phrase

    @abstractmethod
    def image(self, truth: Truth, number: int, generator: np.random.Generator) -> Array:
        """Return the (D,) vector of what a region of the truth shows in one view."""

    @abstractmethod
    def mask_noise(self, generator: np.random.Generator, count: int) -> Array: ...  # (count, D), in one view

    def in_room(self, truth: Truth, seed: int) -> "TruthEncoder":
        return self

    def unknown_words(self, text: str) -> tuple[str, ...]:
        return ()

    def near_words(self, word: str) -> tuple[str, ...]:
        return ()

    def encode_images(self, crops: Array | Sequence[Array]) -> Array:
        """Return (M, D): all the same, until `describe` says what the masks show."""
        return np.tile(unit(np.ones(DIM, np.float32)), (len(crops), 1))

    def encode_texts(self, texts: Sequence[str]) -> Array:
        return np.array([self.text(phrase_key(text)) for text in texts], np.float32).reshape(-1, DIM)

    def describe(self, features: ImageFeatures, ids: Array, truth: Truth, view: int) -> ImageFeatures:
        """`features` with the vectors of what every mask's pixels truly show. ids: (3, H, W) truth."""
        generator = np.random.default_rng((view, 17))
        shown, pixels = np.zeros((len(features.vectors), DIM)), np.zeros((len(features.vectors), 1))
        for labels, numbers in zip(features.labels, ids, strict=True):
            for row, number, count in overlaps(labels, numbers):
                shown[row] += count * self.image(truth, number, generator)
                pixels[row] += count
        vectors = shown / np.maximum(pixels, 1) + self.mask_noise(generator, len(shown))
        return with_wrong_vectors(replace(features, vectors=unit(vectors).astype(np.float32)), view)

    def pieces(self, text: str) -> list[str]:
        """Return the words of a phrase: the longest with vectors of their own, else its single ones."""
        words, pieces = text.split(), list[str]()
        while words:
            ends = range(len(words), 1, -1)
            end = next((end for end in ends if " ".join(words[:end]) in self.names), 1)
            pieces.append(" ".join(words[:end]))
            words = words[end:]
        return [piece for piece in pieces if piece not in LITTLE]

    def direction(self, text: str) -> Array:
        """Return (D,) unit: what is a phrase's own. Its head counts most: the last word before "of"."""
        pieces = self.pieces(phrase_key(text)) or [text]
        before = self.pieces(phrase_key(text).split(" of ")[0])
        head = before[-1] if before else pieces[-1]
        rest = sum((MODIFIER * self.word(word) for word in pieces if word != head), np.zeros(DIM))
        return np.asarray(unit(self.word(head) + rest))


def noise(generator: np.random.Generator, count: int, axes: Array) -> Array:
    """(count, D) noise of about unit length with the spectrum of photographs along (A, D) unit `axes`."""
    variances = np.empty(len(axes))
    share, first = 0.0, 0
    for upto, last in (*SPECTRUM, (1.0, len(axes))):
        variances[first:last] = (upto - share) / (last - first)
        share, first = upto, last
    return np.asarray(generator.normal(size=(count, len(axes))) * np.sqrt(variances) @ axes)


def axes_beside(name: str, taken: Array) -> Array:
    """(A, D) orthonormal axes in an order by chance, always the same for a name, orthogonal to `taken`."""
    drawn = random(name).normal(size=(DIM, DIM))
    basis = np.linalg.qr(np.concatenate([taken, drawn]).T)[0].T
    return np.asarray(basis[len(taken) : DIM])


# The simulation.

PREFIX = "clip-geometry:"
PROMPTS = 0.565  # mean cosine of two prompts, ViT-B/16; 0.743 in ViT-B/32
OTHER = 0.182  # cosine of an image with words that are not true of it
OWN_SPREAD = 0.018  # of the cosine of images with their own words, standard deviation over regions
MEANS = 0.0152  # of images along the common direction of texts, standard deviation
SPANNED = 150  # principal axes of the words that the direction of images avoids: what it does not makes hubs
CLUSTERS, KINSHIP = 120, 0.55  # of words without a file: kinds, and the cosine of words of a kind


@dataclass(frozen=True, eq=False)
class ClipGeometry(TruthEncoder):
    own: float  # cosine of an image with the words that are true of it
    alike: float = 0.65  # cosine of images of different things
    # (V, 512) or (512, V) .npy of text vectors; names in a .txt beside it that begins alike
    vectors: Path | None = None
    prompts: float = PROMPTS

    def __post_init__(self) -> None:
        left = 1 - self.alike - OTHER**2 / self.prompts - self._strength**2
        if not (OTHER < self.own < 1 and left > 0 and self.alike > OTHER**2 / self.prompts):
            raise InputError(
                f"{self.id}: no vectors have these cosines; give an own cosine between {OTHER} and 0.45 and, "
                "behind a comma, a cosine between images from 0.1 to 0.85"
            )

    @property
    def id(self) -> str:
        return f"{PREFIX}{self.own:g},{self.alike:g}"

    @property
    def stated(self) -> tuple[str, Sequence[Path]]:
        return f"{self.id} {self.prompts}", [self.vectors] if self.vectors else []

    @property
    def names(self) -> Mapping[str, int]:
        return self._file[0]

    @property
    def _strength(self) -> float:
        """s: how strongly an image shows its words."""
        return (self.own - OTHER) / float(np.sqrt(1 - self.prompts))

    def text(self, key: str) -> Array:
        own = np.sqrt(1 - self.prompts) * self.direction(key)
        return np.asarray(unit(np.sqrt(self.prompts) * self._middle + own))

    def image(self, truth: Truth, number: int, generator: np.random.Generator) -> Array:
        """Return what all images have in common, what the region shows, and its lasting noise."""
        key = f"{number} {truth.folder.parent.parent.name}"  # another room, other noise
        if key not in self._kept:
            own = random(key)
            lasting = np.sqrt(LASTING) * self._noise_scale * noise(own, 1, self._axes)[0]
            lasting += MEANS * own.normal() * self._middle
            spread = own.normal() * OWN_SPREAD / (self.own - OTHER)
            self._kept[key] = self._base + lasting + (1 + spread) * self._shows(truth.regions.get(number))
        return self._kept[key]

    def mask_noise(self, generator: np.random.Generator, count: int) -> Array:
        return np.sqrt(1 - LASTING) * self._noise_scale * noise(generator, count, self._axes)

    def _shows(self, region: Region | None) -> Array:
        """Return (D,) of the region's words, so long that its plain phrase has the cosine `own`."""
        if region is None or not region.thing:
            return np.zeros(DIM)
        thing = self.direction(region.thing)
        if region.level != "whole" and region.word not in ("", region.thing):
            plain = self.direction(f"{region.thing} {region.word}")
            shown = self.direction(region.word) + OWNER * thing
        else:
            plain, shown = thing, thing + MODIFIER * self.direction(region.phrase)
        return np.asarray(self._strength * shown / (shown @ plain))

    @cached_property
    def _middle(self) -> Array:
        """m, the common direction of texts."""
        names, vectors = self._file
        return np.asarray(unit(vectors.mean(0)) if names else unit(drawn("middle")))

    @cached_property
    def _gap(self) -> Array:
        """g: orthogonal to where texts differ, as far as that has directions to spare."""
        words = self._own if len(self._own) else np.stack([self.word(f"word {i}") for i in range(600)])
        spread = np.linalg.svd(words - words.mean(0), full_matrices=False)[2][:SPANNED]
        gap = drawn("pictures")
        gap -= (gap @ self._middle) * self._middle
        return np.asarray(unit(gap - spread.T @ (spread @ gap)))

    @cached_property
    def _axes(self) -> Array:
        return axes_beside("noise", np.stack([self._middle, self._gap]))

    @cached_property
    def _base(self) -> Array:
        """What all images have in common."""
        common = OTHER / np.sqrt(self.prompts)
        return np.asarray(np.sqrt(self.alike - common**2) * self._gap + common * self._middle)

    @property
    def _noise_scale(self) -> float:
        return float(np.sqrt(1 - self.alike - self._strength**2))

    @cached_property
    def _own(self) -> Array:
        """The (V, D) unit directions of the file's words beside the middle."""
        vectors = self._file[1]
        return np.asarray(unit(vectors - (vectors @ self._middle)[:, None] * self._middle))

    @cached_property
    def _file(self) -> tuple[dict[str, int], Array]:
        return ({}, np.zeros((0, DIM))) if self.vectors is None else named_vectors(self.vectors)

    def word(self, word: str) -> Array:
        """Return (D,) unit: the file's own, else between two of its others by chance, always the same."""
        names, vectors = self._file
        singular = word.removesuffix("s")
        row = names.get(word, names.get(singular))
        if row is not None:
            return np.asarray(self._own[row])
        if names:
            return np.asarray(unit(self._own[random(singular).choice(len(vectors), 2, False)].sum(0)))
        kind = drawn(f"kind {number_of(singular) % CLUSTERS}")
        own = np.sqrt(KINSHIP) * kind + np.sqrt(1 - KINSHIP) * drawn(singular)
        return np.asarray(unit(own - (own @ self._middle) * self._middle))


def named_vectors(path: Path) -> tuple[dict[str, int], Array]:
    """Return the rows of names, from a .txt beside that begins alike, and (V, D) float64 unit vectors."""
    vectors = np.asarray(read_npy(path), np.float64)
    vectors = vectors.T if vectors.shape[0] == DIM else vectors
    beside = path.parent.glob("*.txt")
    named = [text for text in beside if path.stem.startswith(text.stem.removesuffix("_names"))]
    lines = named[0].read_text(encoding="utf-8").splitlines() if named else []
    names = [phrase_key(line.partition("_(")[0].replace("_", " ")) for line in lines]
    known = {name: row for row, name in reversed(list(enumerate(names[: len(vectors)]))) if name}
    return known or {f"word {row}": row for row in range(len(vectors))}, unit(vectors)


# Real vectors.

REAL = "real:"
POINTS = 4_000  # of a decoder's sphere: nearer to each other than `JITTER`
BEST = 0.01  # of the sphere: where a rule puts the image of a region
NOTHING = 0.3  # of the sphere, what is farthest from all names: where what has no name lies
HELD = 0.99  # of the set's variance lies in axes that what is lost avoids
LOST = 0.1  # of an image's squared length: what a decoder of three numbers loses
DOUBT = 0.9  # of which names are there, beside the evidence of the set
JITTER = 0.12  # radians along the sphere, from view to view
ADJECTIVES = 8  # with names of their own

# From the (P,) cosines of a region's own phrase at points of the set, and (P, W) of other names: how well a
# point suits it, the more the better.
Rule = Callable[[Array, Array, np.random.Generator], Array]


def by_softmax(own: Array, others: Array, generator: np.random.Generator) -> Array:
    """As often as a softmax over names at CLIP's temperature says the phrase there (Gumbel's trick)."""
    logits = 100 * np.concatenate([own[:, None], others], axis=1)
    chance = logits[:, 0] - np.logaddexp.reduce(logits, axis=1)
    return np.asarray(chance + generator.gumbel(size=len(own)))


RULES: Mapping[str, Rule] = {
    "cosine": lambda own, others, generator: own,  # whatever else is near
    # Fewest names nearer, in no order where these are equally many.
    "rank": lambda own, others, generator: generator.uniform(size=len(own)) - (others > own[:, None]).sum(1),
    "margin": lambda own, others, generator: own - others.max(1),
    "softmax": by_softmax,
}


@dataclass(frozen=True, eq=False)
class RealSpace(TruthEncoder):
    """Real text vectors, and image vectors drawn from what a real scene's decoder makes of its sphere."""

    path: Path  # a .pth, or a folder of them
    rule: str = ""  # of RULES, for all regions; "": one drawn for each
    rows: Mapping[str, int] = field(default_factory=dict)  # word of the room -> row of its name

    @property
    def id(self) -> str:
        return f"{REAL}{self.path}" + (f",{self.rule}" if self.rule else "")

    @property
    def stated(self) -> tuple[str, Sequence[Path]]:
        return self.rule, [*self._decoders, self._texts]

    @property
    def _decoders(self) -> list[Path]:
        return sorted(self.path.glob("*.pth")) if self.path.is_dir() else [self.path]

    @property
    def _texts(self) -> Path:
        folder = self.path if self.path.is_dir() else self.path.parent
        return next(iter(sorted(folder.glob("*text*.npy"))), folder / "text.npy")

    def check(self) -> None:
        files = [*(self._decoders or [self.path / "*.pth"]), self._texts]
        if self.rule not in ("", *RULES) or not all(path.is_file() for path in files):
            raise InputError(
                f"{self.id}: give a .pth of LangSplat's autoencoder, or a folder of some, with text vectors "
                f"(*text*.npy, names in a .txt) beside it and, behind a comma, one of {', '.join(RULES)}"
            )

    def in_room(self, truth: Truth, seed: int) -> "RealSpace":
        space = replace(self, path=self._decoders[seed % len(self._decoders)])
        return replace(space, rows=space.named(truth, np.random.default_rng((seed, 23))))

    def named(self, truth: Truth, generator: np.random.Generator) -> dict[str, int]:
        """Return the rows of names that words of a room stand for.

        A fifth of the names each goes to things, part words and things that are not there, all others to
        everyday phrases; things take those that are likeliest there, then parts. Words without a name are
        unknown, and regions of such lie far from all names.
        """
        lacks = [phrase for phrase in CANONICAL_PHRASES if phrase not in self._names]
        if lacks:
            raise InputError(f"{self._texts}: no vector of {', '.join(lacks)}; add the canonical phrases")
        names = self._by_evidence(generator)
        share = len(names) // 5
        regions = truth.regions.values()
        wholes = sorted({region.thing for region in regions if region.level == "whole" and region.thing})
        absent = sorted(word for word in EVERYTHING if truth.words.isdisjoint(object_words(word)))
        things, parts, others = names[:share], names[share : 2 * share], names[2 * share :]
        for some in (things, parts, others):
            generator.shuffle(some)
        rows = {phrase: self._names[phrase] for phrase in CANONICAL_PHRASES}
        rows |= zip(generator.permutation(wholes).tolist(), things, strict=False)
        rows |= zip(generator.permutation(absent).tolist(), others[:share], strict=False)
        lacking = sorted(PARTS - truth.words - {*EVERYTHING, *rows})
        rows |= zip(generator.permutation(lacking).tolist(), others[:share], strict=False)
        rows = _part_rows(truth, parts) | rows
        words = generator.permutation(bundled_vocabulary("adjectives")).tolist()[:ADJECTIVES]
        words += generator.permutation(bundled_vocabulary("nouns")).tolist()
        fresh = [word for word in words if word not in rows and word not in {*EVERYTHING, *PARTS}]
        return rows | dict(zip(fresh, others[share:], strict=False))

    def text(self, key: str) -> Array:
        """Return the (D,) unit vector of a phrase: a name's own; of several names, one between theirs.

        A further name takes it as far away from all images as names of two words are from those of one.
        """
        pieces = self.pieces(key)
        if len(pieces) < 2:
            return np.asarray(self._vectors[self.names[(pieces or [key])[0]]])
        own = self.direction(key) - (len(pieces) - 1) * self._farther * self._set_mean
        return np.asarray(unit(np.sqrt(1 - self._own_share) * self._middle + np.sqrt(self._own_share) * own))

    def image(self, truth: Truth, number: int, generator: np.random.Generator) -> Array:
        """Return what the decoder makes of the region's place, a little beside it, and what that loses."""
        key = f"{number} {truth.folder.parent.parent.name}"
        if key not in self._kept:
            own = random(f"{key} {self.digest}")
            lost = np.sqrt(LASTING) * noise(own, 1, self._axes)[0]
            self._kept[key] = np.concatenate([self._place(truth.regions.get(number), own), lost])
        place, lost = np.split(self._kept[key], [3])
        beside = unit(place + JITTER * generator.normal(size=3))
        decoded = unit(self._codec.decode(beside[None].astype(np.float32))[0].astype(np.float64))
        return np.asarray(np.sqrt(1 - LOST) * decoded + np.sqrt(LOST) * lost)

    def mask_noise(self, generator: np.random.Generator, count: int) -> Array:
        return np.sqrt(LOST * (1 - LASTING)) * noise(generator, count, self._axes)

    def unknown_words(self, text: str) -> tuple[str, ...]:
        return tuple(piece for piece in self.pieces(phrase_key(text)) if piece not in self.names)

    @property
    def names(self) -> Mapping[str, int]:
        return self.rows

    def word(self, word: str) -> Array:
        vector = self._vectors[self.names[word]]
        return np.asarray(unit(vector - (vector @ self._middle) * self._middle))

    def _place(self, region: Region | None, generator: np.random.Generator) -> Array:
        """Return (3,) unit: where on the set a region lies in all views."""
        points, said = self._points, self._said(region)
        if said:
            used = {self.names[piece] for text in said for piece in self.pieces(text)}
            others = self._cosines[:, [row for row in self._names.values() if row not in used]]
            own = np.mean([self._decoded @ self.text(text) for text in said], axis=0)
            rule = self.rule or generator.choice(list(RULES))
            suits = RULES[rule](own, others, generator)
        else:
            taken = self._centred[:, sorted(set(self.rows.values()))]
            suits = -taken.max(1)
        best = np.argsort(-suits)[: round((BEST if said else NOTHING) * len(points))]
        return np.asarray(points[generator.choice(best)])

    def _said(self, region: Region | None) -> list[str]:
        """Phrases of a region whose words have names: the plain one, and of a thing that with its colour."""
        if region is None or not region.thing:
            return []
        part = region.level != "whole" and region.word not in ("", region.thing)
        coloured = f"{region.colour} {region.thing}".strip()
        texts = [f"{region.thing} {region.word}"] if part else dict.fromkeys([region.thing, coloured])
        return [text for text in map(phrase_key, texts) if not self.unknown_words(text)]

    def _by_evidence(self, generator: np.random.Generator) -> list[int]:
        """Rows of names, those first that are likeliest there.

        By the rank of the best cosine on the set and that of the best one less the means of name and point,
        and by chance. By both ranks a name that LERF labels in teatime or ramen is ahead of another one in 89
        or 85 of 100 cases, as here with `DOUBT`; they lie as near to everything as others do, as these do.
        """
        rows = np.array([row for name, row in self._names.items() if name not in CANONICAL_PHRASES])
        best = [np.quantile(values[:, rows], 1 - BEST, axis=0) for values in (self._cosines, self._centred)]
        ranks = np.argsort(np.argsort(best, axis=1), axis=1).sum(0)
        doubt = DOUBT * ranks.std() * generator.normal(size=len(rows))
        return [int(row) for row in rows[np.argsort(-ranks - doubt, kind="stable")]]

    # Of the files; each is read once.

    @cached_property
    def _codec(self) -> AutoencoderCodec:
        return autoencoder_from(load_torch(self.path), self.path)

    @cached_property
    def _file(self) -> tuple[dict[str, int], Array]:
        return named_vectors(self._texts)

    @property
    def _names(self) -> dict[str, int]:
        return self._file[0]

    @property
    def _vectors(self) -> Array:
        return self._file[1]

    @cached_property
    def _points(self) -> Array:
        """(P, 3) spread evenly over the sphere of latents, along a spiral."""
        rows = np.arange(POINTS) + 0.5
        height, turn = 1 - 2 * rows / POINTS, np.pi * (1 + np.sqrt(5)) * rows
        across = np.sqrt(1 - height**2)
        return np.stack([np.cos(turn) * across, np.sin(turn) * across, height], axis=1)

    @cached_property
    def _decoded(self) -> Array:
        return np.asarray(unit(self._codec.decode(self._points.astype(np.float32)).astype(np.float64)))

    @cached_property
    def _cosines(self) -> Array:
        """The (P, V) of the set with all names."""
        return np.asarray(self._decoded @ self._vectors.T)

    @cached_property
    def _centred(self) -> Array:
        """The (P, V) cosines less the mean of the name, and of the point."""
        own = self._cosines - self._cosines.mean(0)
        return np.asarray(own - own.mean(1, keepdims=True))

    @cached_property
    def _set_mean(self) -> Array:
        return np.asarray(self._decoded.mean(0))

    @cached_property
    def _axes(self) -> Array:
        """Axes of what is lost: orthogonal to the mean and the principal axes of the set."""
        _, sizes, axes = np.linalg.svd(self._decoded - self._set_mean, full_matrices=False)
        count = int(np.searchsorted(np.cumsum(sizes**2) / (sizes**2).sum(), HELD)) + 1
        return axes_beside("lost", np.concatenate([axes[:count], self._set_mean[None]]))

    @cached_property
    def _middle(self) -> Array:
        return np.asarray(unit(self._vectors.mean(0)))

    @cached_property
    def _own_share(self) -> float:
        """Share of a text vector's squared length that is its own."""
        return float(1 - np.mean((self._vectors @ self._middle) ** 2))

    @cached_property
    def _farther(self) -> float:
        """By how much a name of two words lies farther from the set than one of one, along its mean."""
        means, lengths = self._cosines.mean(0), np.full(len(self._vectors), 1)
        for name, row in self._names.items():
            lengths[row] = len(name.split())
        drop = means[lengths == 1].mean() - means[lengths == 2].mean() if (lengths == 2).any() else 0.0
        return float(drop / (np.sqrt(self._own_share) * (self._set_mean @ self._set_mean)))


def _part_rows(truth: Truth, rows: Sequence[int]) -> dict[str, int]:
    """Names of part words: the least used, but parts of one thing have different ones; some have none."""
    words: dict[str, set[str]] = {}
    for region in truth.regions.values():
        if region.is_part:
            words.setdefault(region.thing, set()).add(region.word)
    found: dict[str, int] = {}
    for own in words.values():
        for word in sorted(own - set(found)):
            beside = {found.get(other) for others in words.values() if word in others for other in others}
            free = [row for row in rows if row not in beside]
            if free:
                found[word] = min(free, key=list(found.values()).count)
    return found


# What both are asked for by, and how chance is drawn.


def read_truth_encoder(text: str, vectors: Path | None = None) -> TruthEncoder | None:
    """The encoder that "clip-geometry:OWN[,ALIKE]" or "real:PATH[,RULE]" names; None for other names.

    Raises InputError where what follows is no such thing.
    """
    if text.startswith(REAL):
        path, _, rule = text.removeprefix(REAL).partition(",")
        space = RealSpace(Path(path), rule)
        space.check()
        return space
    if not text.startswith(PREFIX):
        return None
    try:
        numbers = [float(number) for number in text.removeprefix(PREFIX).split(",")]
        own, alike = [*numbers, ClipGeometry.alike][:2]
    except ValueError:
        wanted = f"the cosine of an image with its own words, as in {PREFIX}0.27"
        raise InputError(f"{text}: write {wanted}") from None
    return ClipGeometry(own, alike, vectors)


def number_of(text: str) -> int:
    """Number of 64 bits that is always the same for a text."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def random(text: str) -> np.random.Generator:
    """Generator that is always the same for a text."""
    return np.random.default_rng(number_of(text))


def drawn(text: str) -> Array:
    """Return (D,) unit, always the same for a text."""
    return np.asarray(unit(random(text).normal(size=DIM)))

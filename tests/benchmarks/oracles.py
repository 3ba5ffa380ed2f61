"""Stages that make no mistake, or known ones, from a procedural room's ground truth.

`ClipGeometry` is an encoder with the geometry of real CLIP, the standing second test bed. The bundled encoder
tells what is there from what is not by margins of 0.2; CLIP's are 0.05 to 0.11, its texts lie close together,
and its images lie on the other side of a gap. Here a text vector is the common direction of all prompts and
what is the word's own, of real CLIP vectors where a file has them; an image's vector is made of what its
pixels truly show:

    v  =  a g  +  c m  +  s r  +  noise of the region, in all views  +  noise of the mask, in this view

with g the direction of images, orthogonal to all texts (Liang et al. 2022, "Mind the gap"), m the common
direction of texts and r the own direction of the words that are true. a, c, s follow from three cosines: of a
image with its own words (`own`), with other words (`OTHER`), and of two images of different things
(`alike`). One mask in seven shows another region. What is a guess: that noise is one part text-like, how the
words of a phrase and a part with its thing mix (`MODIFIER`, `OWNER`); `own` and `alike` are to be varied.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from pathlib import Path

import numpy as np

from assets.making.dataset import Region, Truth
from langsplat_core.arrays import Array, unit
from langsplat_core.errors import InputError
from langsplat_core.io.hostile import read_npy
from langsplat_core.query.engine import TextEncoder
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import LEVELS, Calibration, Camera, Gaussians, LanguageField
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.features import ImageFeatures
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
        for row, number, _ in sorted(_overlaps(labels, truth), key=itemgetter(2)):  # the largest comes last
            told[row] = vectors.get(number, features.vectors[row])
    return replace(features, vectors=told)


def _overlaps(labels: Array, truth: Array) -> list[tuple[int, int, int]]:
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
    """(P, 3) points spread evenly over triangles: `count` of them, or `density` on a square unit."""
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
    edges = np.cumsum([len(numbers) for numbers in columns])[:-1]
    groups = MaskGroups(tuple(np.split(group.astype(np.int32), edges)), np.zeros((len(known), 1), np.float32))
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
    """(3, H, W) ids -> the same as rows that count through the levels, and (M,) the id of each row."""
    rows = np.full(ids.shape, -1, np.int32)
    numbers: list[int] = []
    for level, truth in enumerate(ids):
        for number in np.unique(truth[truth >= 0]):
            rows[level][truth == number] = len(numbers)
            numbers.append(int(number))
    return rows, np.array(numbers, np.int64)


PREFIX = "clip-geometry:"
VERSION = 2  # of the simulation
DIM = 512
PROMPTS = 0.565  # mean cosine of two prompts, ViT-B/16
OTHER = 0.19  # cosine of an image with words that are not true of it
TEXT_LIKE = 0.3  # share of the noise's variance that lies where words differ
LASTING = 0.5  # share of the noise's variance that a region has in all views
MODIFIER = 0.8  # of "red" in "red mug", beside 1 for the head: their cosine is then 0.9
OWNER = 0.5  # of its thing in the image of a part
CLUSTERS, KINSHIP = 120, 0.55  # of words without a file: kinds, and the cosine of words of a kind
HUB = 0.02  # by how much a prompt lies nearer to all images than another does, standard deviation
LITTLE = frozenset({"of", "the", "a", "an", "on", "in", "with"})


@dataclass(frozen=True, eq=False)
class ClipGeometry:
    """A simulated image-text encoder; its images are described from the truth (`describe`)."""

    own: float  # cosine of an image with the words that are true of it
    alike: float = 0.65  # cosine of images of different things
    # (V, 512) or (512, V) .npy of text vectors; names in a .txt beside it that begins alike
    vectors: Path | None = None
    found: float = LanguageField.found
    calibration: Calibration | None = None
    image_size: int = 8  # of images that nobody looks at
    _contents: dict[str, Array] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        noise = 1 - self.alike - OTHER**2 / PROMPTS - self._strength**2
        if not (OTHER < self.own < 1 and noise > 0 and self.alike > OTHER**2 / PROMPTS):
            raise InputError(
                f"{self.id}: no vectors have these cosines; give an own cosine between {OTHER} and 0.45 and, "
                "behind a comma, a cosine between images from 0.1 to 0.85"
            )

    @property
    def id(self) -> str:
        """Name by which it is asked for."""
        return f"{PREFIX}{self.own:g},{self.alike:g}"

    @property
    def digest(self) -> str:
        """Digest of everything that its vectors depend on."""
        texts = self.vectors.read_bytes() if self.vectors else b""
        stated = f"{VERSION} {self.id} {hashlib.sha256(texts).hexdigest()}"
        return hashlib.sha256(stated.encode()).hexdigest()[:12]

    @property
    def dim(self) -> int:
        """Length of the vectors."""
        return DIM

    @property
    def temperature(self) -> float:
        """Temperature of relevancy, CLIP's."""
        return LanguageField.temperature

    @property
    def _strength(self) -> float:
        """s: how strongly an image shows its words."""
        return (self.own - OTHER) / float(np.sqrt(1 - PROMPTS))

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Return no words, since CLIP reads everything."""
        return ()

    def near_words(self, word: str) -> tuple[str, ...]:
        """Return no words, since none is unknown."""
        return ()

    def encode_images(self, crops: Array | Sequence[Array]) -> Array:
        """(M, D): all the same, until `describe` says what the masks show."""
        return np.tile(self._gap.astype(np.float32), (len(crops), 1))

    def encode_texts(self, texts: Sequence[str]) -> Array:
        """(M, D) float32 unit vectors."""
        own = np.array([self.direction(text) for text in texts]).reshape(-1, DIM)
        hubs = np.array([[HUB * _random(text).normal()] for text in texts]).reshape(-1, 1)
        rows = np.sqrt(PROMPTS) * self._middle + np.sqrt(1 - PROMPTS) * own + hubs * self._gap
        return unit(rows).astype(np.float32)

    def direction(self, text: str) -> Array:
        """(D,) unit: what is a phrase's own. Its head counts most: the last word before "of"."""
        key = phrase_key(text)
        words = [word for word in key.split() if word not in LITTLE]
        if key in self._file[0] or len(words) < 2:
            return self._word(key)
        before = [word for word in key.split(" of ")[0].split() if word not in LITTLE]
        head = before[-1] if before else words[-1]
        rest = sum((MODIFIER * self._word(word) for word in words if word != head), np.zeros(DIM))
        return np.asarray(unit(self._word(head) + rest))

    def describe(self, features: ImageFeatures, ids: Array, truth: Truth, view: int) -> ImageFeatures:
        """`features` with the vectors of what every mask's pixels truly show. ids: (3, H, W) truth."""
        generator = np.random.default_rng((view, 17))
        shown = np.zeros((len(features.vectors), DIM))
        for labels, numbers in zip(features.labels, ids, strict=True):
            for row, number, count in _overlaps(labels, numbers):
                shown[row] += count * self._content(truth, number)
        areas = np.array([(features.labels == row).sum() for row in range(len(shown))])
        shown /= np.maximum(areas, 1)[:, None]
        level = np.sqrt(1 - LASTING) * self._noise_scale
        own = np.stack([self._noise(generator) for _ in shown]) if len(shown) else shown
        vectors = unit(self._base + shown + level * own).astype(np.float32)
        return with_wrong_vectors(replace(features, vectors=vectors), view)

    def _content(self, truth: Truth, number: int) -> Array:
        """(D,) what a region of the truth adds to an image of it, its lasting noise included."""
        key = f"{number} {truth.folder.parent.parent.name}"  # another room, other noise
        if key not in self._contents:
            noise = np.sqrt(LASTING) * self._noise_scale * self._noise(_random(key))
            self._contents[key] = noise + self._shows(truth.regions.get(number))
        return self._contents[key]

    def _shows(self, region: Region | None) -> Array:
        """(D,) of the region's words, so long that its plain phrase has the cosine `own`."""
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
        return np.asarray(unit(vectors.mean(0)) if names else unit(_drawn("middle")))

    @cached_property
    def _gap(self) -> Array:
        """g: orthogonal to the space where texts differ, as far as that has directions to spare."""
        drawn = _drawn("pictures")
        drawn -= (drawn @ self._middle) * self._middle
        return np.asarray(unit(drawn - self._spread.T @ (self._spread @ drawn)))

    @cached_property
    def _base(self) -> Array:
        """What all images have in common."""
        common = OTHER / np.sqrt(PROMPTS)
        return np.asarray(np.sqrt(self.alike - common**2) * self._gap + common * self._middle)

    @property
    def _noise_scale(self) -> float:
        return float(np.sqrt(1 - self.alike - self._strength**2))

    def _noise(self, generator: np.random.Generator) -> Array:
        """(D,) of about unit length: everywhere, and where words differ."""
        like = unit(generator.normal(size=len(self._spread)) @ self._spread)
        anywhere = unit(generator.normal(size=DIM))
        return np.asarray(np.sqrt(TEXT_LIKE) * like + np.sqrt(1 - TEXT_LIKE) * anywhere)

    @cached_property
    def _spread(self) -> Array:
        """(R, D) orthonormal directions in which words differ most."""
        words = self._own if len(self._own) else np.stack([self._word(f"word {i}") for i in range(600)])
        return np.asarray(np.linalg.svd(words - words.mean(0), full_matrices=False)[2][:100])

    @cached_property
    def _own(self) -> Array:
        """(V, D) unit directions of the file's words beside the middle."""
        vectors = self._file[1]
        return np.asarray(unit(vectors - (vectors @ self._middle)[:, None] * self._middle))

    @cached_property
    def _file(self) -> tuple[dict[str, int], Array]:
        """Names and (V, D) float64 unit vectors."""
        if self.vectors is None:
            return {}, np.zeros((0, DIM))
        vectors = np.asarray(read_npy(self.vectors), np.float64)
        vectors = vectors.T if vectors.shape[0] == DIM else vectors
        beside = self.vectors.parent.glob("*.txt")
        named = [path for path in beside if self.vectors.stem.startswith(path.stem.removesuffix("_names"))]
        lines = named[0].read_text(encoding="utf-8").splitlines() if named else []
        names = [phrase_key(line.partition("_(")[0].replace("_", " ")) for line in lines]
        known = {name: row for row, name in reversed(list(enumerate(names[: len(vectors)]))) if name}
        return known or {f"word {row}": row for row in range(len(vectors))}, unit(vectors)

    def _word(self, word: str) -> Array:
        """(D,) unit: the file's own, else between two of its others by chance, always the same."""
        names, vectors = self._file
        singular = word.removesuffix("s")
        row = names.get(word, names.get(singular))
        if row is not None:
            return np.asarray(self._own[row])
        if names:
            return np.asarray(unit(self._own[_random(singular).choice(len(vectors), 2, False)].sum(0)))
        kind = _drawn(f"kind {_seed(singular) % CLUSTERS}")
        drawn = np.sqrt(KINSHIP) * kind + np.sqrt(1 - KINSHIP) * _drawn(singular)
        return np.asarray(unit(drawn - (drawn @ self._middle) * self._middle))


def read_geometry(text: str, vectors: Path | None = None) -> ClipGeometry | None:
    """The encoder that "clip-geometry:OWN" or "clip-geometry:OWN,ALIKE" names; None for other names.

    Raises InputError where what follows is no such cosines.
    """
    if not text.startswith(PREFIX):
        return None
    try:
        numbers = [float(number) for number in text.removeprefix(PREFIX).split(",")]
        own, alike = [*numbers, 0.65][:2]
    except ValueError:
        wanted = f"the cosine of an image with its own words, as in {PREFIX}0.31"
        raise InputError(f"{text}: write {wanted}") from None
    return ClipGeometry(own, alike, vectors)


def _seed(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def _drawn(text: str) -> Array:
    """(D,) unit, always the same for a text."""
    return np.asarray(unit(_random(text).normal(size=DIM)))


def _random(text: str) -> np.random.Generator:
    return np.random.default_rng(_seed(text))

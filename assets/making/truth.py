"""The truth beside a room's photographs: its regions, the phrases that are right for them, and its masks."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from assets.making.vocabulary import object_words
from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress
from langsplat_core.semantics.masks import LevelMasks, MaskSource

PHRASE_KINDS = ("object", "colour+object", "part", "subpart")  # of phrases, in the order of tables
MIN_REGION = 16  # px: of a smaller region not even an oracle's crop shows anything


@dataclass(frozen=True)
class Region:
    """One region as in `truth/labels.json`; empty words where none fits."""

    level: str  # one of LEVELS
    word: str  # its own: the object's at level whole, else the part's
    thing: str  # the word of the object it belongs to
    colour: str = ""
    phrase: str = ""  # the one that says most about it
    words: tuple[str, ...] = ()  # every phrase that is right for it

    @property
    def is_part(self) -> bool:
        """True for a part with a word of its own."""
        return self.level != "whole" and self.word not in ("", self.thing, "body")


@dataclass(frozen=True)
class Phrase:
    """A phrase and what it is true for."""

    text: str
    kind: str  # one of PHRASE_KINDS
    ids: tuple[int, ...]  # truth ids, of any level


@dataclass(frozen=True, eq=False)
class Truth:
    """Everything known about the photographs of a room."""

    folder: Path
    phrases: tuple[Phrase, ...]
    regions: Mapping[int, Region] = field(default_factory=dict)  # by truth id

    @cached_property
    def words(self) -> frozenset[str]:
        """Every phrase that is right for anything in the room."""
        return frozenset(word for region in self.regions.values() for word in region.words)

    def labels(self, name: str) -> Array:
        """(3, H, W) ids of the photograph with this stem, -1 where nothing is."""
        with np.load(self.folder / f"{name}.npz", allow_pickle=False) as stored:
            return np.asarray(stored["ids"]).astype(np.int64)

    def absent(self, things: Iterable[str]) -> list[str]:
        """Words of `things` by which, or by whose synonyms, nothing in the room may be called."""
        return sorted(thing for thing in things if self.words.isdisjoint(object_words(thing)))


def read_truth(dataset: Path) -> Truth:
    """Return the truth beside the photographs; InputError where there is none."""
    folder = dataset / "truth"
    if not (folder / "labels.json").is_file():
        raise InputError(
            f"{dataset}: no truth/labels.json; make one with `python -m assets.making dataset --out DIR`"
        )
    stated = json.loads((folder / "labels.json").read_text(encoding="utf-8"))
    names = {entry.name for entry in fields(Region)}
    regions = {
        int(key): Region(**{n: v for n, v in item.items() if n in names} | {"words": tuple(item["words"])})
        for key, item in stated.items()
    }
    phrases: dict[str, Phrase] = {}
    for region in regions.values():
        for text, kind in _asked(region):
            ids = tuple(key for key, other in regions.items() if text in other.words)
            # A part without finer regions is its own subpart: the coarsest level gives a phrase its kind.
            if text not in phrases or PHRASE_KINDS.index(kind) < PHRASE_KINDS.index(phrases[text].kind):
                phrases[text] = Phrase(text, kind, ids)
    return Truth(folder, tuple(phrases.values()), regions)


def _asked(region: Region) -> Iterator[tuple[str, str]]:
    """Return the phrases that are asked about one region: (text, kind)."""
    if region.level == "whole" and region.thing:
        yield region.thing, "object"
        if region.colour:
            yield f"{region.colour} {region.thing}", "colour+object"
    elif region.is_part:
        yield f"{region.thing} {region.word}", region.level


class TruthMasks(MaskSource):
    """A `MaskSource` that gives the regions of the truth, at its three levels.

    A photograph is recognised by its content, since a mask source is given nothing else.
    """

    name = "truth"
    key = json.dumps(["truth", 1, MIN_REGION])

    def __init__(self, capture: Capture, truth: Truth) -> None:
        self._truth = truth
        pairs = zip(capture.images, capture.cameras, strict=True)
        self._names = {_digest(image): camera.name for image, camera in pairs}

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8 of the capture; InputError for any other."""
        name = self._names.get(_digest(image))
        if name is None:
            raise InputError(f"{self._truth.folder}: has no truth for this photograph; render the room again")
        stacks = []
        for ids in self._truth.labels(name):
            found, pixels = np.unique(ids[ids >= 0], return_counts=True)
            stacks.append(ids == found[pixels >= MIN_REGION][:, None, None])
        progress("reading the truth", 1.0)
        subpart, part, whole = (np.ones(len(stack), np.float32) for stack in stacks)
        return LevelMasks((stacks[0], stacks[1], stacks[2]), (subpart, part, whole))


def _digest(image: Array) -> str:
    return hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()

"""What is known about a procedural room: its regions, and the phrases that are right for them."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.lab.world.captions import object_words

KINDS = ("object", "colour+object", "part", "subpart")  # of phrases, in the order of tables


@dataclass(frozen=True)
class Region:
    """What `truth/labels.json` says about one region; empty words where none fits."""

    level: str  # one of LEVELS
    word: str  # its own: the object's at level whole, else the part's
    thing: str  # the word of the object it belongs to
    colour: str = ""
    phrase: str = ""  # the one that says most about it
    words: tuple[str, ...] = ()  # every phrase that is right for it

    @property
    def is_part(self) -> bool:
        """Whether it is a part with a word of its own."""
        return self.level != "whole" and self.word not in ("", self.thing, "body")


@dataclass(frozen=True)
class Phrase:
    """A phrase and what it is true for."""

    text: str
    kind: str  # one of KINDS
    ids: tuple[int, ...]  # truth ids, of any level


@dataclass(frozen=True, eq=False)
class Truth:
    """What `langsplat demo dataset` knows about its photographs."""

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
        """Those of `things` that nothing in the room may be called by, nor by a synonym of theirs."""
        return sorted(thing for thing in things if self.words.isdisjoint(object_words(thing)))


def read_truth(dataset: Path) -> Truth:
    """The truth beside the photographs; InputError where there is none."""
    folder = dataset / "truth"
    if not (folder / "labels.json").is_file():
        raise InputError(f"{dataset}: no truth/labels.json; make one with `langsplat demo dataset --out DIR`")
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
            if text not in phrases or KINDS.index(kind) < KINDS.index(phrases[text].kind):
                phrases[text] = Phrase(text, kind, ids)
    return Truth(folder, tuple(phrases.values()), regions)


def _asked(region: Region) -> Iterator[tuple[str, str]]:
    """The phrases that are asked about one region: (text, kind)."""
    if region.level == "whole" and region.thing:
        yield region.thing, "object"
        if region.colour:
            yield f"{region.colour} {region.thing}", "colour+object"
    elif region.is_part:
        yield f"{region.thing} {region.word}", region.level

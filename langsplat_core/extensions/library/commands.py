"""`langsplat find`: a phrase in every scene of a folder; `langsplat changes`: two scenes of one place."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from langsplat_core.arrays import length_text
from langsplat_core.cli.arguments import EncoderOption, JsonOption, TrainedScene
from langsplat_core.cli.query import Unit, in_world, once
from langsplat_core.cli.run import print_json
from langsplat_core.config import CountOrZero, Positive
from langsplat_core.errors import EncoderError, InputError, report_loss
from langsplat_core.extensions.geometry.commands import read_transform, registered
from langsplat_core.extensions.library.changes import Change, changes
from langsplat_core.extensions.library.index import Answers, Hit, Library, find, update_library
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine, searchable
from langsplat_core.scene import LEVELS
from langsplat_core.scene.language import split_phrases
from langsplat_core.scene.transform import between_worlds
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class Find:
    """Find phrases in all scenes of a folder: the most certain answers first, with scene, place and box.

    An index of the scenes is kept in the folder and updated by each call; the first call reads all scenes.
    """

    words: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TEXT... FOLDER")]
    """Phrases, each in quotes if it has several words, then a folder; its subfolders are searched too."""
    top: CountOrZero = 20
    """Scenes of each encoder that are opened for exact answers; 0: answers from the index alone."""
    all: bool = False
    """Also list the scenes without it."""
    encoder: EncoderOption = ""
    json: JsonOption = False

    def run(self) -> None:
        if len(self.words) < 2 or not self.words[-1]:
            raise InputError("give phrases and a folder; for example: langsplat find 'blue gift' scans")
        phrases = [phrase for text in self.words[:-1] for phrase in split_phrases(text) or [text]]
        load = once(load_text_encoder, self.encoder)
        with TerminalProgress() as progress:
            library = update_library(Path(self.words[-1]), load, progress)
            answers = [each for phrase in phrases for each in find(library, phrase, load, self.top, progress)]
        if all(each.problem for each in answers):
            raise InputError("; ".join(dict.fromkeys(each.problem for each in answers)))
        listed = [
            (each, [hit for hit in each.hits if self.all or hit.verdict != "not here"]) for each in answers
        ]
        if self.json:
            print_json([_fields(each, hits, library) for each, hits in listed])
            return
        for each, hits in listed:
            print(_heading(each))
            for hit in hits:
                print(f"  {_name(hit, library)}: {_said(hit)}")
            for name, reason in each.unread:
                print(f"  {name}: not asked: {reason}")
        for scene in library.unread:
            print(f"langsplat: not searched: {scene.path}: {scene.unread}", file=sys.stderr)


def _said(hit: Hit) -> str:
    place = "place not looked for" if hit.answer is None else "place -"
    if hit.answer is not None and hit.answer.place is not None:
        unit = Unit(hit.metres_per_unit, hit.origin)
        place = f"place {unit.place(hit.answer.place)} {unit.name}"
    return f"{hit.said}, {place}"


def _name(hit: Hit, library: Library) -> str:
    return hit.path.relative_to(library.folder).as_posix()


def _heading(answered: Answers) -> str:
    said = answered.problem or f"found in {answered.count('found')} of {len(answered.hits)} scenes"
    if weak := answered.count("weak match"):
        said += f", a weak match in {weak}"
    return f"{answered.phrase} ({answered.encoder_id}): {said}"


def _fields(answered: Answers, hits: Sequence[Hit], library: Library) -> dict[str, Any]:
    return {
        "phrase": answered.phrase,
        "encoder": answered.encoder_id,
        "problem": answered.problem or None,
        "found": answered.count("found"),
        "weak": answered.count("weak match"),
        "not_here": answered.count("not here"),
        "unread": [list(pair) for pair in answered.unread],
        "scenes": [_hit_fields(hit, library) for hit in hits],
    }


def _hit_fields(hit: Hit, library: Library) -> dict[str, Any]:
    own = ("verdict", "probability", "margin", "metres_per_unit")
    answer = hit.answer
    fields = {
        "scene": _name(hit, library),
        **{name: getattr(hit, name) for name in own},
        "by_chance": hit.judgement.by_chance,
        "exact": answer is not None,
        "level": None if answer is None else LEVELS[answer.level],
        "place": None if answer is None else answer.place,
        "box": None if answer is None else answer.box,
    }
    return {**in_world(fields, hit.origin)}


STATED = ("kind", "name", "centre", "box", "moved", "distance", "colours", "share")  # of a change, in JSON


@dataclass(frozen=True)
class Changes:
    """List changes between two scenes of one place: what appeared, is gone, moved, or has another colour.

    Positions are in the first scene's frame.
    """

    before: TrainedScene
    after: tyro.conf.Positional[Path]
    """Another scene of the same place."""
    transform: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Transform of the second to the axes of the first, .json of `langsplat register`; by default both have
    the same axes, in the units that they state."""
    register: bool = False
    """Find the transform from the surfaces of both."""
    encoder: EncoderOption = ""
    scale: Positive | None = None
    """Metres per world unit of the first scene, in place of its own."""
    json: JsonOption = False

    def run(self) -> None:
        if self.register and self.transform is not None:
            raise InputError("--register finds what --transform gives; leave one of them out")
        told = None if self.transform is None else read_transform(self.transform)
        scenes = searchable(self.before), searchable(self.after)
        origin = scenes[0].origin
        placed = None if told is None else between_worlds(told, -scenes[1].origin, -origin).matrix
        unit = Unit(self.scale or scenes[0].metres_per_unit, origin)
        unsure = None in [scene.metres_per_unit for scene in scenes]
        first, second = (QueryEngine(scene, load_text_encoder, encoder_id=self.encoder) for scene in scenes)
        with TerminalProgress() as progress:
            describers = None
            try:
                describers = Describer(first, progress=progress), Describer(second, progress=progress)
            except EncoderError as error:
                report_loss("without names: %s", error)
            if self.register:
                placed = registered(scenes[1], scenes[0], scaled=unsure, progress=progress).transform.matrix
            found = changes(first, second, placed, describers, progress)
        if self.json:
            listed = [{name: getattr(change, name) for name in STATED} for change in found]
            print_json({"metres_per_unit": unit.metres, "changes": in_world(listed, origin)})
            return
        print("\n".join(_in_words(change, unit) for change in found) or "nothing changed")


def _in_words(change: Change, unit: Unit) -> str:
    name = change.name or "something"
    at = f"{unit.place(change.centre)} {unit.name}"
    if change.kind == "moved":
        assert change.moved is not None
        by = f"{length_text(unit.length * change.distance, least=2)} {unit.name}, {unit.format(change.moved)}"
        return f"moved: {name} by {by}, now at {at}"
    if change.colours is not None:
        before, now = change.colours
        said = f"{before} to {now}" if before != now else f"another {now}"
        return f"changed colour: {name} at {at}, {said}"
    return f"{change.kind}: {name} at {at}"

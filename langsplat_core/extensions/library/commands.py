"""`langsplat find`: a phrase in every scene of a folder; `langsplat changes`: two scenes of one place."""

import html
import sys
from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

import tyro
from PIL import Image, ImageDraw, ImageFont

from langsplat_core.cli.answers import Unit, unit_of
from langsplat_core.cli.arguments import EncoderOption, JsonOption, OutFile, TrainedScene
from langsplat_core.cli.query import once
from langsplat_core.cli.run import print_json
from langsplat_core.config import CountOrZero, Positive
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.extensions.geometry.commands import read_transform, registered
from langsplat_core.extensions.library.changes import Change, changes
from langsplat_core.extensions.library.finding import PICTURE, Answered, Hit, find
from langsplat_core.extensions.library.index import Library, update_library
from langsplat_core.io.files import atomic_path
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine, searchable
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import LEVELS
from langsplat_core.scene.language import split_phrases
from langsplat_core.semantics.encoders import load_text_encoder

COLUMNS, CAPTION, GAP = 4, 44, 8  # of a sheet: pictures in a row; pixels below one, and between them


@dataclass(frozen=True)
class Find:
    """Find phrases in all scenes of a folder: the most certain answers first, with scene, place and box.

    An index of what the scenes mean is kept in the folder and brought up to date; the first call reads all.
    """

    words: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TEXT... FOLDER")]
    """Phrases, each in quotes if it has several words, and last the folder; scenes in its folders count."""
    top: CountOrZero = 20
    """Scenes that are opened and answered exactly, of each encoder; 0: what the index says alone."""
    all: bool = False
    """List also the scenes where it was not found."""
    sheet: OutFile | None = None
    """Write pictures of the answers here, *.html or *.png."""
    index: OutFile | None = None
    """File of the index (default: .langsplat-library in the folder)."""
    rebuild: bool = False
    """Read every scene again, whatever the index says."""
    encoder: EncoderOption = ""
    json: JsonOption = False

    def run(self) -> None:
        if len(self.words) < 2:
            raise InputError("give phrases and a folder; for example: langsplat find 'red mug' scans")
        if self.sheet is not None and self.sheet.suffix.lower() not in (".html", ".png"):
            raise InputError(f"--sheet {self.sheet}: name an .html or a .png file")
        phrases = [phrase for text in self.words[:-1] for phrase in split_phrases(text) or [text]]
        load = once(load_text_encoder, self.encoder)
        with TerminalProgress() as progress:
            library = update_library(Path(self.words[-1]), self.index, load, progress, self.rebuild)
            answers = [each for phrase in phrases for each in find(library, phrase, load, self.top, progress)]
        if all(each.problem for each in answers):
            raise InputError("; ".join(dict.fromkeys(each.problem for each in answers)))
        listed = [(each, self._listed(each)) for each in answers]
        if self.sheet is not None:
            _write_sheet(self.sheet, listed, library)
        if self.json:
            print_json([_fields(each, hits, library) for each, hits in listed])
            return
        for each, hits in listed:
            print("\n".join(_lines(each, hits, library)))
        for scene in library.unread:
            print(f"langsplat: not searched: {scene.path}: {scene.unread}", file=sys.stderr)

    def _listed(self, answered: Answered) -> list[Hit]:
        return [hit for hit in answered.hits if self.all or hit.verdict != "not here"]


def _said(hit: Hit) -> str:
    sure = "" if hit.probability is None else f" ({100 * hit.probability:.0f} %)"
    return f"{hit.verdict}{sure}"


def _place(hit: Hit) -> str:
    if hit.answer is None or hit.answer.place is None:
        return "place not looked for" if hit.answer is None else "place -"
    unit = unit_of(hit)
    return f"place {unit.format(hit.answer.place)} {unit.name}"


def _name(hit: Hit, library: Library) -> str:
    return hit.path.relative_to(library.folder).as_posix()


def _heading(answered: Answered) -> str:
    counts = f"found in {answered.count('found')} of {len(answered.hits)} scenes"
    weak = answered.count("weak match")
    return f"{answered.phrase} ({answered.encoder_id}): " + (
        answered.problem or counts + (f", a weak match in {weak}" if weak else "")
    )


def _lines(answered: Answered, hits: Sequence[Hit], library: Library) -> Iterator[str]:
    yield _heading(answered)
    for hit in hits:
        yield f"  {_name(hit, library)}: {_said(hit)}, {_place(hit)}"
    for name, reason in answered.unread:
        yield f"  {name}: not asked: {reason}"


def _fields(answered: Answered, hits: Sequence[Hit], library: Library) -> dict[str, Any]:
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
    answer = hit.answer
    return {
        "scene": _name(hit, library),
        "verdict": hit.verdict,
        "probability": hit.probability,
        "margin": hit.margin,
        "exact": answer is not None,
        "level": None if answer is None else LEVELS[answer.level],
        "place": None if answer is None else answer.place,
        "box": None if answer is None else answer.box,
        "metres_per_unit": hit.metres_per_unit,
    }


def _write_sheet(path: Path, listed: Sequence[tuple[Answered, list[Hit]]], library: Library) -> None:
    """Return the answers that have pictures, under the headings of their phrases."""
    with atomic_path(path) as temporary:
        if path.suffix.lower() == ".html":
            temporary.write_text(_html(listed, library), encoding="utf-8")
        else:
            _image(listed, library).save(temporary, "PNG")


def _html(listed: Sequence[tuple[Answered, list[Hit]]], library: Library) -> str:
    parts = ["<!doctype html><meta charset='utf-8'><title>langsplat find</title>"]
    parts += ["<style>body{font:14px sans-serif}figure{display:inline-block;margin:4px}</style>"]
    for answered, hits in listed:
        parts.append(f"<h2>{html.escape(_heading(answered))}</h2>")
        for hit in hits:
            if hit.picture is None:
                continue
            packed = BytesIO()
            Image.fromarray(hit.picture).save(packed, "PNG")
            name = html.escape(_name(hit, library))
            says = html.escape(f"{_said(hit)}, {_place(hit)}")
            source = f"data:image/png;base64,{b64encode(packed.getvalue()).decode()}"
            parts.append(
                f"<figure><img alt='{name}' src='{source}'><figcaption>{name}<br>{says}</figcaption></figure>"
            )
    return "\n".join(parts) + "\n"


def _image(listed: Sequence[tuple[Answered, list[Hit]]], library: Library) -> Image.Image:
    (width, height), font = PICTURE, ImageFont.load_default(13)
    drawn = [(answered, [hit for hit in hits if hit.picture is not None]) for answered, hits in listed]
    rows = sum(-(-len(hits) // COLUMNS) for _, hits in drawn)
    total = len(drawn) * CAPTION // 2 + rows * (height + CAPTION) + GAP
    sheet = Image.new("RGB", (GAP + COLUMNS * (width + GAP), total), "white")
    brush, top = ImageDraw.Draw(sheet), GAP
    for answered, hits in drawn:
        brush.text((GAP, top), _heading(answered), "black", ImageFont.load_default(16))
        top += CAPTION // 2
        for at, hit in enumerate(hits):
            assert hit.picture is not None
            corner = GAP + at % COLUMNS * (width + GAP), top + at // COLUMNS * (height + CAPTION)
            sheet.paste(Image.fromarray(hit.picture), corner)
            says = f"{_name(hit, library)}\n{_said(hit)}\n{_place(hit)}"
            brush.text((corner[0], corner[1] + height), says, "black", font, spacing=1)
        top += -(-len(hits) // COLUMNS) * (height + CAPTION)
    return sheet


@dataclass(frozen=True)
class Changes:
    """Say what changed between two scenes of one place: what appeared, is gone, moved, or has another colour.

    Places are in the first scene's frame.
    """

    before: TrainedScene
    after: tyro.conf.Positional[Path]
    """Another one of the same place."""
    transform: Path | None = None
    """How the second lies in the axes of the first: .json of `langsplat register`; without it they are taken
    to be in one frame."""
    register: bool = False
    """Find the transform from the surfaces of both."""
    encoder: EncoderOption = ""
    scale: Positive | None = None
    """Metres per world unit of the first scene, in place of what it says."""
    json: JsonOption = False

    def run(self) -> None:
        if self.register and self.transform is not None:
            raise InputError("--register finds what --transform gives; leave one of them out")
        placed = None if self.transform is None else read_transform(self.transform).matrix
        scenes = searchable(self.before), searchable(self.after)
        unit = unit_of(scenes[0], self.scale)
        unsure = None in [scene.metres_per_unit for scene in scenes]
        first, second = (QueryEngine(scene, load_text_encoder, encoder_id=self.encoder) for scene in scenes)
        with TerminalProgress() as progress:
            describers = None
            try:
                describers = Describer(first, progress=progress), Describer(second, progress=progress)
            except EncoderError as error:
                print(f"langsplat: without names: {error}", file=sys.stderr)
            if self.register:
                placed = registered(scenes[1], scenes[0], scaled=unsure, progress=progress).transform
            found = changes(first, second, load_lifting_rasterizer("cpu"), placed, describers, progress)
        if self.json:
            print_json({"metres_per_unit": unit.metres, "changes": [_change_fields(c) for c in found]})
            return
        print("\n".join(_in_words(change, unit) for change in found) or "nothing changed")


def _in_words(change: Change, unit: Unit) -> str:
    name = change.name or "something"
    at = f"{unit.format(change.centre)} {unit.name}"
    if change.kind == "moved":
        assert change.moved is not None
        by = f"{unit.length * change.distance:.2f} {unit.name} ({unit.format(change.moved)})"
        return f"moved: {name} by {by}, now at {at}"
    if change.colours is not None:
        before, now = change.colours
        said = f"{before} to {now}" if before != now else f"another {now}"
        return f"changed colour: {name} at {at}, {said}"
    return f"{change.kind}: {name} at {at}"


def _change_fields(change: Change) -> dict[str, Any]:
    names = ("kind", "name", "centre", "box", "moved", "distance", "colours", "share")
    return {name: getattr(change, name) for name in names}

"""`langsplat describe` and `langsplat teach`.

Words for what is in a scene, everywhere, at a place, or as a tree; and a name for something that is pointed
at, by which it is then found.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.table import Table

from langsplat_core.cli.arguments import EncoderOption, Level, TrainedScene
from langsplat_core.cli.query import Unit, basis_fields, pixel_in, pointed, unit_of
from langsplat_core.cli.run import OutputConsole, print_json
from langsplat_core.config import Count, CountOrZero
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.io import sidecar as files
from langsplat_core.io.files import check_output_file
from langsplat_core.io.scenes import check_writable, companion_path
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.query.describe import Describer, LevelWords, look_at_pixel
from langsplat_core.query.engine import QueryEngine, check_words, searchable
from langsplat_core.query.inventory import InventoryEntry, export_labels, scene_inventory, scene_outline
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import LEVELS, LanguageField, Scene, TaughtWord
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.relevancy import read_vocabulary

WIDTH = 118  # characters of a table that is not written to a terminal


@dataclass(frozen=True)
class Describe:
    """Name what is in a pixel, or in the whole scene."""

    scene: TrainedScene
    camera: Annotated[CountOrZero, tyro.conf.arg(metavar="INDEX")] = 0
    """Training view in which --pixel is meant."""
    pixel: Annotated[tuple[CountOrZero, CountOrZero] | None, tyro.conf.arg(metavar="X Y")] = None
    """Column and row, counted from the top left pixel, 0 0."""
    level: Level | None = None
    """This semantic level alone."""
    outline: bool = False
    """The scene as a tree: wholes, with their parts under them."""
    labels: Annotated[Path | None, tyro.conf.arg(metavar="OUT.ply")] = None
    """Write the scene with instance, part and class of each Gaussian as properties, and OUT.labels.json with
    the tree's nodes: words, boxes, counts."""
    top: Count = 5
    """Words per level."""
    vocabulary: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Your own list, one phrase per line, in place of the bundled everyday things and parts."""
    encoder: EncoderOption = ""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        """Describe, and print the words."""
        phrases = None if self.vocabulary is None else read_vocabulary(self.vocabulary)
        scene = searchable(self.scene)
        self._check(scene)
        with TerminalProgress() as progress:
            engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
            describer = Describer(engine, phrases, progress)
            if self.labels is not None:
                print(f"{self.labels} and {export_labels(describer, self.labels)}")
                return
            answer = self._described(describer, progress)
        if self.json:
            print_json(answer | basis_fields(engine))
            return
        if self.outline:
            print(*outline_lines(answer["outline"], unit_of(scene.metres_per_unit)), sep="\n")
        elif self.pixel is None:
            _print_inventory(answer["inventory"])
        else:
            _print_words(answer["levels"])
        print(f"answers: {engine.basis.long}")
        if describer.left_out:
            names = ", ".join(describer.left_out[:3]) + (" ..." if len(describer.left_out) > 3 else "")
            print(
                f"{answer['asked']} phrases were compared; {len(describer.left_out)} were left out, because "
                f"the encoder was never taught their words ({names})"
            )

    def _check(self, scene: Scene) -> None:
        """InputError for arguments that do not go with the scene or each other, before anything is loaded."""
        narrowed = self.pixel is not None or self.level is not None
        if self.outline and narrowed:
            raise InputError(
                "--outline is of the whole scene, at all levels; leave out what else is asked for"
            )
        if self.labels is not None:
            if self.outline or self.json or narrowed:
                raise InputError("--labels writes files of the whole scene; leave out what else is asked for")
            if self.labels.suffix.lower() != ".ply":
                raise InputError(f"{self.labels}: labels are properties of a .ply; choose such a name")
            check_writable(self.labels)
        if self.pixel is None:
            if self.camera != 0:
                raise InputError(f"--camera {self.camera} needs a --pixel X Y in it")
            return
        if not scene.cameras:
            raise InputError(f"{self.scene}: has no cameras, so --pixel means nothing")
        pixel_in(scene, self.camera, self.pixel, "--pixel {} {}".format(*self.pixel))

    def _described(self, describer: Describer, progress: Progress) -> dict[str, Any]:
        """Return the outline, the inventory, or the words of a pixel, ready for JSON."""
        engine = describer.engine
        sure = engine.basis.calibration is not None
        asked: dict[str, Any] = {
            "asked": len(describer.words[0].phrases),
            "left_out": len(describer.left_out),
        }
        if self.outline:
            return asked | {"outline": outline_of(describer)}
        found: Sequence[LevelWords | InventoryEntry]
        if self.pixel is None:
            found = scene_inventory(describer, progress)
        else:
            camera = engine.scene.cameras[self.camera]
            at = look_at_pixel(load_lifting_rasterizer("cpu"), describer, camera, self.pixel, top=self.top)
            found = describer.at_gaussians(np.zeros(0, np.int64)) if at is None else at.words
            asked |= {"camera": self.camera, "view": camera.name, "pixel": list(self.pixel)}
        wanted = [_plain(one, sure) for one in found if self.level in (None, LEVELS[one.level])]
        return asked | {"inventory" if self.pixel is None else "levels": wanted}


def _plain(value: Any, sure: bool) -> Any:
    """Words, spots and entries, ready for JSON.

    A share of the softmax over a vocabulary is a probability too where that is `sure`.
    """
    if isinstance(value, tuple):
        return [_plain(item, sure) for item in value]
    if not is_dataclass(value):
        return value
    made: dict[str, Any] = {}
    for name in (field.name for field in fields(value)):
        held = getattr(value, name)
        if name == "level":
            made[name] = LEVELS[held]
        elif name == "rows":
            made["gaussians"] = len(held)
        elif name == "probability":
            made |= {"softmax": held, "probability": held if sure else None}
        else:
            made[name] = _plain(held, sure)
    return made


def _percent(described: dict[str, Any]) -> str:
    return "" if described["probability"] is None else f" {100 * described['probability']:.0f} %"


def _print_inventory(entries: list[dict[str, Any]]) -> None:
    table = Table("what", "also", "level", "p %", "surface %", "centre", box=None)
    for entry in entries:
        sure = _percent(entry).strip(" %") or "-"
        names = (entry["phrase"], ", ".join(entry["also"]), entry["level"], sure)
        for number, spot in enumerate(entry["spots"]):
            centre = " ".join(f"{value:.2f}" for value in spot["centre"])
            start = names if number == 0 else ("", "", "", "")
            table.add_row(*start, f"{100 * spot['share']:.2f}", centre)
    console = OutputConsole()
    OutputConsole(width=max(WIDTH, console.width)).print(table)
    if not entries:
        print("nothing of the vocabulary was found in the scene")


def outline_of(describer: Describer) -> list[dict[str, Any]]:
    """Return the scene as a tree, ready for JSON."""
    sure = describer.engine.basis.calibration is not None
    return [_plain(one, sure) for one in scene_outline(describer)]


def outline_lines(nodes: list[dict[str, Any]], unit: Unit) -> list[str]:
    """Return an outline as text, without what has neither a name nor parts."""
    named = [one for one in nodes if one["word"] is not None or one["parts"]]
    lines = list(_outline_lines(named, unit, 0))
    if len(named) < len(nodes):
        lines.append(f"and {len(nodes) - len(named)} without a name, which --json lists")
    return lines


def _outline_lines(nodes: list[dict[str, Any]], unit: Unit, depth: int) -> Iterator[str]:
    """Nodes with their parts indented under them; a line for those of one name that have none, too."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for node in nodes:
        name = None if node["word"] is None else node["word"]["phrase"]
        groups.setdefault(node["node"] if node["parts"] or name is None else name, []).append(node)
    for group in groups.values():
        node = group[0]
        word = "?" if node["word"] is None else f"{node['word']['phrase']}{_percent(node['word'])}"
        what = [
            node["level"],
            f"{unit.format(node['size'], ' x ')} {unit.name}",
            f"{node['count']} Gaussians",
        ]
        if any(node["votes"]):
            what.append(f"outlined in {node['votes'][0]} of {sum(node['votes'])} photographs")
        times = f"{len(group)} x " if len(group) > 1 else ""
        yield f"{'  ' * depth}{times}{word}: {'the largest ' if times else ''}{', '.join(what)}"
        yield from _outline_lines(node["parts"], unit, depth + 1)


def _print_words(levels: list[dict[str, Any]]) -> None:
    for level in reversed(levels):
        if not level["words"]:
            print(f"{level['level']:<8} nothing is known here")
            continue
        said = ", ".join(word["phrase"] + _percent(word) for word in level["words"])
        print(f"{level['level']:<8} {said}")


@dataclass(frozen=True)
class Teach:
    """Name what is in a pixel.

    `langsplat query` then finds the name in this scene or, with --into, in every scene of the same encoder.
    Teaching a name again adds an example.
    """

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it, into which the word is written."""
    name: str
    """The word, such as "grandma's vase"; it replaces what the encoder takes it for."""
    at: Annotated[str, tyro.conf.arg(metavar="X,Y")] = ""
    """Column and row of a pixel in it, counted from the top left one, 0,0."""
    camera: Annotated[CountOrZero, tyro.conf.arg(metavar="INDEX")] = 0
    """Training view in which the pixel is meant."""
    level: Level = "whole"
    """Semantic level of what is meant there."""
    into: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write into this vocabulary of yours, *.safetensors, instead of the scene."""
    remove: bool = False
    """Forget the word, with all its examples."""

    def run(self) -> None:
        """Learn the word, or forget it, and write the file."""
        scene = searchable(self.scene)
        field, target = scene.language, self.into or companion_path(self.scene, files.SUFFIX)
        assert field is not None
        if self.remove == bool(self.at):
            raise InputError("give either --at X,Y, a pixel to teach, or --remove")
        if self.into is not None and self.into.suffix != ".safetensors":
            raise InputError(f"{self.into}: taught words are written as .safetensors; choose such a name")
        check_output_file(target)
        known = {word.key: word for word in self._known(field)}
        if self.remove:
            if known.pop(phrase_key(self.name), None) is None:
                there = ", ".join(word.name for word in known.values()) or "none"
                raise InputError(f"{target}: '{self.name}' was not taught here; taught words: {there}")
            said = f"{self.name}: forgotten"
        else:
            engine = QueryEngine(scene)
            engine.taught = known
            members = pointed(engine, self.camera, self.at, "--at", self.level)
            word = engine.teach(self.name, members, self.level)
            here = len(engine.instances(engine.run(word.name)))
            times = "once" if len(word.vectors) == 1 else f"{len(word.vectors)} times"
            said = f"{word.name}: {members.sum()} Gaussians, shown {times}; things like it here: {here}"
        self._write(scene, field, list(known.values()))
        print(f"{said}\n{target}: taught words: {len(known)}")

    def _known(self, field: LanguageField) -> Sequence[TaughtWord]:
        if self.into is None:
            return field.taught
        if not self.into.exists():
            return ()
        words = files.read_words(self.into)
        try:
            check_words(field, words)
        except EncoderError as error:
            raise EncoderError(f"{self.into}: {error}") from None
        return words.words

    def _write(self, scene: Scene, field: LanguageField, taught: Sequence[TaughtWord]) -> None:
        if self.into is not None:
            files.write_words(self.into, files.Words(field.encoder_id, field.canonical, tuple(taught)))
        else:
            path = companion_path(self.scene, files.SUFFIX)
            files.write_language(path, replace(field, taught=tuple(taught)), scene.gaussians.means)

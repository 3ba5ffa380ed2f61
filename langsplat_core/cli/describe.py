"""`langsplat describe` and `langsplat teach`.

Words for what is in a scene, as a list or a tree; and names by which what is pointed at is found then.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from langsplat_core.arrays import Array, length_text
from langsplat_core.cli.arguments import EncoderOption, JsonOption, Needs, TrainedScene
from langsplat_core.cli.query import Unit, basis_fields, camera_of, in_world
from langsplat_core.cli.run import aligned, print_json
from langsplat_core.config import CountOrZero, Level, PictureConfig
from langsplat_core.errors import InputError, shortened
from langsplat_core.io import sidecar as files
from langsplat_core.io.files import check_output_file, locked
from langsplat_core.io.scenes import check_writable, companion_path
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine, check_words, searchable
from langsplat_core.query.inventory import export_labels, scene_inventory, scene_outline
from langsplat_core.query.selection import in_pixel
from langsplat_core.raster.render import pixel_weights
from langsplat_core.scene import LEVELS, LanguageField, Scene, TaughtWord
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.relevancy import read_vocabulary


@dataclass(frozen=True)
class Describe:
    """Name what is in the scene, and where."""

    scene: TrainedScene
    outline: bool = False
    """The scene as a tree: wholes, with their parts under them."""
    labels: Annotated[Path | None, tyro.conf.arg(metavar="OUT.ply")] = None
    """Write instance, part and class per Gaussian here; words, boxes and counts into OUT.labels.json."""
    vocabulary: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Your own list, one phrase per line, in place of the bundled everyday things and parts."""
    encoder: EncoderOption = ""
    json: JsonOption = False

    def run(self) -> None:
        if self.labels is not None:
            if self.outline or self.json:
                raise InputError("--labels writes files of the whole scene; leave out what else is asked for")
            if self.labels.suffix.lower() != ".ply":
                raise InputError(f"{self.labels}: labels are properties of a .ply; choose such a name")
            check_writable(self.labels, self.scene)
        phrases = None if self.vocabulary is None else read_vocabulary(self.vocabulary)
        scene = searchable(self.scene)
        with TerminalProgress() as progress:
            engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
            describer = Describer(engine, phrases, progress)
            if self.labels is not None:
                print(f"{self.labels} and {export_labels(describer, self.labels)}")
                return
            found: Any = scene_outline(describer) if self.outline else scene_inventory(describer, progress)
        found = in_world(_plain(found, engine), scene.origin)
        asked, left_out = len(describer.words[0].phrases), describer.left_out
        if self.json:
            counts = {"asked": asked, "left_out": len(left_out)}
            print_json(counts | {"outline" if self.outline else "inventory": found} | basis_fields(engine))
            return
        if self.outline:
            print(*outline_lines(found, Unit(scene.metres_per_unit, scene.origin)), sep="\n")
        else:
            _print_inventory(found, scene.origin)
        print(f"answers: {engine.basis.long}")
        if left_out:
            print(
                f"{asked} phrases compared, {len(left_out)} left out, because the encoder was "
                f"never taught their words ({shortened(left_out, 3)})"
            )


def _plain(value: Any, engine: QueryEngine) -> Any:
    """Return words, spots and entries for JSON; softmax shares are probabilities if it is calibrated."""
    if isinstance(value, tuple | list):
        return [_plain(item, engine) for item in value]
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
            made |= {"softmax": held, "probability": held if engine.basis.calibration else None}
        else:
            made[name] = _plain(held, engine)
    return made


def _percent(described: dict[str, Any]) -> str:
    return "" if described["probability"] is None else f" {100 * described['probability']:.0f} %"


def _print_inventory(entries: list[dict[str, Any]], origin: Array) -> None:
    rows = [("what", "also", "level", "p %", "surface %", "centre")]
    for entry in entries:
        sure = _percent(entry).strip(" %") or "-"
        names = (entry["phrase"], ", ".join(entry["also"]), entry["level"], sure)
        for number, spot in enumerate(entry["spots"]):
            centre = length_text(spot["centre"] - origin, least=2, origin=origin)
            start = names if number == 0 else ("", "", "", "")
            rows.append((*start, f"{100 * spot['share']:.2f}", centre))
    print(*aligned(rows, left=3), sep="\n")
    if not entries:
        print("nothing of the vocabulary was found in the scene")


def outline_of(describer: Describer) -> list[dict[str, Any]]:
    """Return the scene as a tree, ready for JSON."""
    return list(_plain(scene_outline(describer), describer.engine))


def outline_lines(nodes: list[dict[str, Any]], unit: Unit) -> list[str]:
    """Return an outline as text, without what has neither a name nor parts."""
    named = [one for one in nodes if one["word"] is not None or one["parts"]]
    lines = list(_outline_lines(named, unit, 0))
    if len(named) < len(nodes):
        lines.append(f"and {len(nodes) - len(named)} without a name, which --json lists")
    return lines


def _outline_lines(nodes: list[dict[str, Any]], unit: Unit, depth: int) -> Iterator[str]:
    """Yield nodes with their parts indented; nodes of one name without parts share a line."""
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
    camera: Annotated[CountOrZero, tyro.conf.arg(metavar="INDEX"), Needs("at")] = 0
    """Training view in which the pixel is meant."""
    level: Annotated[Level, Needs("at")] = "whole"
    """Semantic level of what is meant there."""
    into: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write into this vocabulary of yours, *.safetensors, instead of the scene."""
    remove: bool = False
    """Forget the word, with all its examples."""

    def run(self) -> None:
        target = self.into or companion_path(self.scene, files.SUFFIX)
        if self.remove == bool(self.at):
            raise InputError("give either --at X,Y, a pixel to teach, or --remove")
        if self.into is not None and self.into.suffix != ".safetensors":
            raise InputError(f"{self.into}: taught words are written as .safetensors; choose such a name")
        check_output_file(target)
        scene = None
        if self.into is not None:
            scene = searchable(self.scene)
            self.into.parent.mkdir(parents=True, exist_ok=True)
        with locked(target.parent):  # from reading to writing: what another teaches meanwhile is kept
            self._change(scene or searchable(self.scene), target)

    def _change(self, scene: Scene, target: Path) -> None:
        field = scene.language
        assert field is not None
        known = {word.key: word for word in self._known(field)}
        if self.remove:
            if known.pop(phrase_key(self.name), None) is None:
                there = ", ".join(word.name for word in known.values()) or "none"
                raise InputError(f"{target}: '{self.name}' was not taught here; taught words: {there}")
            said = f"{self.name}: forgotten"
        else:
            engine = QueryEngine(scene)
            engine.taught = known
            members = _pointed(engine, self.camera, self.at, self.level)
            word = engine.teach(self.name, members, self.level)
            here = len(engine.instances(engine.run(word.name)))
            times = "once" if len(word.vectors) == 1 else f"{len(word.vectors)} times"
            said = f"{word.name}: {members.sum()} Gaussians, shown {times}; things like it here: {here}"
        words = tuple(known.values())
        if self.into is not None:
            files.write_words(target, files.Words(field.encoder_id, field.canonical, words))
        else:
            files.write_language(target, replace(field, taught=words), scene.gaussians.means, scene.origin)
        print(f"{said}\n{target}: taught words: {len(known)}")

    def _known(self, field: LanguageField) -> Sequence[TaughtWord]:
        if self.into is None:
            return field.taught
        if not self.into.exists():
            return ()
        words = files.read_words(self.into)
        check_words(field, words)
        return words.words


def _pointed(engine: QueryEngine, camera: int, at: str, level: Level) -> Array:
    """Return (N,) bool: the region in a pixel "X,Y"; InputError outside of the image, or without one."""
    scene, place = engine.scene, re.fullmatch(r"([0-9]{1,9}), ?([0-9]{1,9})", at)
    if not scene.cameras:
        raise InputError("the scene has no cameras, so --at means nothing")
    if place is None:
        raise InputError(f"--at {at}: give column and row, counted from the top left pixel, as in 412,230")
    column, row, view = int(place[1]), int(place[2]), camera_of(scene, camera)
    if column >= view.width or row >= view.height:
        edge = f"columns 0 to {view.width - 1} and rows 0 to {view.height - 1}"
        raise InputError(f"--at {at}: camera {camera} has {edge}")
    rows, weights = pixel_weights(scene, view, (column, row))
    members = in_pixel(engine.regions, LEVELS.index(level), rows, weights)
    if weights.sum() <= PictureConfig().alpha_gate or not members.any():
        raise InputError(f"--at {at}: nothing is there in camera {camera}; point at a thing")
    return members

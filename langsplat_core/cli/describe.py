"""`langsplat describe`: words for what is in a scene."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.table import Table

from langsplat_core.cli.console import OutputConsole
from langsplat_core.cli.instances import chosen, instance_json
from langsplat_core.config import Count, CountOrZero
from langsplat_core.errors import InputError
from langsplat_core.formats import load_scene
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.query.combined import combine
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.describe import Describer, Levels, Words
from langsplat_core.query.engine import QueryEngine, no_field
from langsplat_core.query.instances import Instance, find_instances
from langsplat_core.query.inventory import Entry, Spot
from langsplat_core.query.words import Word
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import LEVELS, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.vocabulary import read_vocabulary

Level = Literal["subpart", "part", "whole"]
WIDTH = 118  # characters of a table that is not written to a terminal


@dataclass(frozen=True)
class Describe:
    """What is here? The best words of a vocabulary for a pixel, a Gaussian or a thing that a phrase finds, or
    the scene's inventory."""

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it."""
    camera: Annotated[CountOrZero, tyro.conf.arg(metavar="INDEX")] = 0
    """Training view in which --pixel is meant."""
    pixel: Annotated[tuple[CountOrZero, CountOrZero] | None, tyro.conf.arg(metavar="X Y")] = None
    """Column and row, counted from the top left pixel, 0 0."""
    gaussian: Annotated[CountOrZero | None, tyro.conf.arg(metavar="NUMBER")] = None
    """One Gaussian, by its row in the file, from 0."""
    phrase: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """A thing that this phrase finds."""
    instance: Annotated[Count, tyro.conf.arg(metavar="NUMBER")] = 1
    """Which of the things that --phrase finds, as `langsplat query` lists them; the best is 1."""
    level: Level | None = None
    """This semantic level alone."""
    top: Count = 5
    """Words per level."""
    vocabulary: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Your own list, one phrase per line, in place of the bundled everyday things and parts."""
    encoder: str = ""
    """Text encoder folder or hub id, in place of the one the scene names."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        phrases = None if self.vocabulary is None else read_vocabulary(self.vocabulary)
        scene = load_scene(self.scene)
        self._check(scene)
        with TerminalProgress() as progress:
            engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
            describer = Describer(engine, phrases, progress)
            answer = self._entries(describer, progress) if self._everything else self._words(describer)
        answer |= {"encoder": engine.basis.encoder, "calibration": engine.basis.calibration}
        if self.json:
            json.dump(answer, sys.stdout, indent=1)
            print()
            return
        if self._everything:
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

    @property
    def _everything(self) -> bool:
        return self._asked_of == []

    @property
    def _asked_of(self) -> list[str]:
        """The options that name a place."""
        given = {"--pixel": self.pixel, "--gaussian": self.gaussian, "--phrase": self.phrase}
        return [option for option, value in given.items() if value is not None]

    def _check(self, scene: Scene) -> None:
        """InputError for arguments that do not go with the scene or each other, before anything is loaded."""
        if scene.language is None:
            raise InputError(f"{self.scene}: {no_field(scene)}")
        if len(self._asked_of) > 1:
            raise InputError(f"{' and '.join(self._asked_of)} are several questions; ask one of them")
        if self.phrase is None and self.instance != 1:
            raise InputError(f"--instance {self.instance} needs a --phrase that finds it")
        count = len(scene.gaussians)
        if self.gaussian is not None and not 0 <= self.gaussian < count:
            raise InputError(f"--gaussian {self.gaussian}: the scene has Gaussians 0 to {count - 1}")
        if self.pixel is None:
            if self.camera != 0:
                raise InputError(f"--camera {self.camera} needs a --pixel X Y in it")
            return
        if not scene.cameras:
            raise InputError(f"{self.scene}: has no cameras, so --pixel means nothing; ask by --gaussian")
        if not 0 <= self.camera < len(scene.cameras):
            raise InputError(f"--camera {self.camera}: the scene has cameras 0 to {len(scene.cameras) - 1}")
        camera, (column, row) = scene.cameras[self.camera], self.pixel
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            raise InputError(
                f"--pixel {column} {row}: camera {self.camera} has columns 0 to {camera.width - 1} and rows "
                f"0 to {camera.height - 1}"
            )

    def _entries(self, describer: Describer, progress: Progress) -> dict[str, Any]:
        """The inventory, ready for JSON."""
        sure = describer.engine.basis.calibration is not None
        entries = [
            _entry(entry, sure)
            for entry in describer.inventory(progress)
            if self.level in (None, LEVELS[entry.level])
        ]
        return _asked(describer) | {"inventory": entries}

    def _words(self, describer: Describer) -> dict[str, Any]:
        """Words of the pixel or Gaussian, ready for JSON."""
        scene = describer.engine.scene
        levels: Levels
        if self.pixel is not None:
            camera = scene.cameras[self.camera]
            levels = describer.at_pixel(load_lifting_rasterizer("cpu"), camera, self.pixel, self.top)
            place: dict[str, Any] = {"camera": self.camera, "view": camera.name, "pixel": list(self.pixel)}
        elif self.phrase is not None:
            thing = self._thing(describer.engine, self.phrase)
            levels = describer.at_gaussians(thing.members, top=self.top)
            place = {"phrase": self.phrase, "thing": instance_json(thing, self.instance)}
        else:
            levels = describer.at_gaussians(np.array([self.gaussian]), np.ones(1), self.top)
            place = {"gaussian": self.gaussian}
        wanted = [words for words in levels if self.level in (None, LEVELS[words.level])]
        sure = describer.engine.basis.calibration is not None
        return place | _asked(describer) | {"levels": [_level(words, sure) for words in wanted]}

    def _thing(self, engine: QueryEngine, phrase: str) -> Instance:
        answer = combine([run_phrase(engine, phrase, "auto").answer], "union")
        found = find_instances(engine.surface, engine.scene.gaussians, answer.members, answer.relevancy)
        return chosen(found, [self.instance])[0]


def _asked(describer: Describer) -> dict[str, Any]:
    return {"asked": len(describer.words[0].phrases), "left_out": len(describer.left_out)}


def _share(softmax: float, sure: bool) -> dict[str, Any]:
    """A share of the softmax over a vocabulary, and whether that is a probability too."""
    return {"softmax": softmax, "probability": softmax if sure else None}


def _word(word: Word | None, sure: bool) -> dict[str, Any] | None:
    return None if word is None else {"phrase": word.phrase, **_share(word.probability, sure)}


def _level(words: Words, sure: bool) -> dict[str, Any]:
    return {
        "level": LEVELS[words.level],
        "words": [_word(word, sure) for word in words.words],
        "other": words.other,
        "known": words.known,
        "colour": _word(words.colour, sure),
        "material": _word(words.material, sure),
    }


def _spot(spot: Spot, sure: bool) -> dict[str, Any]:
    return {
        "centre": spot.centre.tolist(),
        "box": spot.box.tolist(),
        "gaussians": len(spot.rows),
        "share": spot.share,
        "colour": _word(spot.colour, sure),
        "material": _word(spot.material, sure),
    }


def _entry(entry: Entry, sure: bool) -> dict[str, Any]:
    return {
        "phrase": entry.phrase,
        "also": list(entry.also),
        "level": LEVELS[entry.level],
        **_share(entry.probability, sure),
        "score": entry.score,
        "share": entry.share,
        "spots": [_spot(spot, sure) for spot in entry.spots],
    }


def _looks(described: dict[str, Any]) -> str:
    return " ".join(described[key]["phrase"] for key in ("colour", "material") if described[key] is not None)


def _percent(described: dict[str, Any]) -> str:
    return "" if described["probability"] is None else f" {100 * described['probability']:.0f} %"


def _print_inventory(entries: list[dict[str, Any]]) -> None:
    table = Table("what", "also", "level", "p %", "surface %", "looks", "centre", box=None)
    for entry in entries:
        names = (
            entry["phrase"],
            ", ".join(entry["also"]),
            entry["level"],
            _percent(entry).strip(" %") or "-",
        )
        for number, spot in enumerate(entry["spots"]):
            centre = " ".join(f"{value:.2f}" for value in spot["centre"])
            start = names if number == 0 else ("", "", "", "")
            table.add_row(*start, f"{100 * spot['share']:.2f}", _looks(spot), centre)
    console = OutputConsole()
    OutputConsole(width=max(WIDTH, console.width)).print(table)
    if not entries:
        print("nothing of the vocabulary was found in the scene")


def _print_words(levels: list[dict[str, Any]]) -> None:
    for level in reversed(levels):
        if not level["words"]:
            print(f"{level['level']:<8} nothing is known here")
            continue
        said = ", ".join(word["phrase"] + _percent(word) for word in level["words"])
        looks = _looks(level)
        print(f"{level['level']:<8} {said}" + (f"; looks {looks}" if looks else ""))

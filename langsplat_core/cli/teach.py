"""`langsplat teach`: a name for something that is pointed at, by which it is then found; and what is at a
pixel, for other commands too."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from langsplat_core.arrays import Array
from langsplat_core.config import CountOrZero, LevelChoice, PictureConfig
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.io.files import check_output_file
from langsplat_core.io.language import SUFFIX, Words, read_words, write_language, write_words
from langsplat_core.io.scenes import companion_path, load_scene
from langsplat_core.query.engine import QueryEngine, check_words, no_field
from langsplat_core.query.selection import in_pixel
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.render import pixel_weights
from langsplat_core.scene import LEVELS, Camera, LanguageField, Scene, TaughtWord
from langsplat_core.scene.language import phrase_key

Level = Literal["subpart", "part", "whole"]


@dataclass(frozen=True)
class Teach:
    """Name what is in a pixel. `langsplat query` then finds the name in this scene or, with --into, in every
    scene of the same encoder. Teaching a name again adds an example."""

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
        scene = searchable(self.scene)
        field, target = scene.language, self.into or companion_path(self.scene, SUFFIX)
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
        words = read_words(self.into)
        try:
            check_words(field, words)
        except EncoderError as error:
            raise EncoderError(f"{self.into}: {error}") from None
        return words.words

    def _write(self, scene: Scene, field: LanguageField, taught: Sequence[TaughtWord]) -> None:
        if self.into is not None:
            write_words(self.into, Words(field.encoder_id, field.canonical, tuple(taught)))
        else:
            path = companion_path(self.scene, SUFFIX)
            write_language(path, replace(field, taught=tuple(taught)), scene.gaussians.means)


# What is at a pixel.


def pointed(engine: QueryEngine, camera: int, at: str, option: str, level: LevelChoice) -> Array:
    """(N,) bool: the region in a pixel, "X,Y" as the user gave it with an option. Raises InputError for what
    is no pixel of the camera, and for one without a region."""
    scene, place = engine.scene, re.fullmatch(r"([0-9]{1,9}), ?([0-9]{1,9})", at)
    if not scene.cameras:
        raise InputError(f"the scene has no cameras, so {option} means nothing")
    if place is None:
        raise InputError(
            f"{option} {at}: give column and row, counted from the top left pixel, as in 412,230"
        )
    pixel = int(place[1]), int(place[2])
    view = pixel_in(scene, camera, pixel, f"{option} {at}")
    rows, weights = pixel_weights(
        load_lifting_rasterizer("cpu"), scene.gaussians, view, pixel, scene.raster_settings()
    )
    members = in_pixel(engine.regions, LEVELS.index(level), rows, weights)
    if weights.sum() <= PictureConfig().alpha_gate or not members.any():
        raise InputError(f"{option} {at}: nothing is there in camera {camera}; point at a thing")
    return members


def pixel_in(scene: Scene, index: int, pixel: tuple[int, int], given: str) -> Camera:
    """The camera of a number; InputError where there is none, or `pixel` is outside its image."""
    camera, (column, row) = camera_of(scene, index), pixel
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise InputError(
            f"{given}: camera {index} has columns 0 to {camera.width - 1} and rows 0 to {camera.height - 1}"
        )
    return camera


def camera_of(scene: Scene, index: int) -> Camera:
    """The camera of a number; InputError where there is none."""
    if not 0 <= index < len(scene.cameras):
        raise InputError(f"--camera {index}: the scene has cameras 0 to {len(scene.cameras) - 1}")
    return scene.cameras[index]


def searchable(path: Path) -> Scene:
    """The scene of a file; InputError where it has no language field."""
    scene = load_scene(path)
    if scene.language is None:
        raise InputError(f"{path}: {no_field(scene)}")
    return scene

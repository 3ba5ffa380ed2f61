"""Subjects of an evaluation: a scene of ours, or relevancy maps and masks that another system rendered.

    <view>/<phrase>.npy                  float (L, H, W) or (H, W) relevancy; L levels, at most three
    <view>/<phrase>.<level>.npy|.png     or one file per level: subpart, part, whole; any of them
    <view>/<phrase>.png                  a single map; for protocol direct-3d the drawn silhouette instead

A PNG of 8 or 16 bits holds relevancy from 0 to 1. A "/" in a phrase is "_" in its file's name. Maps of one
phrase have one size; it need not be the labels', whose masks are then brought to it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.errors import FormatError
from langsplat_core.evaluation.labels import Size, check_same_image, read_grey
from langsplat_core.evaluation.profiles import (
    MapRule,
    OwnRule,
    Prediction,
    Profile,
    SilhouetteRule,
    own_prediction,
    read_maps,
    read_silhouette,
)
from langsplat_core.io.hostile import opened, read_npy
from langsplat_core.query.answers import QueryResult, decoded_relevancy, splatted_relevancy
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.protocol import View
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import LEVELS, Camera


def file_name(phrase: str) -> str:
    """Return the stem of the names of a phrase's files."""
    return phrase.replace("/", "_")


def read_relevancy(folder: Path, phrase: str) -> tuple[Array, tuple[int, ...]] | None:
    """The (L, H, W) float64 maps of `phrase` in a view's `folder` and their levels, indices into LEVELS; None
    where there is none. FormatError for a damaged one."""
    name = file_name(phrase)
    whole = _existing(folder, name)
    if whole is not None:
        maps = _read(whole)
        maps = maps[None] if maps.ndim == 2 else maps
        return maps, tuple(range(len(maps)))
    files = {level: _existing(folder, f"{name}.{word}") for level, word in enumerate(LEVELS)}
    there = {level: path for level, path in files.items() if path is not None}
    if not there:
        return None
    singles = {path: _read(path) for path in there.values()}
    first = next(iter(singles.values()))
    for path, values in singles.items():
        if values.ndim != 2 or values.shape != first.shape:
            raise FormatError(
                f"{path}: shape {values.shape}; the levels of one phrase are (H, W) of one size"
            )
    return np.stack(list(singles.values())), tuple(there)


def _existing(folder: Path, name: str) -> Path | None:
    return next((path for s in (".npy", ".png") if (path := folder / f"{name}{s}").is_file()), None)


def _read(path: Path) -> Array:
    values = read_npy(path) if path.suffix == ".npy" else _image(path)
    if values.ndim not in (2, 3) or 0 in values.shape or (values.ndim == 3 and len(values) > len(LEVELS)):
        raise FormatError(
            f"{path}: shape {values.shape}; expected (H, W), or (L, H, W) with at most 3 levels"
        )
    if not np.isfinite(values).all():
        raise FormatError(f"{path}: holds numbers that are not finite")
    return values.astype(np.float64)


def _image(path: Path) -> Array:
    """(H, W) relevancy in [0, 1] of an image file."""
    with opened(path) as image:
        if image.mode.startswith("I"):
            return np.asarray(image, np.float64) / 65535
        return np.asarray(image.convert("L"), np.float64) / 255


# Who answers: a scene of ours, or a folder of maps that another system rendered. Neither sees a label.

NO_VIEW = "no camera of that name"
NO_MAP = "no map"
TOGETHER = 10  # phrases splatted in one pass, three channels each


@dataclass(frozen=True, eq=False)
class SceneSource:
    """A scene of ours, drawn from the labelled views."""

    engine: QueryEngine
    cameras: Mapping[str, Camera]  # by name without extension
    trained: frozenset[str] | None  # names of the training views; None: they are not the dataset's names
    profile: Profile
    paper_order: bool = False  # blend latents and decode every pixel, instead of blending relevancies

    def trained_on(self, frame: str) -> bool | None:
        """Return True where the view was trained on, False where it was not, None where that is not known."""
        return None if self.trained is None else frame in self.trained

    def answers(self, frame: str, size: Size, phrases: Sequence[str]) -> Mapping[str, Prediction | str]:
        """phrase -> the answer in the view `frame`, drawn at `size`; or why there is none."""
        if frame not in self.cameras:
            return dict.fromkeys(phrases, NO_VIEW)
        camera = self.cameras[frame]
        check_same_image(frame, (camera.width, camera.height), size)
        camera = camera.resized(*size)
        found: dict[str, Prediction | str] = {}
        for phrase in phrases:
            unknown = self.engine.unknown_words(phrase)
            if unknown:
                found[phrase] = f"the encoder does not know {', '.join(repr(word) for word in unknown)}"
        asked = [phrase for phrase in phrases if phrase not in found]
        for start in range(0, len(asked), TOGETHER):
            part = asked[start : start + TOGETHER]
            found |= zip(part, self._predictions(camera, part), strict=True)
        return found

    def _predictions(self, camera: Camera, phrases: Sequence[str]) -> list[Prediction]:
        rule, scene = self.profile.rule, self.engine.scene
        view = load_rasterizer("cpu").view(scene.gaussians, camera, scene.raster_settings())
        if isinstance(rule, MapRule) and self.paper_order:
            return [read_maps(maps, rule) for maps in self._decoded(view, phrases)]
        results = self.engine.run_many(phrases)
        if isinstance(rule, OwnRule):
            return [own_prediction(view, result, rule) for result in results]
        if isinstance(rule, SilhouetteRule):
            return [Prediction(self._silhouette(camera, result, rule), result.level) for result in results]
        values = np.concatenate([result.relevancy for result in results]).T
        maps = np.moveaxis(splatted_relevancy(view, values, PictureConfig().alpha_gate), 2, 0)
        return [read_maps(maps[row : row + len(LEVELS)], rule) for row in range(0, len(maps), len(LEVELS))]

    def _decoded(self, view: View, phrases: Sequence[str]) -> Array:
        """(Q, 3, H, W) relevancy in the paper's order: latents blended, every pixel decoded."""
        vectors = np.stack([self.engine.text_vector(phrase) for phrase in phrases])
        gate = PictureConfig().alpha_gate
        levels = [decoded_relevancy(view, self.engine.field, k, vectors, gate) for k in range(len(LEVELS))]
        return np.moveaxis(np.stack(levels), 3, 0)

    def _silhouette(self, camera: Camera, result: QueryResult, rule: SilhouetteRule) -> Array:
        """The mask of the answer's Gaussians drawn alone, as if nothing stood before them."""
        scene = self.engine.scene
        if not result.members.any():
            return np.zeros((camera.height, camera.width), bool)
        chosen = scene.gaussians.take(result.members)
        view = load_rasterizer("cpu").view(chosen, camera, scene.raster_settings())
        drawn = splat_colours(view, chosen, camera)
        return read_silhouette(drawn.colours, drawn.alpha, rule)


@dataclass(frozen=True, eq=False)
class MapSource:
    """Another system's maps of one scene, scored on their own grid; see the top of this file."""

    folder: Path  # <view>/<phrase>...
    rule: MapRule | SilhouetteRule

    def trained_on(self, frame: str) -> bool | None:
        return None

    def answers(self, frame: str, size: Size, phrases: Sequence[str]) -> Mapping[str, Prediction | str]:
        """phrase -> the answer by its map in the view `frame`, whatever its size; or why there is none."""
        return {phrase: self._answer(self.folder / frame, phrase) for phrase in phrases}

    def _answer(self, folder: Path, phrase: str) -> Prediction | str:
        if isinstance(self.rule, SilhouetteRule):
            path = folder / f"{file_name(phrase)}.png"
            return Prediction(read_grey(path) > self.rule.grey) if path.is_file() else NO_MAP
        found = read_relevancy(folder, phrase)
        if found is None:
            return NO_MAP
        maps, levels = found
        answer = read_maps(maps, self.rule)
        return replace(answer, level=levels[answer.level or 0])


Source = SceneSource | MapSource

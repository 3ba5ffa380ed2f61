"""Who answers: a scene of ours, or a folder of maps that another system rendered. Neither sees a label."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.evaluation.protocols.labels import Size, check_same_picture, read_grey
from langsplat_core.evaluation.protocols.map_files import file_name, read_relevancy
from langsplat_core.evaluation.protocols.own_rule import own_prediction
from langsplat_core.evaluation.protocols.profiles import MapRule, OwnRule, Profile, SilhouetteRule
from langsplat_core.evaluation.protocols.reading import Prediction, read_maps, read_silhouette
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.pixels import decoded_relevancy, splatted_relevancy
from langsplat_core.raster.protocol import Rasterizer, View
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import LEVELS, Camera

NO_VIEW = "no camera of that name"
NO_MAP = "no map"
TOGETHER = 10  # phrases splatted in one pass, three channels each


class Source(Protocol):
    """Answers phrases in views."""

    def answers(self, frame: str, size: Size, phrases: Sequence[str]) -> Mapping[str, Prediction | str]:
        """phrase -> the answer in the view `frame`, preferably drawn at `size`; or why there is none."""

    def trained_on(self, frame: str) -> bool | None:
        """Whether the view was trained on; None: not known."""


@dataclass(frozen=True, eq=False)
class SceneSource:
    """A scene of ours, drawn from the labelled views."""

    engine: QueryEngine
    rasterizer: Rasterizer
    cameras: Mapping[str, Camera]  # by name without extension
    trained: frozenset[str] | None  # names of the training views; None: they are not the dataset's names
    profile: Profile
    paper_order: bool = False  # blend latents and decode every pixel, instead of blending relevancies

    def trained_on(self, frame: str) -> bool | None:
        """See `Source`."""
        return None if self.trained is None else frame in self.trained

    def answers(self, frame: str, size: Size, phrases: Sequence[str]) -> Mapping[str, Prediction | str]:
        """See `Source`."""
        if frame not in self.cameras:
            return dict.fromkeys(phrases, NO_VIEW)
        camera = self.cameras[frame]
        check_same_picture(frame, (camera.width, camera.height), size)
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
        view = self.rasterizer.view(scene.gaussians, camera, scene.raster_settings())
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
        """(Q, 3, H, W) in the paper's order."""
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
        view = self.rasterizer.view(chosen, camera, scene.raster_settings())
        drawn = splat_colours(view, chosen, camera)
        return read_silhouette(drawn.colours, drawn.alpha, rule)


@dataclass(frozen=True, eq=False)
class MapSource:
    """Another system's maps of one scene, scored on their own grid (see `map_files`)."""

    folder: Path  # <view>/<phrase>...
    rule: MapRule | SilhouetteRule

    def trained_on(self, frame: str) -> bool | None:
        """See `Source`."""
        return None

    def answers(self, frame: str, size: Size, phrases: Sequence[str]) -> Mapping[str, Prediction | str]:
        """See `Source`; `size` is not read."""
        return {phrase: self._answer(self.folder / frame, phrase) for phrase in phrases}

    def _answer(self, folder: Path, phrase: str) -> Prediction | str:
        if isinstance(self.rule, SilhouetteRule):
            path = folder / f"{file_name(phrase)}.png"
            return Prediction(read_grey(path) > self.rule.grey) if path.is_file() else NO_MAP
        found = read_relevancy(folder, phrase)
        if found is None:
            return NO_MAP
        answer = read_maps(found.maps, self.rule)
        return Prediction(
            answer.mask, None if answer.level is None else found.levels[answer.level], answer.peaks
        )

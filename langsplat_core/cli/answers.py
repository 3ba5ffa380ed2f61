"""Answers as commands print them, in lines and as JSON; and places in images as users give them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice, PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import Instance
from langsplat_core.query.selection import in_pixel
from langsplat_core.raster.render import pixel_weights
from langsplat_core.scene import LEVELS, Camera, Scene


@dataclass(frozen=True)
class Unit:
    """The unit that lengths are printed and given in."""

    name: str  # "m" or "units"
    length: float  # world units -> this

    @property
    def metres(self) -> float | None:
        """Metres per world unit; None where nobody said."""
        return self.length if self.name == "m" else None

    def format(self, values: Array, between: str = " ") -> str:
        """Lengths in world units as numbers of this unit, joined by `between`."""
        return between.join(f"{self.length * value:.3f}" for value in values)


def unit_of(metres_per_unit: float | None) -> Unit:
    """Return the unit of lengths in a scene: metres where a scale is known, else world units."""
    return Unit("units", 1.0) if metres_per_unit is None else Unit("m", metres_per_unit)


def instance_lines(instances: Sequence[Instance], unit: Unit) -> list[str]:
    """Aligned lines under a heading, one for each instance; none without instances."""
    if not instances:
        return []
    rows = [("", "score", "share", "Gaussians", f"centre, {unit.name}", f"size, {unit.name}")]
    rows += [
        (
            str(number),
            f"{instance.score:.3f}",
            f"{100 * instance.share:.0f} %",
            f"{instance.count}",
            unit.format(instance.centre),
            unit.format(instance.size, " x "),
        )
        for number, instance in enumerate(instances, 1)
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    ]


def listed(instances: Sequence[Instance]) -> dict[str, Any]:
    """Return instances, numbered from 1, ready for JSON, lengths in world units."""
    return {"instances": [_instance_fields(instance, number) for number, instance in enumerate(instances, 1)]}


def _instance_fields(instance: Instance, number: int) -> dict[str, Any]:
    box = instance.oriented
    return {
        "number": number,
        "score": instance.score,
        "mean": instance.mean,
        "share": instance.share,
        "gaussians": instance.count,
        "centre": instance.centre,
        "size": instance.size,
        "box": instance.box,
        "oriented_box": {"centre": box.centre, "rotation": box.axes, "half_extents": box.half_extents},
    }


def found_answer(engine: QueryEngine, text: str, level: LevelChoice) -> QueryResult:
    """Return the answer to a phrase; InputError where it was not found."""
    answer = run_phrase(engine, text, level).answer
    if not answer.found or not answer.members.any():
        raise InputError(
            f"'{answer.phrase}' was not found (score {answer.peak:.3f}): nothing to select; ask in other "
            "words, or at another --level"
        )
    return answer


def chosen_instances(found: Sequence[Instance], numbers: Sequence[int]) -> Sequence[Instance]:
    """Return the instances of these numbers, the best is 1; all without numbers.

    Raises InputError for another.
    """
    if not found:
        raise InputError("what was found lies nowhere on a surface: nothing to select")
    for number in numbers:
        if not 1 <= number <= len(found):
            raise InputError(f"--instance {number}: there are {len(found)}, numbered from 1")
    return [found[number - 1] for number in numbers] or found


def basis_fields(engine: QueryEngine) -> dict[str, Any]:
    """Return what the answers stand on, ready for JSON."""
    return {"encoder": engine.basis.encoder, "calibration": engine.basis.calibration}


def pointed(engine: QueryEngine, camera: int, at: str, option: str, level: LevelChoice) -> Array:
    """(N,) bool: the region in a pixel, "X,Y" as the user gave it with an option.

    Raises InputError for what is no pixel of the camera, and for one without a region.
    """
    scene, place = engine.scene, re.fullmatch(r"([0-9]{1,9}), ?([0-9]{1,9})", at)
    if not scene.cameras:
        raise InputError(f"the scene has no cameras, so {option} means nothing")
    if place is None:
        raise InputError(
            f"{option} {at}: give column and row, counted from the top left pixel, as in 412,230"
        )
    pixel = int(place[1]), int(place[2])
    view = pixel_in(scene, camera, pixel, f"{option} {at}")
    rows, weights = pixel_weights(scene, view, pixel)
    members = in_pixel(engine.regions, LEVELS.index(level), rows, weights)
    if weights.sum() <= PictureConfig().alpha_gate or not members.any():
        raise InputError(f"{option} {at}: nothing is there in camera {camera}; point at a thing")
    return members


def pixel_in(scene: Scene, index: int, pixel: tuple[int, int], given: str) -> Camera:
    """Return the camera of a number; InputError where there is none, or `pixel` is outside its image."""
    camera, (column, row) = camera_of(scene, index), pixel
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise InputError(
            f"{given}: camera {index} has columns 0 to {camera.width - 1} and rows 0 to {camera.height - 1}"
        )
    return camera


def camera_of(scene: Scene, index: int) -> Camera:
    """Return the camera of a number; InputError where there is none."""
    if not 0 <= index < len(scene.cameras):
        raise InputError(f"--camera {index}: the scene has cameras 0 to {len(scene.cameras) - 1}")
    return scene.cameras[index]

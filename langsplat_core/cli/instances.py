"""Instances of an answer, for people and as JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.query.instances import Instance
from langsplat_core.scene import Scene

HEADING = ("", "score", "share", "Gaussians", "centre", "size")


@dataclass(frozen=True)
class Unit:
    """The unit that lengths are printed and given in."""

    name: str  # "m" or "units"
    length: float  # world units -> this

    def format(self, values: Array, between: str = " ") -> str:
        """World units as text, in this unit, without it."""
        return between.join(f"{self.length * value:.3f}" for value in values)


def unit_of(scene: Scene, metres_per_unit: float | None = None) -> Unit:
    """Metres by `metres_per_unit`, else by the scene's own, else world units. InputError unless > 0."""
    if metres_per_unit is not None and not 0 < metres_per_unit < float("inf"):
        raise InputError(f"--scale {metres_per_unit:g}: must be above 0, metres per unit")
    metres = metres_per_unit or scene.metres_per_unit
    return Unit("units", 1.0) if metres is None else Unit("m", metres)


def table(instances: Sequence[Instance], unit: Unit, first: int = 1) -> list[str]:
    """Aligned lines under a heading, one for each instance, numbered from `first`; none without instances."""
    if not instances:
        return []
    rows = [(*HEADING[:4], f"{HEADING[4]}, {unit.name}", f"{HEADING[5]}, {unit.name}")]
    rows += [
        (
            str(number),
            f"{instance.score:.3f}",
            f"{100 * instance.share:.0f} %",
            f"{instance.count}",
            unit.format(instance.centre),
            unit.format(instance.size, " x "),
        )
        for number, instance in enumerate(instances, first)
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    ]


def instance_json(instance: Instance, number: int) -> dict[str, Any]:
    """Lengths in world units."""
    box = instance.oriented
    return {
        "number": number,
        "score": instance.score,
        "mean": instance.mean,
        "share": instance.share,
        "gaussians": instance.count,
        "centre": instance.centre.tolist(),
        "size": instance.size.tolist(),
        "box": instance.box.tolist(),
        "oriented_box": {
            "centre": box.centre.tolist(),
            "rotation": box.axes.tolist(),
            "half_extents": box.half_extents.tolist(),
        },
    }


def chosen(found: Sequence[Instance], numbers: Sequence[int]) -> Sequence[Instance]:
    """The instances of these numbers, the best is 1; all without numbers. Raises InputError for another."""
    if not found:
        raise InputError("what was found lies nowhere on a surface: nothing to select")
    for number in numbers:
        if not 1 <= number <= len(found):
            raise InputError(f"--instance {number}: there are {len(found)}, numbered from 1")
    return [found[number - 1] for number in numbers] or found

"""Where words stand beside things in the picture so that none covers another: plain maths, no window."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Label:
    """The room that words take, in units of the picture, y down."""

    x: float  # left edge, where they are wanted
    y: float  # upper edge
    width: float
    height: float

    def covers(self, other: "Label") -> bool:
        """Whether the two overlap; edges that touch do not."""
        beside = self.x + self.width <= other.x or other.x + other.width <= self.x
        return not (beside or self.y + self.height <= other.y or other.y + other.height <= self.y)


def placed(labels: Sequence[Label], size: tuple[float, float]) -> list[Label]:
    """The labels, none over another, in a picture of `size` (width, height). Each one goes straight up until
    it is free of those before it, where the picture ends straight down; where there is no room it stays.

    A label depends on those before it alone and in always the same way: it moves with its thing, and jumps
    only where it meets another or parts from it.
    """
    found: list[Label] = []
    for label in labels:
        x = max(min(label.x, size[0] - label.width), 0.0)
        y = max(min(label.y, size[1] - label.height), 0.0)
        inside = Label(x, y, label.width, label.height)
        free = _moved(inside, found, up=True) or _moved(inside, found, up=False)
        found.append(inside if free is None or free.y + free.height > size[1] else free)
    return found


def _moved(label: Label, others: Sequence[Label], *, up: bool) -> Label | None:
    """Up or down as far as it must; None beyond the upper edge of the picture."""
    while label.y >= 0:
        met = next((other for other in others if label.covers(other)), None)
        if met is None:
            return label
        y = met.y - label.height if up else met.y + met.height
        label = Label(label.x, y, label.width, label.height)
    return None

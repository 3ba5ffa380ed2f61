"""Where things stand: surfaces that carry objects, footprints that must not overlap, seeded choices."""

from dataclasses import dataclass, field

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.geometry.shapes import rotation_about
from langsplat_core.lab.world.objects.kit import Thing

_CLEARANCE = 0.001  # metres under an object: a flat bottom in the very plane it stands on would flicker
_TRIES = 400  # places that are looked at for one object before it is left out


@dataclass(frozen=True, eq=False)
class Placed:
    """A thing in the world."""

    thing: Thing
    turn: Array  # (3, 3)
    offset: Array  # (3,) metres
    scale: float = 1.0


def bounds(thing: Thing) -> tuple[Array, Array]:
    """(3,) lowest and highest coordinates of a thing in its own frame, metres."""
    low = np.min([piece.mesh.vertices.min(0) for piece in thing.pieces], axis=0)
    return low, np.max([piece.mesh.vertices.max(0) for piece in thing.pieces], axis=0)


def footprint(placed: Placed) -> Array:
    """(4, 2) corners of the upright box around a placed thing, seen from above, in world metres."""
    world: Array = (_base(placed.thing) * placed.scale) @ placed.turn.T + placed.offset
    return world[:, :2]


def _base(thing: Thing) -> Array:
    """(4, 3) corners, in order around, of the box around a thing in its own frame, at height 0."""
    low, high = bounds(thing)
    return np.array([(x, y, 0) for x, y in (low[:2], (high[0], low[1]), high[:2], (low[0], high[1]))])


def apart(one: Array, other: Array, gap: float) -> Array:
    """(...) whether rectangles (..., 4, 2) keep a distance of `gap` from one rectangle (4, 2) along one of
    the four directions of their sides."""
    axes = np.concatenate(
        [np.diff(one[..., :3, :], axis=-2), np.diff(np.broadcast_to(other, one.shape)[..., :3, :], axis=-2)],
        axis=-2,
    )
    axes /= np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1e-12)
    a, b = one @ axes.swapaxes(-1, -2), other @ axes.swapaxes(-1, -2)  # (..., 4 corners, 4 axes)
    return np.asarray(((a.min(-2) - b.max(-2) > gap) | (b.min(-2) - a.max(-2) > gap)).any(-1))


@dataclass(eq=False)
class Surface:
    """A level rectangle that carries things, and what stands on it already."""

    centre: Array  # (3,) metres
    half: Array  # (2,) half its sides, along x and y
    gap: float  # metres kept free between footprints
    scale: float  # things are enlarged by this factor
    crowd: int = 1  # of so many free places the one nearest the middle is taken: more is tighter
    taken: list[Array] = field(default_factory=list)  # footprints (4, 2)

    def stand(self, thing: Thing, rng: np.random.Generator) -> Placed | None:
        """Put a thing down at a free place, turned at random; None where there is no room for it."""
        base, lowest = _base(thing)[:, :2] * self.scale, bounds(thing)[0][2]
        middle = base.mean(0)
        angles = rng.uniform(0, 360, _TRIES)
        turns = np.stack([rotation_about("z", angle) for angle in angles])
        spots = self.centre[:2] + rng.uniform(-self.half, self.half, (_TRIES, 2))
        corners = (base - middle) @ turns[:, :2, :2].swapaxes(1, 2) + spots[:, None]
        free = (np.abs(corners - self.centre[:2]) <= self.half).all((1, 2))
        for other in self.taken:
            free &= apart(corners, other, self.gap)
        rows = np.flatnonzero(free)[: self.crowd]
        if not len(rows):
            return None
        row = rows[np.linalg.norm(spots[rows] - self.centre[:2], axis=1).argmin()]
        self.taken.append(corners[row])
        height = self.centre[2] + _CLEARANCE - lowest * self.scale
        offset = np.array([*(spots[row] - turns[row, :2, :2] @ middle), height])
        return Placed(thing, turns[row], offset, self.scale)

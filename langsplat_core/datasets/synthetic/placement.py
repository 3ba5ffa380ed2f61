"""Where things stand: surfaces that carry objects, footprints that must not overlap, seeded choices."""

from dataclasses import dataclass, field

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.datasets.synthetic.parts import Thing
from langsplat_core.datasets.synthetic.shapes import rotation_about

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
    low, high = bounds(placed.thing)
    corners = np.array(
        [(x, y, 0) for x, y in ((low[0], low[1]), (high[0], low[1]), high[:2], (low[0], high[1]))]
    )
    world: Array = (corners * placed.scale) @ placed.turn.T + placed.offset
    return world[:, :2]


def apart(one: Array, other: Array, gap: float) -> bool:
    """Whether two rectangles (4, 2) keep a distance of `gap` along one of their four directions."""
    for shape in (one, other):
        for edge in (shape[1] - shape[0], shape[2] - shape[1]):
            axis = edge / max(float(np.linalg.norm(edge)), 1e-12)
            a, b = one @ axis, other @ axis
            if a.min() - b.max() > gap or b.min() - a.max() > gap:
                return True
    return False


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
        low, high = bounds(thing)
        best: tuple[float, Placed, Array] | None = None
        found = 0
        middle = (low + high) / 2 * (1, 1, 0)
        for _ in range(_TRIES):
            turn = rotation_about("z", rng.uniform(0, 360))
            height = _CLEARANCE - low[2] * self.scale
            spot = self.centre + np.array([*rng.uniform(-self.half, self.half), height])
            placed = Placed(thing, turn, spot - turn @ middle * self.scale, self.scale)
            corners = footprint(placed)
            inside = (np.abs(corners - self.centre[:2]) <= self.half).all()
            if not inside or not all(apart(corners, other, self.gap) for other in self.taken):
                continue
            found += 1
            reach = float(np.linalg.norm(spot[:2] - self.centre[:2]))
            if best is None or reach < best[0]:
                best = (reach, placed, corners)
            if found >= self.crowd:
                break
        if best is None:
            return None
        self.taken.append(best[2])
        return best[1]

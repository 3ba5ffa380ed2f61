"""Marks: which Gaussians are selected, hidden and deleted, and the tools that mark them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.query import selection
from langsplat_core.scene import NO_NODE, Camera, Scene
from langsplat_core.scene.language import Tree
from langsplat_viewer.camera.overlays import box_edges

# The scene itself is never changed: deleting marks, and what is marked is left out of images and of what is
# saved. So everything can be undone, and an answer's numbers per Gaussian keep their places.

Tool = Literal["thing", "rectangle", "lasso", "brush", "sphere", "box"]
Mode = Literal["replace", "add", "remove", "intersect"]
TOOLS: tuple[Tool, ...] = get_args(Tool)
MODES: tuple[Mode, ...] = get_args(Mode)
BRUSHES = (0.005, 0.25)  # least and largest radius of the brush, of the image's height
REACHES = (0.001, 1.0)  # least and largest reach, scene radii


@dataclass(frozen=True, eq=False)
class Marks:
    """Masks over a scene's N Gaussians. Nothing that is hidden or deleted is selected."""

    selected: Array  # (N,) bool
    hidden: Array  # (N,) bool: in no image until it is shown again
    deleted: Array  # (N,) bool: in no image, and in nothing that is saved

    @property
    def shown(self) -> Array:
        """(N,) bool: neither hidden nor deleted."""
        return ~(self.hidden | self.deleted)

    @property
    def kept(self) -> Array:
        return ~self.deleted


def unmarked(count: int) -> Marks:
    """Return marks of `count` Gaussians of which none is marked."""
    nothing = np.zeros(count, bool)
    return Marks(nothing, nothing, nothing)


def combined(marks: Marks, found: Array, mode: Mode) -> Marks:
    """Return the marks with the selection replaced by `found` (N,) bool, or combined with it.

    What is not shown is not selected.
    """
    return replace(marks, selected=COMBINED[mode](marks.selected, found) & marks.shown)


COMBINED: dict[Mode, Callable[[Array, Array], Array]] = {
    "replace": lambda old, found: found,
    "add": np.logical_or,
    "remove": np.greater,  # of booleans: the one and not the other
    "intersect": np.logical_and,
}


def middle_of(scene: Scene, marks: Marks) -> Array | None:
    """Return the (3,) median of what is selected, world units; None where nothing is that can be drawn."""
    chosen = marks.selected & scene.gaussians.valid()
    return np.median(scene.gaussians.means[chosen].astype(np.float64), axis=0) if chosen.any() else None


def hidden_nodes(tree: Tree, marks: Marks) -> Array:
    """Return (K,) bool: nodes of which nothing is shown."""
    shown = tree.leaves[marks.shown & (tree.leaves != NO_NODE)]
    return tree.totals(np.bincount(shown, minlength=tree.count)) == 0


@dataclass(frozen=True)
class Stroke:
    """A stroke of the mouse. Places are fractions of the image, (0, 0) its top left corner."""

    path: tuple[tuple[float, float], ...]  # where the mouse was, one place or more
    centre: tuple[float, float, float] | None = None  # of a sphere or box: on the surface, world units


# The area of a drag with a tool: the Gaussians in it, and its outline. Plain maths, no window.
#
# Places are fractions of the image, (0, 0) its top left corner.

CLICK = 0.006  # of the image's height: a shorter drag is a click
ROUND = 48  # corners of a circle
ON_SCREEN: tuple[Tool, ...] = ("rectangle", "lasso", "brush")  # the others are bodies in the scene


@dataclass(frozen=True, eq=False)
class Drawn:
    """A stroke in the image that it is drawn in."""

    tool: Tool
    stroke: Stroke
    camera: Camera
    brush: float  # radius, of the image's height
    reach: float  # world units: radius of a sphere and half the side of a box that were only clicked

    @property
    def pixels(self) -> Array:
        """(K, 2) positions of the mouse, pixels."""
        return np.array(self.stroke.path, np.float64) * (self.camera.width, self.camera.height)

    @property
    def radius(self) -> float:
        """Radius of a sphere, half the side of a box: how far the drag leads from its centre, world units."""
        first, last = self.pixels[[0, -1]]
        if np.linalg.norm(last - first) < CLICK * self.camera.height:
            return self.reach
        (_,), (depth,) = self.camera.project(self.centre[None])
        start, end = self.camera.unproject(np.stack([first, last]), depth)
        return float(np.linalg.norm(end - start))

    @property
    def centre(self) -> Array:
        return np.array(self.stroke.centre, np.float64)


def caught(drawn: Drawn, means: Array, depths: Array | None = None) -> Array:
    """Return, for (N, 3) means, the (N,) bool of those inside.

    depths: (H, W) of the surface, as `Surface.depths` has them, to leave out what a rectangle, lasso or brush
    meets behind it; None: all the way through.
    """
    if drawn.tool == "sphere":
        return selection.in_sphere(means, drawn.centre, drawn.radius)
    if drawn.tool not in ON_SCREEN:
        return selection.in_box(means, drawn.centre - drawn.radius, drawn.centre + drawn.radius)
    camera, pixels = drawn.camera, drawn.pixels
    seen, size = selection.project(means, camera), (camera.width, camera.height)
    if drawn.tool == "rectangle":
        inside = selection.in_rectangle(seen, pixels[0], pixels[-1])
    elif drawn.tool == "lasso":
        inside = selection.in_polygon(seen, pixels, size)
    else:
        inside = selection.in_stroke(seen, pixels, drawn.brush * camera.height, size)
    if depths is None:
        return inside
    return inside & selection.on_surface(seen, depths, size)


def outlines(drawn: Drawn) -> list[Array]:
    """Return the lines (K, 2) around the enclosed area; of a brush, its way."""
    first, last = drawn.stroke.path[0], drawn.stroke.path[-1]
    match drawn.tool:
        case "rectangle":
            return [np.array([first, (last[0], first[1]), last, (first[0], last[1]), first])]
        case "lasso":
            return [np.array([*drawn.stroke.path, first])]
        case "brush":
            return [np.array(drawn.stroke.path)]
        case "sphere" if drawn.stroke.centre is not None:
            turns, (right, down, _) = np.linspace(0, 2 * math.pi, ROUND + 1), drawn.camera.rotation
            return _projected(drawn, [np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * down])
        case "box" if drawn.stroke.centre is not None:
            return _projected(drawn, box_edges(np.array(list(product((-1.0, 1.0), repeat=3)))))
    return []


def _projected(drawn: Drawn, lines: Sequence[Array] | Array) -> list[Array]:
    """Return lines around a body of radius 1 in the image, without those that reach behind the camera."""
    camera, found = drawn.camera, []
    for line in lines:
        pixels, depths = camera.project(drawn.centre + drawn.radius * line)
        if (depths > 1e-6 * drawn.radius).all():
            found.append(pixels / (camera.width, camera.height))
    return found

"""What a drag with a tool encloses: the Gaussians in it, and its outline. Plain maths, no window.

Places are fractions of the picture, (0, 0) its top left corner.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.query.screen_selection import in_polygon, in_rectangle, in_stroke, on_surface, project
from langsplat_core.query.selection import in_box, in_sphere
from langsplat_core.scene import Camera
from langsplat_viewer.marks.selecting import Stroke, Tool
from langsplat_viewer.parallel import eye_depth

CLICK = 0.006  # of the picture's height: a shorter drag is a click
ROUND = 48  # corners of a circle
ON_SCREEN: tuple[Tool, ...] = ("rectangle", "lasso", "brush")  # the others are bodies in the scene


@dataclass(frozen=True, eq=False)
class Drawn:
    """A stroke in the picture that it is drawn in."""

    tool: Tool
    stroke: Stroke
    camera: Camera
    brush: float  # radius, of the picture's height
    reach: float  # world units: radius of a sphere and half the side of a box that were only clicked

    @property
    def pixels(self) -> Array:
        """(K, 2) where the mouse was."""
        return np.array(self.stroke.path, np.float64) * (self.camera.width, self.camera.height)

    @property
    def radius(self) -> float:
        """Of a sphere, or half the side of a box: how far the drag leads from its centre, world units."""
        first, last = self.pixels[[0, -1]]
        if np.linalg.norm(last - first) < CLICK * self.camera.height:
            return self.reach
        (_,), (depth,) = self.camera.project(self.centre[None])
        ends = [self.camera.unproject((float(x), float(y)), float(depth)) for x, y in (first, last)]
        return float(np.linalg.norm(ends[1] - ends[0]))

    @property
    def centre(self) -> Array:
        """(3,) of a sphere or box."""
        return np.array(self.stroke.centre, np.float64)


def caught(drawn: Drawn, means: Array, depths: Array | None = None) -> Array:
    """(N, 3) means -> (N,) bool, those inside. depths: (H, W) of the surface, as `Surface.depths` has them,
    to leave out what a rectangle, lasso or brush meets behind it; None: all the way through."""
    if drawn.tool not in ON_SCREEN:
        return _in_body(drawn, means)
    camera, pixels = drawn.camera, drawn.pixels
    seen = project(means, camera)
    if drawn.tool == "rectangle":
        inside = in_rectangle(seen, pixels[0], pixels[-1])
    elif drawn.tool == "lasso":
        inside = in_polygon(seen, pixels)
    else:
        inside = in_stroke(seen, pixels, drawn.brush * camera.height)
    if depths is None:
        return inside
    plane = eye_depth(camera)  # what counts as hidden is a share of the depth from the eye
    seen = replace(seen, depths=seen.depths - plane)
    depths = np.where(depths > 0, depths - plane, 0)
    return inside & on_surface(seen, depths, (camera.width, camera.height))


def _in_body(drawn: Drawn, means: Array) -> Array:
    if drawn.stroke.centre is None:
        return np.zeros(len(means), bool)
    if drawn.tool == "sphere":
        return in_sphere(means, drawn.centre, drawn.radius)
    return in_box(means, drawn.centre - drawn.radius, drawn.centre + drawn.radius)


def outlines(drawn: Drawn) -> list[Array]:
    """Lines (K, 2) that show what is being enclosed; of a brush the way it took."""
    first, last = drawn.stroke.path[0], drawn.stroke.path[-1]
    match drawn.tool:
        case "rectangle":
            corners = [first, (last[0], first[1]), last, (first[0], last[1]), first]
            return [np.array(corners)]
        case "lasso":
            return [np.array([*drawn.stroke.path, first])]
        case "brush":
            return [np.array(drawn.stroke.path)]
        case "sphere" | "box" if drawn.stroke.centre is not None:
            return _of_sphere(drawn) if drawn.tool == "sphere" else _of_box(drawn)
    return []


def _of_sphere(drawn: Drawn) -> list[Array]:
    """The circle around its centre that faces the camera."""
    turns = np.linspace(0, 2 * math.pi, ROUND + 1)
    right, down, _ = drawn.camera.rotation
    around = np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * down
    return _projected(drawn, [drawn.centre + drawn.radius * around])


def _of_box(drawn: Drawn) -> list[Array]:
    """Its twelve edges."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    edges = [np.stack(ends) for ends in combinations(corners, 2) if np.abs(ends[0] - ends[1]).sum() == 2]
    return _projected(drawn, [drawn.centre + drawn.radius * edge for edge in edges])


def _projected(drawn: Drawn, lines: list[Array]) -> list[Array]:
    """Lines of world points in the picture; none that reaches behind the camera."""
    camera, found = drawn.camera, []
    for line in lines:
        pixels, depths = camera.project(line)
        if (depths > 1e-6 * drawn.radius).all():
            found.append(pixels / (camera.width, camera.height))
    return found
